"""The plant's step of the usual length: its tables against scipy, itself beside the step of any length."""

import math
import platform

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit
from scipy.linalg import expm
from sim_rig import VOLT_PER_COUNT, config, counts, plant, settle

from hil.bench.rigs.reference_motion import reference_motion
from sim.kernels import advance
from sim.motion import collocation
from sim.motion.amplifier import plan
from sim.motion.collocation import regular_step
from sim.motion.flow import AT, tabulate_flow
from sim.motion.layout import INSTANTS
from sim.motion.mechanics import NEAR, constants, near_acceleration, undamped_acceleration

PM = 1e-12
PERIOD_S = 200e-6
EFFECTS = {"amplifier_bandwidth": {"corner_hz": 30e3}, "stiffness_mismatch": {"leaf": (0.1, -0.08, 0.06)}}
micrometres = st.tuples(st.floats(-10, 10), st.floats(-10, 10), st.floats(2, 25))
volts = st.tuples(*[st.floats(60, 140)] * 3)


def under_way(pose_um, rates_mm_per_s, from_v, to_v):
    """A plant in the middle of a scan: its amplifier stands at ``from_v`` and has just been told ``to_v``."""
    p = plant(config(**EFFECTS))
    p.state["motion"][0] = [*(1e-6 * np.array(pose_um)), *(1e-3 * np.array(rates_mm_per_s))]
    p.state["voltage_v"] = np.round(np.array(from_v) / VOLT_PER_COUNT) * VOLT_PER_COUNT
    p.drive(counts(*to_v))
    return p


