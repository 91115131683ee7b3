"""Segments of a reference: what someone writes in a scenario, each with the plan that it stands for.

A kind of segment is a frozen model with a literal ``kind`` and ``plan(start_m) -> Plan``;
``trajectory.Segment`` lists them.
Every segment starts and ends at rest. Positions are (x, y, z) in m relative to the rest pose.
"""

import math
from typing import Annotated, Literal, NamedTuple

import numpy as np
import ruckig
from pydantic import Field

from pkxyz_ctrl.config import FrozenModel
from pkxyz_ctrl.trajectory.pieces import Array, Phases, Pieces, TrajectoryError, at_rest, from_phases, still

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Position = tuple[float, float, float]


class Plan(NamedTuple):
    """What a segment does, in s since its own start."""

    pieces: Pieces
    end_m: Array
    """(3,), where it comes to rest"""
    scan_s: tuple[float, float] | None = None
    """when it scans, turn-arounds included: what a tracking error is taken over"""
    lines_s: tuple[tuple[float, float], ...] = ()
    """the parts of the scan at constant velocity"""
    still_s: tuple[float, float] | None = None
    """when it has stood still long enough for noise to be measured"""


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
        return Plan(still(start_m, self.duration_s), start_m, still_s=still_s)


class Move(FrozenModel):
    """Straight to a point and to rest there, the axes in step, inside limits that hold for each axis."""

    kind: Literal["move"]
    to_m: Position
    velocity_max_m_per_s: Positive
    acceleration_max_m_per_s2: Positive
    jerk_max_m_per_s3: Positive

    def plan(self, start_m: Array) -> Plan:
        """Time-optimal for the slowest axis; the others are stretched to arrive with it."""
        target = np.array(self.to_m)
        limits = Limits(self.velocity_max_m_per_s, self.acceleration_max_m_per_s2, self.jerk_max_m_per_s3)
        return Plan(travel(at_rest(start_m), at_rest(target), limits), target)


class Limits(NamedTuple):
    """Bounds on the magnitude of each axis' velocity, acceleration and jerk."""

    velocity_m_per_s: float
    acceleration_m_per_s2: float
    jerk_m_per_s3: float


_NEAREST_M = 1e-12
_NO_BOUND = 1e3  # far larger limits lose ruckig its digits, and could save no more than 1/1000 of the time


def travel(start: Array, end: Array, limits: Limits) -> Pieces:
    """Fastest synchronised pieces from one state (3, 3) to another with zero acceleration at both, by ruckig.

    ruckig's tolerances are absolute, near 1e-8, and it refuses times above 7600: it gets the problem in units of the
    problem's own size.
    """
    v, a, j = limits
    distance_m = float(np.abs(end[0] - start[0]).max())
    if distance_m < _NEAREST_M and not start[1:].any() and not end[1:].any():
        raise TrajectoryError("goes nowhere: the target is where the stage already stands; use a hold instead")
    length_m = max(distance_m, float(np.abs([start[1], end[1]]).max()) ** 2 / a)
    time_s = length_m / v + math.sqrt(length_m / a) + (length_m / j) ** (1 / 3)
    problem = ruckig.InputParameter(3)
    problem.target_position = list((end[0] - start[0]) / length_m)
    problem.current_velocity = list(start[1] * time_s / length_m)
    problem.target_velocity = list(end[1] * time_s / length_m)
    problem.max_velocity = [v * time_s / length_m] * 3
    problem.max_acceleration = [min(a * time_s**2 / length_m, _NO_BOUND)] * 3
    problem.max_jerk = [min(j * time_s**3 / length_m, _NO_BOUND**2)] * 3
    planned = ruckig.Trajectory(3)
    try:
        ruckig.Ruckig(3).calculate(problem, planned)
    except (ruckig.RuckigError, ValueError) as error:  # ValueError: a result that its Python binding has no name for
        raise TrajectoryError(f"no way there inside these limits: {error}") from None
    unit_jerk = length_m / time_s**3
    axes = [Phases([t * time_s for t in axis.t], [k * unit_jerk for k in axis.j]) for axis in planned.profiles[0]]
    return from_phases(start, axes, planned.duration * time_s)
