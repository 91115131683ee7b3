"""In position is said of the truth: ten thousand settles of random steps, each decision beside the true position."""

import dataclasses

import numpy as np
import pytest
from loop_rig import rows_of
from numba import njit

from hil.runs.scenario import load_scenario
from pkxyz_ctrl.loop.in_position import IN_POSITION, look
from pkxyz_ctrl.trajectory import Hold, Move, Steps, Trajectory

SETTLES, DWELL_S, STEP_S = 10_000, 2e-3, 8e-3
LIMITS = {"velocity_max_m_per_s": 0.5e-3, "acceleration_max_m_per_s2": 0.5, "jerk_max_m_per_s3": 300.0}


def settles(seed: int) -> Trajectory:
    """Jumps of up to 0.3 um in each axis, there and back, about places all over the middle of the workspace."""
    rng = np.random.default_rng(seed)
    segments = [Hold(kind="hold", duration_s=0.02, measured=False)]
    for _ in range(50):
        place = rng.uniform(-4e-6, 4e-6, 3) + (0.0, 0.0, 18e-6)
        segments += [Move(kind="move", to_m=tuple(place), **LIMITS), Hold(kind="hold", duration_s=0.01)]
        for by in rng.uniform(-0.3e-6, 0.3e-6, (SETTLES // 100, 3)):
            segments.append(Steps(kind="steps", by_m=tuple(by), count=1, dwell_s=STEP_S))
    return Trajectory(segments)


@njit(cache=True)
def decided(rows, gain, window_m, sigmas, dwell_ticks, begins, ticks, said, was):
    """Ticks after each jump until the window has been kept for the dwell: as said, and as it was in truth; -1: never."""
    state = np.zeros(1, IN_POSITION)
    jump = 0
    true_ticks = 0
    for n in range(len(rows)):
        row = rows[n]
        target = row["reference_m"]
        count = look(state[0], gain, target, row["estimate_m"], row["innovation_m"], window_m, sigmas)
        inside = True
        for i in range(3):
            inside = inside and abs(row["position_m"][i] - target[i]) <= window_m
        true_ticks = true_ticks + 1 if inside else 0
        while jump + 1 < len(begins) and n >= begins[jump + 1]:
            jump += 1
        since = n - begins[jump]
        if since < 0 or since >= ticks:
            continue
        if since == 0:
            said[jump], was[jump] = -1, -1
            true_ticks = 0 if not inside else true_ticks
        if said[jump] == -1 and count >= dwell_ticks:
            said[jump] = since if inside else -2
        if was[jump] == -1 and true_ticks >= dwell_ticks:
            was[jump] = since


@pytest.mark.slow
@pytest.mark.parametrize(("plant", "window_m"), [("nominal", 5e-9), ("mild", 8e-9), ("lab", 12e-9)])
def test_of_ten_thousand_settles_none_is_said_that_is_not(plant, window_m):
    scenario = load_scenario("steps", controller="youla", plant=plant, bus="fd_5k")
    trajectory = settles(7)
    run = dataclasses.replace(
        scenario.setup(), trajectory=trajectory, duration_s=trajectory.duration_us * 1e-6 + 0.3, learning=None
    )
    rows, _ = rows_of(run, "fast")
    assert not rows["trips"].any()
    period_s = run.bus.period_s
    jumps = np.abs(np.diff(rows["reference_m"], axis=0)).max(axis=1)
    begins = np.flatnonzero((jumps > 5e-9) & (rows["estimate_m"].shape[0] > 0)) + 1
    known_us = np.concatenate([s.jumps_us for s in trajectory.segments if s.jumps_us])
    tracking = rows["reference_tick"]
    begins = np.searchsorted(tracking, -(-known_us // run.bus.period_us))
    assert len(begins) >= SETTLES
    said, was = np.full(len(begins), -1), np.full(len(begins), -1)
    gain = np.ascontiguousarray(run.law["tick"]["estimator"]["gain"][0])
    ticks = round(STEP_S / period_s) - 1
    decided(rows, gain, window_m, 3.0, round(DWELL_S / period_s), begins, ticks, said, was)
    both = (said >= 0) & (was >= 0)
    print(plant, "false", (said == -2).sum(), "never said", (said == -1).sum(), "never true", (was == -1).sum(),
          "median said", np.median(said[both]) * period_s * 1e3, "true", np.median(was[both]) * period_s * 1e3)
    assert (said != -2).all(), f"{(said == -2).sum()} false"
    assert np.median(said[both]) <= 1.3 * np.median(was[both])
    assert both.mean() > 0.9