def test_tables_are_those_of_the_matrix_exponential():
    """Swinging freely; under a steady n; under an n that is any cubic of time, told by its values at the instants."""
    p = under_way((0, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, 0))
    par, s = p.params[0], p.state[0]
    tabulate_flow(par, s)
    system = np.zeros((6 + 3 * INSTANTS, 6 + 3 * INSTANTS))  # ... and n with its derivatives, a power of time for each
    system[:3, 3:6] = np.eye(3)
    system[3:6, :6] = np.hstack([-par["stiff_per_s2"], -par["damping_per_s"]])
    system[3:6, 6:9] = np.eye(3)
    for power in range(INSTANTS - 1):
        at = 6 + 3 * power
        system[at : at + 3, at + 3 : at + 6] = np.eye(3) / PERIOD_S  # time in steps
    powers = np.vander(AT, increasing=True)

    def whole(entries):
        xx, yy, zz, xy, xz, yz = entries
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])

    def answer_to(node, moved):
        cubic = np.linalg.solve(powers, np.eye(INSTANTS)[node])
        return sum(math.factorial(n) * c * moved[:, 6 + 3 * n : 9 + 3 * n] for n, c in enumerate(cubic))

    for j, share in enumerate(AT):
        moved = expm(system * share * PERIOD_S)[:6]
        np.testing.assert_allclose(whole(s["from_pose"][:, j]), moved[:3, :3], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(whole(s["from_rate"][:, j]), moved[:3, 3:6], rtol=1e-12, atol=1e-17)
        np.testing.assert_allclose(whole(s["steady"][:, j]), moved[:3, 6:9], rtol=1e-9, atol=1e-20)
        for node in range(INSTANTS):
            np.testing.assert_allclose(
                whole(s["answer"][node, :, j]), answer_to(node, moved)[:3], rtol=1e-8, atol=1e-19
            )
    np.testing.assert_allclose(whole(s["end_rate"][0]), moved[3:, :3], rtol=1e-11, atol=1e-9)
    np.testing.assert_allclose(whole(s["end_rate"][1]), moved[3:, 3:6], rtol=1e-11, atol=1e-12)
    for node in range(INSTANTS):
        np.testing.assert_allclose(whole(s["end_rate"][2 + node]), answer_to(node, moved)[3:], rtol=1e-8, atol=1e-14)


def error_m(p, to_v) -> float:
    """Of the next period, against scipy's DOP853; after it was told ``to_v``."""
    p.drive(counts(*to_v))
    true_m = reference_motion(p.params, p.state, counts(*to_v)[None], 200)[0]
    p.advance_to(p.t_us + 200)
    return float(np.abs(p.position_m - true_m).max())


def test_a_step_against_scipy():
    """From where voltages hold the stage, at up to 5 mm/s, with a change of up to a volt: 0.04 pm at most; the step of
    any length 0.2. Let go where they don't, 10 um away: 8 pm."""
    draw = np.random.default_rng(0)
    errors = {"usual": [], "any": [], "let go": []}
    for _ in range(40):
        from_v, change_v, rates = draw.uniform(60, 140, 3), draw.uniform(-1, 1, 3), draw.uniform(-5e-3, 5e-3, 3)
        for name in ("usual", "any"):
            p = plant(config(**EFFECTS))
            p.drive(counts(*from_v))
            settle(p, 40_000)
            p.state["motion"][0, 3:] = rates
            p.params["regular_s"] = p.params["regular_s"] if name == "usual" else -1.0
            errors[name].append(error_m(p, from_v + change_v))
            assert (p.state["flow_h_s"][0] == p.params["regular_s"][0]) == (name == "usual")
        pose_um = (*draw.uniform(-10, 10, 2), draw.uniform(2, 25))
        errors["let go"].append(error_m(under_way(pose_um, (0, 0, 0), from_v, from_v), from_v + change_v))
    assert 0.01 * PM < max(errors["usual"]) < 0.1 * PM
    assert max(errors["usual"]) < max(errors["any"]) < 0.5 * PM
    assert max(errors["let go"]) < 12 * PM


def test_nearer_the_truth_than_the_step_of_any_length():
    """A scan with 1.8 V of jitter in every period, against scipy's DOP853: 0.29 pm at most, and 2.05."""
    k = np.arange(200)[:, None]
    ramp = np.clip(k / 100, 0, 1)
    swing = 16000 + 4000 * np.sin(0.05 * k + np.arange(3)) + 300 * np.sin(1.1 * k)
    drives = np.round(np.sqrt(ramp * ramp * (3 - 2 * ramp)) * swing).astype(np.int32)
    far_m = []
    for usual in (True, False):
        p = plant(config(amplifier_bandwidth={"corner_hz": 30e3}))
        p.params["regular_s"] = p.params["regular_s"] if usual else -1.0
        true_m = reference_motion(p.params, p.state, drives, 200)
        ours = []
        for n, drive in enumerate(drives):
            p.drive(drive)
            p.advance_to(200 * (n + 1))
            ours.append(p.position_m)
        far_m.append(np.abs(np.array(ours) - true_m).max())
    assert 0.05 * PM < far_m[0] < 0.5 * PM
    assert far_m[0] < far_m[1] < 3.0 * PM


def test_where_the_rounds_begin_is_forgotten_in_them():
    """With the acceleration that the last step ended with, or worked out anew: within a hundredth of a picometre, while
    the drive jumps by up to 3 V."""
    draw = np.random.default_rng(4)
    kept, anew = (plant(config(amplifier_bandwidth={"corner_hz": 30e3})) for _ in range(2))
    far_m = 0.0
    for k in range(300):
        drive = counts(*(100 + draw.uniform(-1.5, 1.5, 3)))
        anew.state["ended_m"] = 1.0
        for p in (kept, anew):
            p.drive(drive)
            p.advance_to(200 * (k + 1))
        far_m = max(far_m, np.abs(kept.position_m - anew.position_m).max())
    assert 0.0 < far_m < 0.01 * PM


def ramping(p):
    p.params["slew_v_per_s"], p.params["amplifier_s"] = 1e4, 0.0


def held(p):
    p.state["held"][0, 1], p.state["held_m"][0, 1] = 1, 1e-6


def leaving(p):
    p.params["stop_n_per_m"], p.params["stop_high_m"] = 1e4, 5e-6


def arriving(p):
    p.params["stop_n_per_m"], p.params["stop_high_m"] = 1e4, 6.3e-6


@pytest.mark.parametrize("change", [ramping, held, leaving, arriving])
def test_what_it_does_not_do_is_left_to_the_other_step(change):
    """A ramp of the amplifier, a held slider, one at its stop, one that comes to it: nothing but scratch has changed,
    and the period's bits are those of the step of any length."""
    left, other = (under_way((0, 0, 10), (0, 0, 1), (100, 100, 100), (104, 104, 104)) for _ in range(2))
    for p in (left, other):
        change(p)
        p.state["strokes_m"] = 0.0
    before = left.state.copy()
    plan(left.params[0], left.state[0], PERIOD_S)
    planned = left.state.copy()
    assert not regular_step(left.params[0], left.state[0])
    for name in ("motion", "voltage_v", "base_v", "error_v", "slope_v_per_s", "held", "held_m", "touched"):
        assert (left.state[name] == planned[name]).all(), name
    left.state[:] = before
    other.params["regular_s"] = -1.0
    for p in (left, other):
        advance(p.params, p.state, 200)
    assert left.state["motion"].tobytes() == other.state["motion"].tobytes()
    assert left.state["voltage_v"].tobytes() == other.state["voltage_v"].tobytes()


@settings(max_examples=60)
@given(micrometres, volts)
def test_the_acceleration_without_a_branch_is_the_one_with(pose_um, volt):
    p = under_way(pose_um, (0, 0, 0), volt, volt)
    par, s = p.params[0], p.state[0]
    x, y, z = 1e-6 * np.array(pose_um)
    square = np.array(volt) ** 2
    ax, ay, az, near = near_acceleration(constants(par, s), tuple(square), x, y, z)
    assert near == 1.0
    np.testing.assert_allclose(
        [ax, ay, az], undamped_acceleration(par, s, square, x, y, z, 0, 0, 0), rtol=1e-11, atol=1e-9
    )


def test_it_tells_where_it_does_not_hold():
    """At a stop, where a crank or a link has turned too far for the series, and of what is not a number."""
    p = under_way((0, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, 0))
    free, s = p.params[0], p.state[0]
    stopped = p.params.copy()[0]
    stopped["stop_high_m"] = 20e-6
    lean_m = 1.01 * NEAR * free["crank_m"]

    def near(record, *pose):
        return near_acceleration(constants(record, s), (0.0, 0.0, 0.0), *pose)[3]

    assert near(stopped, 0.0, 19.9e-6, 0.0) == near(free, 0.0, 20.1e-6, 0.0) == 1.0
    assert near(stopped, 0.0, 20.1e-6, 0.0) == 0.0
    assert near(free, 0.98 * lean_m, 0.0, 0.0) == 1.0
    assert near(free, lean_m, 0.0, 0.0) == 0.0
    assert near(free, 0.0, 0.0, 80e-6) == 0.0
    assert near(free, math.nan, 0.0, 0.0) == 0.0


@pytest.mark.skipif(
    platform.machine() not in ("x86_64", "AMD64"), reason="other processors name their vectors otherwise"
)
def test_instants_are_vectors():
    """What the step is for: LLVM takes the instants side by side, so that a root of several is one instruction."""
    p = under_way((0, 0, 0), (0, 0, 0), (0, 0, 0), (0, 0, 0))
    fresh = njit(error_model="numpy", _nrt=False)(collocation.second_round.py_func)
    fresh(p.params[0], p.state[0])
    (machine_code,) = fresh.inspect_asm().values()
    assert "sqrtpd" in machine_code
    assert "sqrtsd" not in machine_code
