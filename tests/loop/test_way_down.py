"""The way down: against scipy's Hermite polynomial, and what it leaves of a mode's swing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.interpolate import BPoly

from pkxyz_ctrl.design.law import way_down_ticks
from pkxyz_ctrl.loop import landing

numbers = st.floats(-1.0, 1.0)


@settings(max_examples=60)
@given(numbers, numbers, numbers, st.integers(-2, 24), st.sampled_from([40, 200, 2000]))
def test_the_path_is_the_polynomial_of_7th_order_from_a_state_to_rest(x, v, a, age, period_us):
    """x in um, v in um / T, a in um / T^2, so that each has its part; no jerk at either end."""
    begin, row, duration_s = np.zeros(9), np.empty(9), 25e-6 * period_us
    begin[[1, 4, 7]] = 1e-6 * np.array([x, v / duration_s, a / duration_s**2])
    landing.sample(begin, age, 0, 25, period_us, row)
    oracle = BPoly.from_derivatives([0.0, 1.0], [[x, v, a, 0.0], [0.0] * 4])
    scaled = row[[1, 4, 7]] * np.array([1.0, duration_s, duration_s**2]) * 1e6
    assert scaled == pytest.approx([float(oracle(age / 25, n)) for n in range(3)], abs=1e-9)
    assert not row[[0, 2, 3, 5, 6, 8]].any()


@given(numbers, numbers, numbers, st.integers(-1, 30))
def test_with_braking_ticks_it_rests_where_it_began_before_it_goes_down(x, v, a, age):
    begin, row, braked_s, down_s = np.zeros(9), np.empty(9), 7e-3, 21e-3
    begin[[1, 4, 7]] = 1e-6 * np.array([x, v / braked_s, a / braked_s**2])
    landing.sample(begin, age, 7, 28, 1000, row)
    parts = [[x, v / braked_s, a / braked_s**2, 0.0], [x, 0.0, 0.0, 0.0], [0.0] * 4]
    oracle, at_s = BPoly.from_derivatives([0.0, braked_s, braked_s + down_s], parts), min(1e-3 * age, braked_s + down_s)
    scale = np.array([1.0, braked_s, braked_s**2])
    expected = [float(oracle(at_s, n)) for n in range(3)]
    assert row[[1, 4, 7]] * scale * 1e6 == pytest.approx(expected * scale, abs=1e-9)


@pytest.mark.parametrize("braking", [0, 10])
@pytest.mark.parametrize("age", [25, 26, 175])
def test_past_the_end_it_rests(age, braking):
    row = np.ones(9)
    landing.sample(np.ones(9), age, braking, 25, 200, row)
    assert not row.any()
    assert landing.share(age / 25) == 0.0


def test_the_share_of_what_was_fed_back_is_the_path_from_rest():
    begin, row = np.zeros(9), np.empty(9)
    begin[0] = 1.0
    for age in range(-10, 61):
        landing.sample(begin, max(age, 0), 0, 50, 100, row)
        assert landing.share(age / 50) == pytest.approx(row[0], abs=1e-12)


@pytest.mark.parametrize(
    ("landing_s", "period_us", "ticks"),
    [
        (0.005, 200, (0, 25)),
        (0.005, 500, (0, 12)),
        (0.005, 1000, (7, 28)),
        (0.01, 200, (0, 50)),
        (0.0102, 200, (25, 51)),
        (0.05, 1000, (7, 50)),
        (0.02, 50, (100, 400)),
    ],
)
def test_a_way_down_longer_than_10_ms_brakes_first(landing_s, period_us, ticks):
    assert way_down_ticks(landing_s, period_us) == ticks


@pytest.mark.parametrize("frequency_hz", [560.0, 631.0, 700.0, 780.0, 880.0])
def test_a_force_that_is_let_go_so_leaves_little_of_a_swing(frequency_hz):
    """Without any damping: the spectrum of its rate at a mode of a device 20 % softer or stiffer. At once it is 1."""
    w = 2 * np.pi * frequency_hz * 0.005
    rate = BPoly.from_derivatives([0.0, 1.0], [[1.0, 0.0, 0.0, 0.0], [0.0] * 4]).derivative()
    part = [quad(lambda u, f=f: float(rate(u)) * f(w * u), 0.0, 1.0, limit=200)[0] for f in (np.cos, np.sin)]
    assert np.hypot(*part) < 0.04
