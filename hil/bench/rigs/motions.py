"""Motions about mid-workspace, run in the fast lane: the reference, and the truth beside it."""

import dataclasses
import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.bench.rigs.places import setup_at
from hil.lanes import in_process as lanes
from hil.lanes.lane import Lane
from hil.lanes.setup import Setup
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.trajectory import Hold, Move, TimedSegment, Trajectory

MIDDLE_M = 19.2495e-6
"""Height at which all strokes are 12.5 um."""
GENTLE = {"velocity_max_m_per_s": 0.5e-3, "acceleration_max_m_per_s2": 0.05, "jerk_max_m_per_s3": 10.0}
START_S = 0.065
"""Power-on to tracking: homing and what is around it."""


class Run(NamedTuple):
    """What came of a motion."""

    rows: NDArray[np.void]
    """while tracking, from the start of the trajectory"""
    segments: tuple[TimedSegment, ...]
    """those that were asked for"""
    period_us: int

    def during(self, window_us: tuple[int, int]) -> NDArray[np.void]:
        """Rows of [begin, end) in us of the trajectory."""
        first, end = (-(-t // self.period_us) for t in window_us)
        return self.rows[first:end]

    def scan(self, index: int) -> NDArray[np.void]:
        """Rows of the scan of a segment."""
        window = self.segments[index].scan_us
        assert window is not None
        return self.during(window)


@cache
def _setup(controller: str, place: str) -> Setup:
    return setup_at("raster", place, controller)


def setup_of(segments: list[Any], controller: str, place: str, height_m: float) -> tuple[Setup, int]:
    """A run at one of the ``places``: the approach to a height and ``segments`` after it, and how many segments the
    approach has.
    """
    approach: list[Any] = [
        Hold(kind="hold", duration_s=0.02, measured=False),
        Move(kind="move", to_m=(0.0, 0.0, height_m), **GENTLE),
        Hold(kind="hold", duration_s=0.05),
    ]
    trajectory = Trajectory([*approach, *segments])
    duration_s = trajectory.duration_us * 1e-6 + START_S
    return dataclasses.replace(_setup(controller, place), trajectory=trajectory, duration_s=duration_s), len(approach)


def run(segments: list[Any], controller: str = "lqg", place: str = "nominal", height_m: float = MIDDLE_M) -> Run:
    """Move to a height on the axis and go through ``segments`` there. Raises ``ConfigError`` where that faults."""
    setup, first = setup_of(segments, controller, place, height_m)
    return Run(rows_of_setup(setup), setup.trajectory.segments[first:], setup.bus.period_us)


def rows_of_setup(setup: Setup) -> NDArray[np.void]:
    """Rows of a run while it tracks. Raises ``ConfigError`` where it faults."""
    blocks: list[NDArray[np.void]] = []
    result = lanes.run(setup, Lane.FAST, on_block=lambda block: blocks.append(block.copy()))
    if result.faults:
        raise ConfigError(f"{setup.controller.name} on {setup.plant.name}: {result.faults[0]}")
    rows = np.concatenate(blocks)
    return np.asarray(rows[rows["reference_tick"] >= 0])


def error_m(rows: NDArray[np.void]) -> NDArray[np.float64]:
    """True position less reference (n,3)."""
    return np.asarray(rows["position_m"] - rows["reference_m"])


def settled_s(rows: NDArray[np.void], axis: int, band_m: float, period_s: float) -> float:
    """Time from the first row until the true position of an axis stays within a band about the last reference; infinite
    if it never does.
    """
    off = np.abs(rows["position_m"][:, axis] - rows["reference_m"][-1, axis]) > band_m
    if off[-1]:
        return math.inf
    return float((np.flatnonzero(off)[-1] + 1) * period_s) if off.any() else 0.0
