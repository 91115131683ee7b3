"""The plant's mechanism: loop closure, energy and its derivatives, equilibrium, conservation."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from sim_rig import DEVICE, config, counts, plant, settle
from sim_truth import stiffness_at

from sim.config import Device
from sim.motion.geometry import E_X, E_Y, N_X, N_Y, jacobian, strokes
from sim.motion.mechanics import acceleration, arcsine, comb_accelerations, energy

PLAIN = plant(config())
UNEVEN = plant(
    config(
        stiffness_mismatch={
            "leaf": (0.1, -0.08, 0.06),
            "crank_hinge": (0.1, 0.0, -0.1),
            "link_hinge": (0.1, 0.05, 0.0),
        },
        comb_mismatch={"relative": (0.05, -0.05, 0.02)},
    )
)
poses = st.tuples(*[st.floats(-12e-6, 12e-6)] * 2, st.floats(-2e-6, 37e-6)).map(np.array)
plants = st.sampled_from([PLAIN, UNEVEN])


def strokes_of(p, x):
    out = np.empty(3)
    strokes(p.params[0], np.concatenate([x, np.zeros(3)]), out)
    return out


@settings(max_examples=40)
@given(poses)
def test_crank_and_link_keep_their_lengths(x):
    """Points of each chain, rebuilt from the stroke: slider, pin and table stand L1 and L2 apart, the link over e_i."""
    g = DEVICE.geometry
    projection_m, height_m = g.link_rest_m
    link_m = math.hypot(projection_m, height_m)
    q = strokes_of(PLAIN, x)
    table = np.array([x[0], x[1], height_m + x[2]])
    for i in range(3):
        e, n = np.array([E_X[i], E_Y[i], 0.0]), np.array([N_X[i], N_Y[i], 0.0])
        slider = e * (q[i] - projection_m - g.crank_length_m)
        pin_xy = table - e * math.sqrt(link_m**2 - table[2] ** 2)
        pin = np.array([pin_xy[0], pin_xy[1], 0.0])
        assert np.linalg.norm(pin - slider) == pytest.approx(g.crank_length_m, abs=2e-18)
        assert np.linalg.norm(table - pin) == pytest.approx(link_m, abs=2e-18)
        assert abs((table - pin) @ n) < 1e-18
        assert (pin - slider) @ e > 0  # outer branch


def test_strokes_are_zero_at_rest():
    assert np.abs(strokes_of(PLAIN, np.zeros(3))).max() < 1e-18


@settings(max_examples=40)
@given(poses)
def test_jacobian_is_the_slope_of_the_strokes(x):
    h = 1e-8
    slopes = np.column_stack(
        [(strokes_of(PLAIN, x + h * a) - strokes_of(PLAIN, x - h * a)) / (2 * h) for a in np.eye(3)]
    )
    np.testing.assert_allclose(jacobian(PLAIN.params[0], x), slopes, atol=1e-9)


@settings(max_examples=40)
@given(st.floats(-0.999, 0.999))
def test_arcsine_series_meets_the_library(y):
    assert arcsine(y) == pytest.approx(math.asin(y), rel=4e-16, abs=0)


@settings(max_examples=40)
@given(plants, poses)
def test_force_is_minus_the_slope_of_the_energy(p, x):
    par, s = p.params[0], p.state[0]
    h = 2e-8

    def v(at):
        return energy(par, np.concatenate([at, np.zeros(3)]))

    slope = np.array([(v(x + h * a) - v(x - h * a)) / (2 * h) for a in np.eye(3)])
    s["force_n"] = 0.0
    force = par["mass_kg"] * np.array(acceleration(par, s, np.zeros(3), *x, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(
        force, -slope, atol=2e-10
    )  # of up to 4e-3 N; 1e-10 is the difference quotient's rounding


@settings(max_examples=40)
@given(plants, poses)
def test_stiffness_is_the_slope_of_the_force(p, x):
    par, s = p.params[0], p.state[0]
    s["force_n"] = 0.0
    h = 1e-7

    def f(at):
        return -par["mass_kg"] * np.array(acceleration(par, s, np.zeros(3), *at, 0.0, 0.0, 0.0))

    slope = np.column_stack([(f(x + h * a) - f(x - h * a)) / (2 * h) for a in np.eye(3)])
    np.testing.assert_allclose(stiffness_at(par, x), slope, rtol=1e-6, atol=1e-5)


@settings(max_examples=40)
@given(poses, st.tuples(*[st.floats(0, 4e4)] * 3).map(np.array))
def test_combs_act_through_the_transposed_jacobian(x, volt2):
    par, s = UNEVEN.params[0], UNEVEN.state[0]
    s["force_n"] = 0.0
    expected = jacobian(par, x).T @ (par["force_gain_n_per_v2"] * volt2) / par["mass_kg"]
    np.testing.assert_allclose(
        comb_accelerations(par, s, volt2, 0.5 * volt2, x), [*expected, *(0.5 * expected)], rtol=1e-9, atol=1e-9
    )
    both = np.array(acceleration(par, s, volt2, *x, 0.0, 0.0, 0.0))
    alone = np.array(acceleration(par, s, np.zeros(3), *x, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(both - alone, expected, rtol=1e-9, atol=1e-8)


def test_published_stiffness_and_frequencies():
    """K_xx = 0.0759, K_zz = 0.1136 N/mm and 630.92, 771.75 Hz (paper, section IV.E)."""
    k = stiffness_at(PLAIN.params[0], np.zeros(3))
    assert k[0, 0] == pytest.approx(75.9, rel=1e-3)
    assert k[1, 1] == pytest.approx(k[0, 0], rel=1e-12)
    assert k[2, 2] == pytest.approx(113.6, rel=1e-3)
    hz = np.sqrt(np.diag(k) / PLAIN.params[0]["mass_kg"]) / (2 * math.pi)
    assert hz == pytest.approx([630.92, 630.92, 771.75], rel=2e-4)


@settings(max_examples=8)
@given(plants, st.tuples(*[st.floats(60, 150)] * 3))
def test_the_stage_settles_where_the_energy_is_least(p, volts):
    """Static truth against a minimiser of V(x) - sum k_i V_i^2 q_i(x), in micrometres and nanojoules."""
    p = plant(config(), seed=1) if p is PLAIN else UNEVEN
    p.drive(counts(*volts))
    settle(p, 150_000)  # 18 time constants of the damping
    force = p.params[0]["force_gain_n_per_v2"] * p.voltage_v**2

    def potential(u):
        x = np.array(u) * 1e-6
        return 1e9 * (energy(p.params[0], np.concatenate([x, np.zeros(3)])) - force @ strokes_of(p, x))

    least = minimize(
        potential, np.zeros(3), method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-15, "maxiter": 4000}
    )
    np.testing.assert_allclose(p.position_m * 1e6, least.x, atol=2e-5)


def released(damped: bool, step_us: int) -> np.ndarray:
    """Kinetic plus elastic energy (J) of a stage let go from (3, -2, 5) um, over 100 periods of its slowest mode."""
    p = plant(config(damping={"on": damped}))
    p.state["motion"][0, :3] = [3e-6, -2e-6, 5e-6]
    par = p.params[0]
    totals = []
    for _ in range(160_000 // step_us):
        p.advance_to(p.t_us + step_us)
        m = p.state["motion"][0]
        totals.append(energy(par, m) + 0.5 * par["mass_kg"] * m[3:] @ m[3:])
    return np.array(totals)


def test_energy_is_conserved_without_damping():
    """To 1e-8 in short steps. In those of 200 us the method itself loses 4e-7, a quality factor of 1e9."""
    short = released(False, 50)
    assert np.ptp(short) / short[0] < 1e-8
    usual = released(False, 200)
    assert 1e-7 < (usual[0] - usual[-1]) / usual[0] < 1e-6
    lost = released(True, 200)
    assert lost[-1] < 1e-3 * lost[0]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_every_mode_decays_with_the_quality_factor(axis):
    """Amplitude over one period falls by exp(-pi / Q) for small motion, Q = 20."""
    p = plant(config())
    p.state["motion"][0, axis] = 1e-9
    w = math.sqrt(stiffness_at(p.params[0], np.zeros(3))[axis, axis] / p.params[0]["mass_kg"])
    trace = []
    for _ in range(20_000):
        p.advance_to(p.t_us + 1)
        trace.append(p.position_m[axis])
    x = np.array(trace)
    peaks = np.flatnonzero((x[1:-1] > x[:-2]) & (x[1:-1] >= x[2:])) + 1
    rate = np.polyfit(peaks * 1e-6, np.log(x[peaks]), 1)[0]
    assert -rate == pytest.approx(w / 40, rel=2e-3)


def test_a_link_that_does_not_close_is_refused():
    raw = DEVICE.model_dump()
    raw["geometry"]["base_radius_m"] = 0.9e-3
    with pytest.raises(ValueError, match="base_radius_m"):
        Device.model_validate(raw)
