"""The law's force: the reference ahead by its polynomial, authority, feed-forward by inverse dynamics of other code."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_rig import MIDDLE, bus, controller, new_tick_memory, setup, stage, tick_law
from scipy.integrate import solve_ivp
from sim_rig import config, plant

from pkxyz_ctrl.core import feedback, tick
from sim.motion.mechanics import acceleration

PERIOD_S = bus().period_us * 1e-6


def polynomial(state, jerk, t):
    """Row (9,) after ``t`` at constant jerk."""
    p, v, a = state.reshape(3, 3)
    return np.concatenate([p + v * t + a * t**2 / 2 + jerk * t**3 / 6, v + a * t + jerk * t**2 / 2, a + jerk * t])


@settings(max_examples=100)
@given(
    st.tuples(*[st.floats(-1, 1)] * 9).map(np.array),
    st.tuples(*[st.floats(-300, 300)] * 3).map(np.array),
    st.floats(0, 1),
)
def test_ahead_is_the_polynomial_of_constant_jerk(unit, jerk, periods):
    gains, out = tick_law()["feedback"], np.zeros(9)
    gains["lead_s"] = periods * PERIOD_S
    now = unit * np.repeat([10e-6, 1e-3, 0.5], 3)
    feedback.ahead(gains, now, polynomial(now, jerk, PERIOD_S), out)
    expected = polynomial(now, jerk, periods * PERIOD_S)
    assert np.all(np.abs(out - expected) <= 1e-11 * np.repeat([10e-6, 1e-3, 0.5], 3))


def test_ahead_on_the_default_scan():
    """Half a period and the amplifier's time constant ahead of the sampled trajectory, against the trajectory itself,
    sampled a microsecond at a time: within 1 pm, or 0.1 nm where the jerk switches between two ticks."""
    trajectory, gains, out = setup().trajectory, tick_law()["feedback"], np.zeros(9)
    gains["lead_s"] = 105e-6
    first = 2000  # within the scan
    ticks, fine = trajectory.sample(first, 1001, 200), trajectory.sample(first * 200 + 105, 200_000, 1)[::200]
    errors = []
    for begin, end, expected in zip(ticks[:-1], ticks[1:], fine, strict=True):
        feedback.ahead(gains, begin, end, out)
        errors.append(np.abs(out - expected)[:3].max())
    assert np.median(errors) < 1e-14
    assert np.mean(np.array(errors) > 1e-12) < 0.1
    assert max(errors) < 0.1e-9


def test_lead_is_the_middle_of_the_interval_behind_the_amplifier():
    gains = tick_law()["feedback"]
    assert gains["lead_s"] == pytest.approx(100e-6 + 1 / (2 * np.pi * 30e3), rel=1e-12)


def least_holding_force(strokes_m):
    return float(stage().holding_forces(stage().forward_kinematics(strokes_m)).min())


@pytest.mark.parametrize(("stroke_um", "expected"), [(0.0, 0.0), (12.5, 1.0), (25.0, 1.0)])
def test_authority_is_none_at_rest_and_all_in_the_middle(stroke_um, expected):
    assert authority_at(np.full(3, stroke_um * 1e-6)) == expected


def authority_at(strokes_m):
    position = stage().forward_kinematics(strokes_m)
    inverse = np.linalg.inv(stage().jacobian(position))
    return feedback.authority(tick_law()["feedback"], inverse, stage().energy_gradient(position))


@settings(max_examples=100)
@given(st.tuples(*[st.floats(-2e-6, 25e-6)] * 3).map(np.array))
def test_authority_follows_the_weakest_comb(strokes_m):
    share = authority_at(strokes_m)
    expected = least_holding_force(strokes_m) / controller().regulator.authority_force_n
    assert 0.0 <= share <= 1.0
    assert share == pytest.approx(min(max(expected, 0.0), 1.0), rel=1e-9, abs=1e-12)


def test_authority_where_a_comb_would_have_to_push_is_none():
    strokes = np.array([1e-6, -1e-6, -1e-6])
    assert least_holding_force(strokes) < 0
    assert authority_at(strokes) == 0.0


@pytest.mark.parametrize("name", ["feedback", "set_points"])
def test_what_is_multiplied_by_nothing_may_be_left_out(name):
    """Axes that do not act on each other give the same bits with and without the products by 0."""
    law, rng = tick_law(), np.random.default_rng(5)
    gains, regulator, origin = law["feedback"], law[name], law["estimator"]["operating_point_m"]
    assert gains["decoupled"] == regulator["decoupled"] == 1
    for _ in range(200):
        row, state = rng.normal(size=(2, 9)) * np.repeat([1e-6, 1e-3, 1e-1], 3)
        force_n, share, found = rng.normal(size=3) * 1e-4, rng.random(), []
        for decoupled in (1, 0):
            gains["decoupled"] = regulator["decoupled"] = decoupled
            moved, fed_back = force_n.copy(), force_n.copy()
            feedback.add_motion(gains, row, moved)
            feedback.add_feedback(regulator, origin, state, row, share, fed_back)
            found.append(moved.tobytes() + fed_back.tobytes())
        assert found[0] == found[1]


def on_the_reference(row):
    """Law and memory of a tick whose estimate and model lie on the reference, whose comb forces are free of limits and
    whose reference acts at once: what ``act`` then commands is its feed-forward alone."""
    law, memory = tick_law(), new_tick_memory()
    law["feedback"]["lead_s"] = 0.0
    law["drive"]["count_slew_max"] = law["drive"]["count_max"]
    memory["estimate"]["ahead"][:6] = row[:6]
    memory["estimate"]["ahead"][:3] -= law["estimator"]["operating_point_m"]
    memory["set_point_model"]["state"][:] = memory["estimate"]["ahead"]
    return law, memory


@settings(max_examples=100)
@given(
    st.tuples(*[st.floats(6e-6, 20e-6)] * 3).map(np.array),
    st.tuples(*[st.floats(-1, 1)] * 6).map(np.array),
)
def test_feedforward_is_the_inverse_dynamics_of_the_plant(strokes_m, motion):
    """The comb forces for a moving reference, put into the plant's own equation of motion, which shares no code with
    the law, give the reference's acceleration: to 1e-9 of what the springs do."""
    velocity, wanted = motion[:3] * 1e-3, motion[3:] * 1.0
    row = np.concatenate([stage().forward_kinematics(strokes_m), velocity, wanted])
    law, memory = on_the_reference(row)
    assert not tick.act(law, memory, row, row, row)
    p = plant(config())
    volt2 = memory["force_n"] / law["drive"]["force_gain_n_per_v2"]
    got = np.array(acceleration(p.params[0], p.state[0], volt2, *row[:3], *velocity))
    springs = np.abs(stage().energy_gradient(row[:3])).max() / law["feedback"]["mass_kg"]
    assert np.abs(got - wanted).max() < 1e-9 * springs


