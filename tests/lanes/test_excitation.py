"""The excitation as data: its tones, its order, and that a loop without one does not change by a bit."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loop_rig import first_difference, rows_of, setup, shortened

from hil.lanes.excitation import SETTLE_PERIODS, excitation, tones


def an_excitation(kind="multisine", amplitude_m=5e-9, periods=2, first_tick=40):
    return excitation(
        kind, np.array([3, 11, 40]), period_ticks=200, periods=periods, amplitude_m=amplitude_m, first_tick=first_tick,
        seed=1,
    )  # fmt: skip


@given(st.integers(0, 2000), st.integers(1, 700))
def test_any_window_is_cut_from_the_same_signal(first, count):
    e = an_excitation()
    assert np.array_equal(e.sample(first, count), e.sample(0, 3000)[first : first + count])


@pytest.mark.parametrize("kind", ["multisine", "stepped"])
def test_each_passage_has_its_tones_on_its_axis_and_nothing_else(kind):
    e = an_excitation(kind)
    played = e.sample(0, e.ticks + 100)
    assert not played[: e.first_tick].any()
    assert not played[e.ticks :].any()
    seen = []
    for n, passage in enumerate(e.passages):
        period = played[e.measured_from(n) :][: e.period_ticks]
        size = np.abs(np.fft.rfft(period, axis=0)) * 2 / e.period_ticks
        expected = np.zeros((e.period_ticks // 2 + 1, 3))
        expected[passage.bins, passage.axis] = e.amplitude_m
        assert size == pytest.approx(expected, abs=1e-20)
        seen += [(passage.axis, k) for k in passage.bins]
    assert sorted(seen) == [(axis, k) for axis in range(3) for k in (3, 11, 40)]
    assert e.passage_ticks == (SETTLE_PERIODS + e.periods) * e.period_ticks


def test_tones_are_whole_periods_below_half_the_sampling_rate():
    bins = tones(5000, 100)
    assert bins[0] == 5
    assert bins[-1] == 2499
    assert (np.diff(bins) > 0).all()
    with pytest.raises(ValueError, match="half the sampling rate"):
        excitation("multisine", np.array([100]), period_ticks=200, periods=1, amplitude_m=1e-9, first_tick=0, seed=1)


def test_an_excitation_of_nothing_changes_no_bit_and_one_of_something_changes_both_lanes_alike():
    plain = shortened(setup(), 1200)
    nothing = dataclasses.replace(plain, excitation=an_excitation(amplitude_m=0.0))
    something = dataclasses.replace(plain, excitation=an_excitation())
    rows, _ = rows_of(plain, "fast")
    assert first_difference(rows, rows_of(nothing, "fast")[0]) is None
    excited, _ = rows_of(something, "fast")
    assert first_difference(excited, rows_of(something, "lockstep")[0]) is None
    tracked = excited["reference_tick"]
    first = int(np.flatnonzero(tracked == something.excitation.first_tick)[0])
    assert np.array_equal(excited["measurement_m"][:first], rows["measurement_m"][:first])
    step = excited["measurement_m"][first] - rows["measurement_m"][first]
    assert step == pytest.approx(something.excitation.sample(40, 1)[0], abs=1e-15)
