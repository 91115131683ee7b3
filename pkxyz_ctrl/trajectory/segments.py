"""Segments of a reference: what someone writes in a scenario, each with the plan that it stands for.

A kind of segment is a frozen model with a literal ``kind`` and ``plan(start_m) -> Plan``; ``trajectory.Segment`` lists them.
Every segment starts and ends at rest. Positions are (x, y, z) in m relative to the rest pose.
"""

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


_UM = 1e6  # ruckig's tolerances are absolute, near 1e-8: it plans in um and ms, where numbers here are of order one
_MS = 1e3


def travel(start: Array, end: Array, limits: Limits) -> Pieces:
    """Fastest synchronised pieces from one state (3, 3) to another with zero acceleration at both, by ruckig."""
    if np.array_equal(start, end) and not start[1:].any():
        raise TrajectoryError("move goes nowhere: the target is where the stage already stands; use a hold instead")
    problem = ruckig.InputParameter(3)
    problem.current_position, problem.target_position = list(start[0] * _UM), list(end[0] * _UM)
    problem.current_velocity, problem.target_velocity = list(start[1] * _UM / _MS), list(end[1] * _UM / _MS)
    problem.max_velocity = [limits.velocity_m_per_s * _UM / _MS] * 3
    problem.max_acceleration = [limits.acceleration_m_per_s2 * _UM / _MS**2] * 3
    problem.max_jerk = [limits.jerk_m_per_s3 * _UM / _MS**3] * 3
    planned = ruckig.Trajectory(3)
    try:
        result = ruckig.Ruckig(3).calculate(problem, planned)
    except ruckig.RuckigError as error:
        raise TrajectoryError(f"no move inside these limits: {error}") from None
    if result != ruckig.Result.Working:
        raise TrajectoryError(f"no move inside these limits: ruckig says {result}")
    axes = [
        Phases([t / _MS for t in profile.t], [j * _MS**3 / _UM for j in profile.j]) for profile in planned.profiles[0]
    ]
    return from_phases(start, axes, planned.duration / _MS)
