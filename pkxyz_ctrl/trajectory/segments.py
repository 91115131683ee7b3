"""Segments of a reference: what someone writes in a scenario, each with the plan that it stands for.

A kind of segment is a frozen model with a literal ``kind`` and ``plan(start_m) -> Plan``;
``trajectory.Segment`` lists them.
Every segment starts and ends at rest. Positions are (x, y, z) in m relative to the rest pose.
"""

import math
from typing import Annotated, Literal, NamedTuple

import numpy as np
import ruckig
from pydantic import AfterValidator, Field

from pkxyz_ctrl.config.files import FrozenModel
from pkxyz_ctrl.trajectory.motion import Array, Motion, TrajectoryError
from pkxyz_ctrl.trajectory.pieces import Phases, Pieces, from_phases, still

_LEAST, _MOST = 1e-12, 1e12
_FARTHEST_M = 1e-3
COUNT_MAX = 100_000
"""Lines of a raster, steps of a staircase, ...: half an hour at 60 lines/s, planned in some seconds."""


def far_from_underflow(value: float) -> float:
    """``value`` of 0 or of a magnitude whose cube and whose inverse a float can hold; else ``ValueError``."""
    if value != 0 and not _LEAST <= abs(value) <= _MOST:
        raise ValueError(f"must be between {_LEAST:g} and {_MOST:g}")
    return value


Positive = Annotated[float, Field(gt=0), AfterValidator(far_from_underflow)]
NotNegative = Annotated[float, Field(ge=0, le=_MOST)]
Count = Annotated[int, Field(ge=1, le=COUNT_MAX)]
Coordinate = Annotated[float, Field(ge=-_FARTHEST_M, le=_FARTHEST_M)]
Position = tuple[Coordinate, Coordinate, Coordinate]


class Plan(NamedTuple):
    """What a segment does, in s since its own start."""

    motions: tuple[Motion, ...]
    """one after another"""
    end_m: Array
    """(3,), where it comes to rest"""
    scan_s: tuple[float, float] | None = None
    """when it scans, turn-arounds included: what a tracking error is taken over"""
    lines_s: tuple[tuple[float, float], ...] = ()
    """the parts of the scan at constant velocity"""
    still_s: tuple[float, float] | None = None
    """when it has stood still long enough for noise to be measured"""
    jumps_s: tuple[float, ...] = ()
    """when it jumps: instants at which its position is discontinuous on purpose"""
    highest_hz: float = 0.0
    """the highest frequency of a periodic motion: a check has to look as closely as that"""
    source: str | None = None
    """the file that it was read from"""
    source_sha256: str | None = None
    """its digest"""
    period_s: float | None = None
    """after which the scan repeats itself, if it does"""


class Hold(FrozenModel):
    """Stand still."""

    kind: Literal["hold"]
    duration_s: Positive
    settle_s: NotNegative = 0.03
    """time at the start that hold noise leaves out"""
    measured: bool = True
    """false: this hold doesn't count for hold noise (at the rest pose combs, which only pull, can't regulate)"""

    def plan(self, start_m: Array) -> Plan:
        """One piece; measured from ``settle_s`` on."""
        counts = self.measured and self.settle_s < self.duration_s
        still_s = (self.settle_s, self.duration_s) if counts else None
        return Plan((still(start_m, self.duration_s),), start_m, still_s=still_s)


class Move(FrozenModel):
    """Straight to a point and to rest there, inside limits that hold for each axis."""

    kind: Literal["move"]
    to_m: Position
    velocity_max_m_per_s: Positive
    acceleration_max_m_per_s2: Positive
    jerk_max_m_per_s3: Positive

    def plan(self, start_m: Array) -> Plan:
        """Time-optimal for the axis with the longest way."""
        target = np.array(self.to_m)
        limits = Limits(self.velocity_max_m_per_s, self.acceleration_max_m_per_s2, self.jerk_max_m_per_s3)
        return Plan((straight(start_m, target, limits),), target)


