"""What the combs hold: against the stage's own methods, and against the check of trajectories."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_rig import stage

from hil.operate.reach import Reach
from pkxyz_ctrl.stage import StageDomainError
from pkxyz_ctrl.trajectory.check import DriveLimits, within_limits
from pkxyz_ctrl.trajectory.comb_forces import comb_forces

DRIVE = DriveLimits(200.0, 100e3, 200)
REACH = Reach(stage(), DRIVE)
coordinates = st.integers(-300_000, 400_000).map(lambda n: n * 1e-10)  # nothing within rounding of a limit
positions = st.tuples(coordinates, coordinates, coordinates).map(np.array)


def is_held(position: np.ndarray) -> bool:
    """By the methods of the stage, one by one."""
    device = stage()
    try:
        strokes = device.inverse_kinematics(position)
        device.holding_voltages(position)
    except StageDomainError:
        return False
    limits = device.config.limits
    return bool((strokes >= limits.stroke_min_m).all() and (strokes <= limits.stroke_max_m).all())


@settings(max_examples=300)
@given(positions)
def test_what_is_held_is_what_the_stage_says(position):
    assert REACH.holds(position) == is_held(position)
    assert (REACH.target_refusal(position) is None) == REACH.holds(position)


@settings(max_examples=100)
@given(st.integers(0, 2), st.sampled_from([-1.0, 1.0]), st.floats(1e-6, 35e-6))
def test_the_farthest_is_held_and_a_nanometre_more_is_not(axis, direction, z_m):
    start = np.array([0.0, 0.0, z_m])
    step = np.zeros(3)
    step[axis] = direction
    far_m = REACH.farthest(start, axis, direction)
    assert REACH.holds(start + far_m * step)
    assert not REACH.holds(start + (far_m + 1e-9) * step)


@settings(max_examples=200)
@given(st.integers(0, 10_000))
def test_motions_are_judged_as_trajectories_are(seed):
    """Random short motions about the middle, some too fast, some too far out."""
    rng = np.random.default_rng(seed)
    t = np.arange(40) * 200e-6
    amplitude, omega = rng.uniform(0, 14e-6, 3), rng.uniform(0, 2e3)
    rows = np.concatenate(
        [
            np.array([0, 0, 18e-6]) + amplitude * np.sin(omega * t)[:, None],
            amplitude * omega * np.cos(omega * t)[:, None],
            -amplitude * omega**2 * np.sin(omega * t)[:, None],
        ],
        axis=1,
    )
    assert (REACH.motion_refusal(rows) is None) == within_limits(stage(), rows, DRIVE)


def test_refusals_name_axis_value_unit_and_limit():
    words = REACH.target_refusal(np.array([20e-6, 0.0, 18e-6]))
    assert words is not None
    for part in ("(20, 0, 18) um", "x = 20 um", "-13.51 to 13.51 um", "y = 0, z = 18 um"):
        assert part in words
    words = REACH.target_refusal(np.array([0.0, 0.0, 37.99e-6]))
    assert words is not None
    assert "limits 0 to 36.99 um" in words
    low = Reach(stage(), DriveLimits(150.0, 100e3, 200)).target_refusal(np.array([0.0, 0.0, 30e-6]))
    assert low is not None
    assert "limit 150 V" in low


def test_a_motion_that_would_push_says_where_and_by_how_much():
    rows = np.zeros((3, 9))
    rows[:, 2] = 5e-6
    rows[:, 8] = -3000.0
    force = comb_forces(stage(), rows[0:1])[0]
    words = REACH.motion_refusal(rows)
    assert words is not None
    assert f"push with {-force.min() * 1e6:.3g} uN" in words
    assert "(0, 0, 5) um" in words


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_is_refused(bad):
    assert REACH.target_refusal(np.array([0.0, bad, 0.0])) is not None
    assert REACH.motion_refusal(np.full((2, 9), bad)) is not None
