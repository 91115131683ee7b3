"""Intervals of shares: they hold the truth as often as they say, also where devices of a wafer are alike."""

import numpy as np
import pytest
import scipy.stats

from hil.studies.wafer.shares import clopper_pearson, share_of


@pytest.mark.parametrize(("hits", "trials"), [(0, 10), (3, 10), (10, 10), (97, 100)])
def test_clopper_and_pearson_are_those_of_scipy(hits, trials):
    exact = scipy.stats.binomtest(hits, trials).proportion_ci(0.95, method="exact")
    assert clopper_pearson(hits, trials) == pytest.approx((exact.low, exact.high), rel=1e-9)


def drawn(rng, wafers, dies, share, alike):
    """Passes of wafers whose own shares differ: beta with correlation ``alike`` between the devices of one."""
    strength = (1.0 - alike) / alike
    own = rng.beta(share * strength, (1.0 - share) * strength, wafers)
    return (rng.random((wafers, dies)) < own[:, None]).ravel(), np.repeat(np.arange(wafers), dies)


@pytest.mark.parametrize(("share", "alike"), [(0.9, 1e-6), (0.9, 0.1), (0.97, 0.05), (0.5, 0.3)])
def test_the_interval_holds_the_share_of_the_process(share, alike):
    rng = np.random.default_rng(1)
    found = [share_of(*drawn(rng, 40, 76, share, alike)) for _ in range(400)]
    hit = np.mean([s.low <= share <= s.high for s in found])
    assert hit >= 0.95 - 3 * np.sqrt(0.95 * 0.05 / 400)
    simple = np.mean([clopper_pearson(s.passed, s.devices)[0] <= share <= clopper_pearson(s.passed, s.devices)[1]
                      for s in found])  # fmt: skip
    assert (simple < 0.7) == (alike > 0.01)  # counted as if devices were their own, it would be far too narrow
    assert np.mean([s.high - s.low for s in found]) < 0.4


def test_nothing_is_known_of_other_wafers_from_one():
    one = share_of(np.array([True, False, True, True]), np.zeros(4, np.int64))
    assert (one.value, one.low, one.high) == (0.75, 0.0, 1.0)


def test_where_all_pass_each_wafer_counts_once():
    every = share_of(np.ones(1000, np.bool_), np.repeat(np.arange(10), 100))
    assert every.effective == 10
    assert every.low == pytest.approx(0.025 ** (1 / 10), rel=1e-9)
    assert every.high == 1.0
