"""Plans from any state: to a new target, or to a stop, while the stage is moving.

Limits hold for each axis. Where the motion goes beyond them when the plan begins, it is brought inside them first.
A plan takes some 30 us, which fits between two ticks.
"""

import math

import numpy as np
import ruckig

from pkxyz_ctrl.trajectory.motion import Array, TrajectoryError, at_rest
from pkxyz_ctrl.trajectory.segments import Limits

_NEAREST_M = 1e-12
_NO_BOUND = 1e6  # in units of the problem's own size: far larger ones lose ruckig its digits


class InFlight:
    """A ``Motion`` as ruckig planned it: it begins in a state, moving or not, and ends at rest."""

    def __init__(self, planned: ruckig.Trajectory, start_m: Array, length_m: float, time_s: float) -> None:
        """``planned`` from the origin, in units of a length and a time."""
        self._planned = planned
        self._start_m = start_m
        self._time_s = time_s
        self._units = np.repeat([length_m, length_m / time_s, length_m / time_s**2], 3)
        self.total_s = planned.duration * time_s
        end, _, _ = planned.at_time(planned.duration)
        self.end_m = start_m + length_m * np.array(end)
        """(3,), where it comes to rest"""

    def end(self) -> Array:
        """At rest."""
        return at_rest(self.end_m)

    def sample(self, t_s: Array) -> Array:
        """(n, 9) at instants (n,); past the end it stands."""
        at_time, duration, time_s = self._planned.at_time, self._planned.duration, self._time_s
        out = np.empty((len(t_s), 9))
        for row, t in zip(out, t_s.tolist(), strict=True):
            u = t / time_s
            p, v, a = at_time(u if u < duration else duration)
            row[:] = (*p, *v, *a)
        out *= self._units
        out[:, 0:3] += self._start_m
        out[t_s >= self.total_s, 3:9] = 0.0
        return out


def towards(state: Array, target_m: Array, limits: Limits) -> InFlight:
    """Fastest motion from ``state`` (3, 3) to rest at ``target_m`` (3,); the axes arrive together.

    From rest the path is the straight line. Raises ``TrajectoryError`` where ruckig finds no way.
    """
    way = target_m - state[0]
    problem, length_m, time_s = _problem(state, way, limits)
    problem.target_position = list(way / length_m)
    problem.synchronization = ruckig.Synchronization.Phase
    planned = _planned(problem, state, length_m, time_s)
    planned.end_m = target_m.copy()  # without the rounding
    return planned


def to_rest(state: Array, limits: Limits) -> InFlight:
    """Motion from ``state`` (3, 3) to rest, wherever that is, each axis as soon as its limits allow."""
    problem, length_m, time_s = _problem(state, np.zeros(3), limits)
    problem.control_interface = ruckig.ControlInterface.Velocity
    problem.synchronization = ruckig.Synchronization.No
    return _planned(problem, state, length_m, time_s)


def _problem(state: Array, way_m: Array, limits: Limits) -> tuple[ruckig.InputParameter, float, float]:
    """The problem in units of its own size, as ruckig's tolerances are absolute; and these units."""
    v, a, j = limits
    speed, pull = float(np.abs(state[1]).max()), float(np.abs(state[2]).max())
    length_m = max(float(np.abs(way_m).max()), speed**2 / a, pull**3 / j**2, _NEAREST_M)
    time_s = length_m / v + math.sqrt(length_m / a) + (length_m / j) ** (1 / 3)
    problem = ruckig.InputParameter(3)
    problem.current_velocity = list(state[1] * (time_s / length_m))
    problem.current_acceleration = list(state[2] * (time_s**2 / length_m))
    problem.max_velocity = [v * time_s / length_m] * 3
    problem.max_acceleration = [min(a * time_s**2 / length_m, _NO_BOUND)] * 3
    problem.max_jerk = [min(j * time_s**3 / length_m, _NO_BOUND)] * 3
    return problem, length_m, time_s


def _planned(problem: ruckig.InputParameter, state: Array, length_m: float, time_s: float) -> InFlight:
    planned = ruckig.Trajectory(3)
    try:
        result = ruckig.Ruckig(3).calculate(problem, planned)
    except (ruckig.RuckigError, ValueError) as error:  # ValueError: a result that its Python binding has no name for
        raise TrajectoryError(f"no way there inside these limits: {error}") from None
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise TrajectoryError(f"no way there inside these limits: {result}")
    return InFlight(planned, state[0].copy(), length_m, time_s)
