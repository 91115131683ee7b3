"""Counts to positions, and what the tick does when it may not drive."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_rig import MIDDLE, bus, counts_at, new_tick_memory, stage, tick_law

from pkxyz_ctrl.core import kinematics, tick

STROKES = st.tuples(*[st.floats(-1e-6, 26e-6)] * 3).map(np.array)


def exact(strokes_m):
    return stage().forward_kinematics(strokes_m)


def after_a_step(strokes_m, start_m):
    position = start_m.copy()
    size = kinematics.newton_step(stage().geometry[0], strokes_m, position, np.empty(3))
    return position, size


def test_the_error_of_a_newton_step_is_quadratic():
    """From 64 um down to 1 um off, half the distance leaves a quarter of the error, until that is 1e-14 m."""
    target = np.array([14e-6, 9e-6, 12e-6])
    at = exact(target)
    for direction in np.random.default_rng(1).normal(size=(8, 3)):
        direction /= np.linalg.norm(direction)
        errors = [np.linalg.norm(after_a_step(target, at + direction * d)[0] - at) for d in 64e-6 / 2.0 ** np.arange(7)]
        ratios = np.array(errors[1:]) / errors[:-1]
        assert np.all((ratios > 0.15) & (ratios < 0.40))
        assert 0.22 < ratios[-1] < 0.28
        assert errors[-1] < 3e-9


@settings(max_examples=100)
@given(STROKES, st.tuples(*[st.floats(-1, 1)] * 3).map(np.array))
def test_a_micrometre_of_prediction_error_leaves_nanometres_and_30_nm_less_than_a_picometre(strokes_m, direction):
    at = exact(strokes_m)
    for distance, left in ((1e-6, 6e-9), (30e-9, 6e-12)):
        position, size = after_a_step(strokes_m, at + direction * distance)
        assert np.abs(position - at).max() < left
        assert size == pytest.approx(np.abs(direction).max() * distance, rel=1e-2, abs=1e-20)


@settings(max_examples=100)
@given(STROKES, STROKES)
def test_a_newton_step_says_how_far_the_strokes_were_off(strokes_m, other_m):
    residual, position = np.empty(3), exact(other_m)
    expected = strokes_m - stage().inverse_kinematics(position)
    kinematics.newton_step(stage().geometry[0], strokes_m, position, residual)
    assert np.array_equal(residual, expected)


def test_where_the_jacobian_is_singular_nothing_moves():
    """Links that lie in the plane have no say over z."""
    geometry = stage().geometry.copy()[0]
    flat = np.array([1e-6, 2e-6, -geometry["height_rest_m"]])
    start = flat.copy()
    assert kinematics.newton_step(geometry, np.full(3, 5e-6), start, np.empty(3)) == np.inf
    assert np.array_equal(start, flat)


@settings(max_examples=150)
@given(
    STROKES, st.tuples(*[st.floats(-200e-9, 200e-9)] * 3).map(np.array), st.tuples(*[st.floats(-50e-15, 50e-15)] * 3)
)
def test_counts_become_the_position_that_they_mean(strokes_m, innovation_m, zero_f):
    """From a prediction 0.2 um off and with sense offsets that homing found: to 0.2 nm, the Newton step's remainder,
    of the exact kinematics at the strokes that the counts stand for."""
    law, memory, analog = tick_law(), new_tick_memory(), bus().analog
    memory["sense_zero_f"][:] = zero_f
    raw_f = stage().sense_capacitance(strokes_m) + zero_f
    count = np.round((raw_f - analog.sense_offset_f) / analog.sense_farad_per_count).astype(np.int32)
    memory["estimate"]["predicted"][:3] = exact(strokes_m) + innovation_m - law["estimator"]["operating_point_m"]
    tick.measure(law, memory, count)
    meant_f = analog.sense_offset_f + count * analog.sense_farad_per_count - zero_f
    meant_m = stage().strokes_from_capacitance(meant_f)
    assert memory["sense_f"] == pytest.approx(meant_f, rel=1e-13)
    assert memory["stroke_m"] == pytest.approx(meant_m, rel=0, abs=1e-17)
    assert (np.abs(memory["stroke_m"] - strokes_m) <= 0.5 * 68e-18 / stage().sense_gradient_f_per_m * 1.001).all()
    assert np.abs(memory["measurement_m"] - exact(meant_m)).max() < 0.3e-9


def test_rest_and_release_are_0_v_and_the_history_moves_on():
    """``rest`` is a tick, ``release`` takes back the tick that was: the counts before it stay where they are."""
    law, memory = tick_law(), new_tick_memory()
    memory["count"][:] = [[30, 31, 32], [20, 21, 22], [10, 11, 12]]
    for name in ("carry_v", "error_v", "demand_n", "slack_n", "force_n"):
        memory[name][:] = 1.0
    memory["feedforward_known"] = memory["active_set_steps"] = 1
    tick.rest(law, memory)
    assert memory["count"].tolist() == [[0, 0, 0], [30, 31, 32], [20, 21, 22]]
    assert not any(memory[name].any() for name in ("carry_v", "error_v", "demand_n", "slack_n", "force_n"))
    assert memory["feedforward_known"] == memory["active_set_steps"] == 0
    memory["count"][0] = 5
    tick.release(law, memory)
    assert memory["count"].tolist() == [[0, 0, 0], [30, 31, 32], [20, 21, 22]]


def test_starting_the_filter_somewhere_means_at_rest_there():
    law, memory = tick_law(), new_tick_memory()
    for name in ("predicted", "filtered", "ahead", "innovation_m"):
        memory["estimate"][name][:] = 1.0
    at = np.array([1e-6, -2e-6, 3e-6])
    tick.set_position(law, memory, at)
    for name in ("predicted", "filtered", "ahead"):
        state = memory["estimate"][name]
        assert state[:3] + law["estimator"]["operating_point_m"] == pytest.approx(at, rel=1e-12)
        assert not state[3:].any()
    assert not memory["estimate"]["innovation_m"].any()


def test_what_nothing_explains_is_said_comb_by_comb():
    """B^-T (d + K_0 e), with the same bits where the products by 0 are left out."""
    law, memory, rng, found = tick_law(), new_tick_memory(), np.random.default_rng(6), []
    disturbance_n, innovation_m = rng.normal(size=3) * 1e-6, rng.normal(size=3) * 1e-9
    inverse = np.linalg.inv(stage().jacobian(exact(MIDDLE)))
    memory["estimate"]["filtered"][6:], memory["estimate"]["innovation_m"][:] = disturbance_n, innovation_m
    memory["scratch"]["inverse"][:] = inverse
    assert law["estimator"]["decoupled"] == 1
    for decoupled in (1, 0):
        law["estimator"]["decoupled"], out = decoupled, np.empty(3)
        tick.unexplained_force(law, memory, out)
        found.append(out)
    expected = inverse.T @ (disturbance_n + law["estimator"]["stiffness_n_per_m"] @ innovation_m)
    assert found[0] == pytest.approx(expected, rel=1e-12)
    assert found[0].tobytes() == found[1].tobytes()


@pytest.mark.parametrize("field", ["ahead", "force_n", "demand_n"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_anything_that_is_no_number_is_noticed(field, value):
    for i in range(3):
        memory = new_tick_memory()
        assert tick.is_finite(memory)
        (memory["estimate"] if field == "ahead" else memory)[field][i] = value
        assert not tick.is_finite(memory)


def test_two_infinities_do_not_cancel():
    memory = new_tick_memory()
    memory["force_n"][:2] = np.inf, -np.inf
    assert not tick.is_finite(memory)


def test_saturation_is_told_and_slack_is_what_is_missing():
    """30 um above the middle cannot be held at 200 V: a force meets its limit. Always demand = J^T F + slack."""
    law, memory = tick_law(), new_tick_memory()
    law["drive"]["count_slew_max"] = law["drive"]["count_max"]
    for at, expected in ((exact(MIDDLE), False), (exact(MIDDLE) + np.array([0, 0, 30e-6]), True)):
        row = np.concatenate([at, np.zeros(6)])
        memory["estimate"]["ahead"][:] = row - np.r_[law["estimator"]["operating_point_m"], np.zeros(6)]
        memory["feedforward_known"] = 0
        assert bool(tick.act(law, memory, row, row, row)) is expected
        given_n = stage().jacobian(at).T @ memory["force_n"]
        assert memory["demand_n"] == pytest.approx(given_n + memory["slack_n"], rel=1e-12)
        assert bool(np.abs(memory["slack_n"]).max() > 1e-9) is expected
        counts = np.sqrt(memory["force_n"] / law["drive"]["force_gain_n_per_v2"]) / law["drive"]["volt_per_count"]
        assert np.abs(memory["count"][0] - counts).max() <= 1.0
    assert counts_at(MIDDLE).tolist() == pytest.approx([0, 0, 0], abs=60)  # the sense scale is centred there
