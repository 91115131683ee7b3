"""Plans from any state: they begin there, keep the limits and end at rest where they should."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pkxyz_ctrl.trajectory import in_flight
from pkxyz_ctrl.trajectory.in_flight import to_rest, towards
from pkxyz_ctrl.trajectory.segments import Limits

LIMITS = Limits(0.5e-3, 0.5, 300.0)
PERIOD_S = 1e-5


def three(most: float) -> st.SearchStrategy[tuple[float, float, float]]:
    one = st.floats(-most, most)
    return st.tuples(one, one, one)


states = st.tuples(three(10e-6), three(0.4e-3), three(0.1)).map(np.array)


def at(motion, t_s):
    rows = np.empty((len(t_s), 9))
    for t, row in zip(t_s, rows, strict=True):
        in_flight.sample(motion._pieces, motion.total_s, t, row)
    return rows


def sampled(motion):
    return at(motion, np.append(np.arange(0, motion.total_s, PERIOD_S), motion.total_s))


@settings(max_examples=80)
@given(states, three(10e-6).map(np.array))
def test_a_new_target_is_reached_from_any_state_inside_the_limits(state, target):
    motion = towards(state, target, LIMITS)
    rows = sampled(motion)
    assert np.allclose(rows[0].reshape(3, 3), state, rtol=1e-9, atol=[[1e-15], [1e-12], [1e-8]])
    assert np.allclose(rows[-1, 0:3], target, atol=2e-13, rtol=0)
    assert (rows[-1, 3:] == 0).all()
    assert np.array_equal(motion.end_m, target)
    assert np.abs(rows[:, 3:6]).max() <= LIMITS.velocity_m_per_s * (1 + 1e-6)
    assert np.abs(rows[:, 6:9]).max() <= LIMITS.acceleration_m_per_s2 * (1 + 1e-6)
    jerk = np.abs(np.diff(rows[:-1, 6:9], axis=0)) / PERIOD_S
    assert not len(jerk) or jerk.max() <= LIMITS.jerk_m_per_s3 * (1 + 1e-4)


@settings(max_examples=60)
@given(states)
def test_a_stop_comes_to_rest_and_stays(state):
    motion = to_rest(state, LIMITS)
    rows = sampled(motion)
    last = LIMITS.jerk_m_per_s3 * PERIOD_S**2 / 2  # a step before the end
    assert np.allclose(rows[-2:, 3:6], 0, atol=last * 1.01)
    assert np.allclose(rows[-1, 0:3], motion.end_m, atol=1e-15)
    assert np.allclose(at(motion, [motion.total_s + 1.0]), rows[-1:], rtol=0, atol=1e-18)
    assert motion.total_s <= 0.02


@given(three(10e-6).map(np.array), three(10e-6).map(np.array))
def test_from_rest_the_way_is_straight(start, target):
    rows = sampled(towards(np.array([start, np.zeros(3), np.zeros(3)]), target, LIMITS))
    way = target - start
    if np.abs(way).max() < 1e-9:
        return
    share = (rows[:, 0:3] - start) @ way / (way @ way)
    assert np.allclose(rows[:, 0:3], start + share[:, None] * way, atol=1e-12)


def test_rows_are_periods_apart_and_stand_before_and_behind():
    motion = towards(np.zeros((3, 3)), np.array([1e-6, -2e-6, 3e-6]), LIMITS)
    rows = motion.rows(-4, 2, 60, 2e-4)
    assert np.array_equal(rows, at(motion, np.maximum(np.arange(-4, 116, 2), 0) * 2e-4))
    assert (rows[:3] == 0).all()
    assert np.allclose(rows[-1], [*motion.end_m, *np.zeros(6)], rtol=0, atol=1e-18)


def test_a_state_faster_than_the_limits_is_brought_inside_them():
    slow = Limits(0.1e-3, 0.5, 300.0)
    state = np.array([[0.0, 0.0, 0.0], [0.4e-3, 0.0, 0.0], [0.0, 0.0, 0.0]])
    rows = sampled(towards(state, np.array([20e-6, 0.0, 0.0]), slow))
    assert rows[:, 3].max() <= 0.4e-3 * (1 + 1e-9)
    assert np.allclose(rows[-1, 0:3], [20e-6, 0, 0], atol=1e-12)
    assert (rows[len(rows) // 2 :, 3] <= 0.1e-3 * (1 + 1e-6)).all()


@settings(max_examples=60)
@given(states, three(10e-6).map(np.array))
def test_rows_are_those_that_ruckig_itself_samples(state, target):
    """ruckig's ``at_time``, in its own units, at whole periods, at the ends of pieces and between."""
    planned = []

    class Kept(in_flight.InFlight):
        def __init__(self, trajectory, start_m, spans_m, time_s):
            planned.append((trajectory, start_m, np.array(spans_m), time_s))
            super().__init__(trajectory, start_m, spans_m, time_s)

    rest = state * [[1.0], [0.0], [0.0]]
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(in_flight, "InFlight", Kept)
        motions = towards(state, target, LIMITS), to_rest(state, LIMITS), towards(rest, target, LIMITS)
    for motion, (trajectory, start_m, spans_m, time_s) in zip(motions, planned, strict=True):
        ends = np.unique(np.clip(motion._pieces[:, :, 0], 0.0, motion.total_s))
        t_s = np.sort(np.concatenate([np.arange(0.0, motion.total_s, 1e-4), ends, np.nextafter(ends, 0.0)]))
        if motion.total_s == 0.0:  # it is there
            is_there = motion is motions[2] and np.abs(target - state[0]).max() < 1e-30
            assert is_there or np.abs(state[1:]).max() < 1e-30
            continue
        theirs = np.array([trajectory.at_time(t / time_s) for t in t_s[t_s < motion.total_s]])  # (n, 3, axes)
        theirs = (theirs * spans_m / np.array([[1.0], [time_s], [time_s**2]])).reshape(-1, 9)
        theirs[:, 0:3] += start_m
        ours = at(motion, t_s)[t_s < motion.total_s]
        assert np.allclose(ours[:, 0:3], theirs[:, 0:3], rtol=0, atol=1e-12 * np.abs(spans_m).max() + 1e-20)
        assert np.allclose(ours[:, 3:6], theirs[:, 3:6], rtol=0, atol=1e-10 * LIMITS.velocity_m_per_s)
        assert np.allclose(ours[:, 6:9], theirs[:, 6:9], rtol=0, atol=1e-9 * LIMITS.acceleration_m_per_s2)
