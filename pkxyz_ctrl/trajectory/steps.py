"""Steps, which jump, and staircases, which don't."""

from typing import Literal, Self

import numpy as np
from pydantic import model_validator

from pkxyz_ctrl.config.files import FrozenModel
from pkxyz_ctrl.trajectory.motion import Array
from pkxyz_ctrl.trajectory.pieces import joined, still
from pkxyz_ctrl.trajectory.segments import Count, Limits, NotNegative, Plan, Position, Positive, straight


class Steps(FrozenModel):
    """There and back in jumps, standing still after each: a test of the loop, not a path that a stage could follow.

    The only reference with a discontinuous position. Its velocity and acceleration are 0 throughout, so feed-forward
    doesn't see the jump, and a check of the slew limit leaves its jumps out.
    """

    kind: Literal["steps"]
    by_m: Position
    """from where it stands to the other end"""
    count: Count = 1
    """how often there and back"""
    dwell_s: Positive
    """before the first jump, and after each"""

    @model_validator(mode="after")
    def _moves(self) -> Self:
        _refuse_nowhere(self.by_m, "by_m")
        return self

    def plan(self, start_m: Array) -> Plan:
        """The scan begins with the first jump."""
        stands = [start_m, *[start_m + np.array(self.by_m), start_m] * self.count]
        jumps_s = tuple(n * self.dwell_s for n in range(1, len(stands)))
        pieces = joined([still(position, self.dwell_s) for position in stands])
        return Plan((pieces,), start_m, scan_s=(self.dwell_s, len(stands) * self.dwell_s), jumps_s=jumps_s)


class Staircase(FrozenModel):
    """Equal jerk-limited steps one way, and back again, standing still on each tread."""

    kind: Literal["staircase"]
    step_m: Position
    steps: Count
    """one way"""
    dwell_s: Positive
    settle_s: NotNegative = 0.0
    """time at the start of each tread that ``lines_us`` leaves out"""
    there_and_back: bool = True
    velocity_max_m_per_s: Positive
    """limits hold for each axis"""
    acceleration_max_m_per_s2: Positive
    jerk_max_m_per_s3: Positive

    @model_validator(mode="after")
    def _moves(self) -> Self:
        if self.settle_s >= self.dwell_s:
            raise ValueError(f"settle_s is {self.settle_s:g}, so nothing is left of the dwell_s of {self.dwell_s:g}")
        _refuse_nowhere(self.step_m, "step_m")
        return self

    def plan(self, start_m: Array) -> Plan:
        """The scan is all of it; its lines, at constant velocity 0, are the settled treads."""
        limits = Limits(self.velocity_max_m_per_s, self.acceleration_max_m_per_s2, self.jerk_max_m_per_s3)
        levels = [*range(1, self.steps + 1)]
        levels += [*reversed(range(self.steps))] if self.there_and_back else []
        parts, lines, at, t_s = [], [], start_m, 0.0
        for level in levels:
            to = start_m + level * np.array(self.step_m)
            rise = straight(at, to, limits)
            parts += [rise, still(to, self.dwell_s)]
            t_s += rise.total_s + self.dwell_s
            lines.append((t_s - self.dwell_s + self.settle_s, t_s))
            at = to
        return Plan((joined(parts),), at, scan_s=(0.0, t_s), lines_s=tuple(lines))


def _refuse_nowhere(way: Position, name: str) -> None:
    if not any(way):
        raise ValueError(f"{name} is zero, so nothing would move; use a hold instead")
