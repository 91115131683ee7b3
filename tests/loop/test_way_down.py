"""The way down: against scipy's Hermite polynomial, and what it leaves of a mode's swing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.interpolate import BPoly

from pkxyz_ctrl.loop import landing

numbers = st.floats(-1.0, 1.0)


@settings(max_examples=60)
@given(numbers, numbers, numbers, st.floats(-0.1, 0.999), st.sampled_from([0.001, 0.005, 0.05]))
def test_the_path_is_the_polynomial_of_7th_order_from_a_state_to_rest(x, v, a, u, duration_s):
    """x in um, v in um / T, a in um / T^2, so that each has its part; no jerk at either end."""
    begin, row = np.zeros(9), np.empty(9)
    begin[[1, 4, 7]] = 1e-6 * np.array([x, v / duration_s, a / duration_s**2])
    landing.sample(begin, u, duration_s, row)
    oracle = BPoly.from_derivatives([0.0, 1.0], [[x, v, a, 0.0], [0.0] * 4])
    scaled = row[[1, 4, 7]] * np.array([1.0, duration_s, duration_s**2]) * 1e6
    assert scaled == pytest.approx([float(oracle(u, n)) for n in range(3)], abs=1e-9)
    assert not row[[0, 2, 3, 5, 6, 8]].any()


@pytest.mark.parametrize("u", [1.0, 1.04, 7.0])
def test_past_the_end_it_rests(u):
    row = np.ones(9)
    landing.sample(np.ones(9), u, 0.005, row)
    assert not row.any()
    assert landing.share(u) == 0.0


def test_the_share_of_what_was_fed_back_is_the_path_from_rest():
    begin, row = np.zeros(9), np.empty(9)
    begin[0] = 1.0
    for u in np.linspace(-0.2, 1.2, 57):
        landing.sample(begin, max(u, 0.0), 0.005, row)
        assert landing.share(u) == pytest.approx(row[0], abs=1e-12)


@pytest.mark.parametrize("frequency_hz", [560.0, 631.0, 700.0, 780.0, 880.0])
def test_a_force_that_is_let_go_so_leaves_little_of_a_swing(frequency_hz):
    """Without any damping: the spectrum of its rate at a mode of a device 20 % softer or stiffer. At once it is 1."""
    w = 2 * np.pi * frequency_hz * 0.005
    rate = BPoly.from_derivatives([0.0, 1.0], [[1.0, 0.0, 0.0, 0.0], [0.0] * 4]).derivative()
    part = [quad(lambda u, f=f: float(rate(u)) * f(w * u), 0.0, 1.0, limit=200)[0] for f in (np.cos, np.sin)]
    assert np.hypot(*part) < 0.04