def test_feedforward_alone_draws_the_reference():
    """scipy integrates the plant's equation under the law's forces as functions of time: 10 ms of a 100 Hz circle of
    2 um radius that rises, without any feedback, ends within 1 pm of the reference."""
    p, centre = plant(config()), stage().forward_kinematics(MIDDLE)

    def reference(t):
        w, r = 2 * np.pi * 100, 2e-6
        c, s, u = np.cos(w * t), np.sin(w * t), 100e-6
        return np.array(
            [
                [centre[0] + r * c, centre[1] + r * s, centre[2] + u * t],
                [-r * w * s, r * w * c, u],
                [-r * w * w * c, -r * w * w * s, 0.0],
            ]
        ).ravel()

    def motion(t, state):
        row = reference(t)
        law, memory = on_the_reference(row)
        assert not tick.act(law, memory, row, row, row)
        volt2 = memory["force_n"] / law["drive"]["force_gain_n_per_v2"]
        return np.concatenate([state[3:], acceleration(p.params[0], p.state[0], volt2, *state)])

    start = reference(0.0)[:6]
    end = solve_ivp(motion, (0, 10e-3), start, method="DOP853", rtol=1e-10, atol=1e-14).y[:, -1]
    assert np.abs(end[:3] - reference(10e-3)[:3]).max() < 1e-12
    assert np.abs(end[:3] - start[:3]).max() > 0.9e-6  # it did move


def test_feedback_is_the_gain_times_the_error():
    """Against numpy, with the disturbance cancelled whole; half the share, half of it."""
    gains, rng = tick_law()["feedback"], np.random.default_rng(2)
    for share in (1.0, 0.5, 0.0):
        origin, predicted, reference, out = (
            rng.normal(size=3),
            rng.normal(size=9),
            rng.normal(size=9),
            rng.normal(size=3),
        )
        before = out.copy()
        feedback.add_feedback(gains, origin, predicted, reference, share, out)
        error = origin + predicted[:3] - reference[:3]
        expected = (
            gains["position_gain_n_per_m"] @ error
            + gains["velocity_gain_n_s_per_m"] @ (predicted[3:6] - reference[3:6])
            + predicted[6:9]
        )
        assert out == pytest.approx(before - share * expected, rel=1e-12)


def test_the_ripple_of_held_forces_is_part_of_the_target():
    """A force that grows as a ramp, held for a period at a time at its value in mid-period, moves a free mass; at the
    samples its velocity is not that of the smooth force but off by what ``sampled_target`` says: to 1e-9 of it."""
    gains = tick_law()["feedback"]
    mass, slope, ticks = float(gains["mass_kg"]), 0.3, 400
    mid = (np.arange(ticks) + 0.5) * PERIOD_S
    held = np.concatenate([[0.0], np.cumsum(slope * mid * PERIOD_S / mass)])
    position = np.concatenate([[0.0], np.cumsum(held[:-1] * PERIOD_S + slope * mid * PERIOD_S**2 / (2 * mass))])
    t = np.arange(ticks + 1) * PERIOD_S
    # the smooth motion that agrees with the held one in the mean of position: x = f' t^3 / 6 m + drift t
    drift = np.polyfit(t, position - slope * t**3 / (6 * mass), 1)[0]
    smooth = slope * t**2 / (2 * mass) + drift
    row, out = np.zeros(9), np.zeros(9)
    feedback.sampled_target(gains, row, np.full(3, slope * PERIOD_S), np.zeros(3), out)
    ripple = held - smooth
    assert ripple.std() < 1e-9 * abs(ripple.mean())
    assert out[3:6] == pytest.approx(np.full(3, ripple.mean()), rel=1e-6)
    assert np.array_equal(out[:3], row[:3])
