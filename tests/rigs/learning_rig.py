"""Runs that learn: a small raster, scanned again and again at mid-workspace."""

import dataclasses
from functools import cache

import numpy as np
from loop_rig import bus, controller, rows_of

from hil.lanes.setup import Setup, bare_setup
from hil.runs.period_errors import PeriodErrors
from pkxyz_ctrl.learning import LearningConfig
from pkxyz_ctrl.trajectory import Hold, Move, Raster, Trajectory

LEARN = LearningConfig()
LINES = 4
PERIOD = 100 * LINES  # ticks at 5 kHz and 50 lines/s


@cache
def trajectory(frames: int = 9, pitch_m: float = 0.3e-6) -> Trajectory:
    """10 um lines at 50 lines/s."""
    return Trajectory([
        Move(
            kind="move", to_m=(0.0, 0.0, 19.2495e-6), velocity_max_m_per_s=1e-3, acceleration_max_m_per_s2=0.2,
            jerk_max_m_per_s3=50.0,
        ),
        Hold(kind="hold", duration_s=0.1),
        Raster(
            kind="raster", line_length_m=10e-6, lines=LINES, line_pitch_m=pitch_m, frames=frames, line_rate_hz=50.0,
            velocity_max_m_per_s=2e-3, acceleration_max_m_per_s2=1.0, jerk_max_m_per_s3=500.0,
        ),
    ])  # fmt: skip


@cache
def setup(plant: str = "harsh", seed: int = 1, frames: int = 9, learning: LearningConfig | None = LEARN) -> Setup:
    """``learning`` None: the same run without."""
    scan = trajectory(frames)
    bare = bare_setup("reconstructed", plant, controller(), bus(), seed)
    return dataclasses.replace(
        bare, trajectory=scan, duration_s=scan.duration_us * 1e-6 + 0.06, learning=learning, seed=seed
    )


def errors_of(run_setup: Setup, lane: str = "fast"):
    """Errors by period, the learner, and the rows."""
    rows, result = rows_of(run_setup, lane)
    errors = PeriodErrors(run_setup.trajectory, run_setup.bus.period_us, run_setup.learning or LEARN)
    for block in np.array_split(rows, 7):
        errors.update(block)
    assert result.faults == ()
    return errors, result.learner, rows