class Limits(NamedTuple):
    """Bounds on the magnitude of each axis' velocity, acceleration and jerk."""

    velocity_m_per_s: float
    acceleration_m_per_s2: float
    jerk_m_per_s3: float


_NEAREST_M = 1e-12
_NO_BOUND = 1e3  # far larger limits lose ruckig its digits, and could save no more than 1/1000 of the time


def travel(start: Array, end: Array, limits: Limits) -> Pieces:
    """Fastest synchronised pieces from one state (3, 3) without acceleration to another, by ruckig.

    The axes arrive together, each inside the limits; the path between is not straight.
    """
    from_rest_to_rest = not start[1:].any() and not end[1:].any()
    if from_rest_to_rest and float(np.abs(end[0] - start[0]).max()) < _NEAREST_M:
        raise TrajectoryError("goes nowhere: the target is where the stage already stands; use a hold instead")
    axes, total_s = _fastest(end[0] - start[0], start[1], end[1], end[2], limits)
    return from_phases(start, axes, total_s)


def straight(
    start_m: Array, end_m: Array, limits: Limits, speed_start_m_per_s: float = 0.0, speed_end_m_per_s: float = 0.0
) -> Pieces:
    """Fastest pieces along the line between two points (3,) from one speed to another, no acceleration at the ends.

    The limits hold for each axis.
    """
    way = end_m - start_m
    length_m = float(np.linalg.norm(way))
    if length_m < _NEAREST_M:
        raise TrajectoryError("goes nowhere: the target is where the stage already stands; use a hold instead")
    along = way / length_m
    bounds = Limits(*(limit / float(np.abs(along).max()) for limit in limits))
    speeds = np.array([[speed_start_m_per_s], [speed_end_m_per_s]])
    (path,), total_s = _fastest(np.array([length_m]), speeds[0], speeds[1], np.zeros(1), bounds)
    axes = [Phases(path.duration_s, [j * u for j in path.jerk_m_per_s3]) for u in along.tolist()]
    return from_phases(np.array([start_m, along * speed_start_m_per_s, np.zeros(3)]), axes, total_s)


def _fastest(
    way_m: Array, velocity_start: Array, velocity_end: Array, acceleration_end: Array, limits: Limits
) -> tuple[list[Phases], float]:
    """Jerk phases of each axis, and their time, by ruckig.

    ruckig's tolerances are absolute, near 1e-8, and it refuses times above 7600: it gets the problem in units of the
    problem's own size.
    """
    v, a, j = limits
    count = len(way_m)
    length_m = max(
        float(np.abs(way_m).max()),
        float(np.abs([velocity_start, velocity_end]).max()) ** 2 / a,
        float(np.abs(acceleration_end).max()) ** 3 / j**2,
    )
    time_s = length_m / v + math.sqrt(length_m / a) + (length_m / j) ** (1 / 3)
    problem = ruckig.InputParameter(count)
    problem.target_position = list(way_m / length_m)
    problem.current_velocity = list(velocity_start * time_s / length_m)
    problem.target_velocity = list(velocity_end * time_s / length_m)
    problem.target_acceleration = list(acceleration_end * time_s**2 / length_m)
    problem.max_velocity = [v * time_s / length_m] * count
    problem.max_acceleration = [min(a * time_s**2 / length_m, _NO_BOUND)] * count
    problem.max_jerk = [min(j * time_s**3 / length_m, _NO_BOUND**2)] * count
    planned = ruckig.Trajectory(count)
    try:
        ruckig.Ruckig(count).calculate(problem, planned)
    except (ruckig.RuckigError, ValueError) as error:  # ValueError: a result that its Python binding has no name for
        raise TrajectoryError(f"no way there inside these limits: {error}") from None
    unit_jerk = length_m / time_s**3
    axes = [Phases([t * time_s for t in axis.t], [k * unit_jerk for k in axis.j]) for axis in planned.profiles[0]]
    return axes, planned.duration * time_s
