"""Plans from any state: to a new target, or to a stop, while the stage is moving.

Limits hold for each axis. Where the motion goes beyond them when the plan begins, it is brought inside them first.
ruckig plans; what it plans are pieces of constant jerk, which a kernel samples: a plan with its hundred rows takes some
60 us, which fits between two ticks.
"""

import math

import numpy as np
import ruckig
from numba import njit

from pkxyz_ctrl.trajectory.motion import Array, TrajectoryError
from pkxyz_ctrl.trajectory.segments import Limits

_NEAREST_M = 1e-12
_NO_BOUND = 1e6  # in units of the problem's own size: far larger ones lose ruckig its digits
_PIECES = 10
"""Of an axis: two that bring it inside the limits, seven to its end, and the end."""
_PLANNERS = {axes: ruckig.Ruckig(axes) for axes in (1, 3)}  # keep nothing from plan to plan


class InFlight:
    """A motion as ruckig planned it: it begins in a state, moving or not, and ends at rest."""

    def __init__(self, planned: ruckig.Trajectory, start_m: Array, spans_m: list[float], time_s: float) -> None:
        """``planned`` from the origin, in units of ``spans_m`` of each axis and of a time; of three axes, or of one
        that stands for all.
        """
        self.total_s = planned.duration * time_s
        units = [[[time_s, *(span_m / time_s**order for order in range(4))]] for span_m in spans_m]
        self._pieces = np.array([_pieces_of(axis) for axis in planned.profiles[0]]) * np.array(units)
        self._pieces[:, :, 1] += start_m[:, None]
        self.end_m = self._pieces[:, -1, 1].copy()
        """(3,), where it comes to rest"""

    def rows(self, first: int, step: int, count: int, period_s: float) -> Array:
        """(count, 9) of the rows ``first``, ``first + step``, ..., which are a period apart; before 0 and past the end
        it stands.
        """
        out = np.empty((count, 9))
        _rows(self._pieces, self.total_s, first, step, period_s, out)
        return out


def _pieces_of(axis: ruckig.Profile) -> list[tuple[float, float, float, float, float]]:
    """Begin, position, velocity, acceleration and jerk of each piece of an axis; one that takes no time begins with the
    next.
    """
    before = axis.brake
    at, pieces = before.duration, [(0.0,) * 5] * 2
    if at > 0.0:
        starts = 0.0, before.t[0]
        pieces = list(zip(starts, before.p, before.v, before.a, before.j, strict=True))
    places = axis.p
    for t, p, v, a, j in zip(axis.t, places, axis.v, axis.a, axis.j, strict=False):
        pieces.append((at, p, v, a, j))
        at += t
    return [*pieces, (at, places[-1], 0.0, 0.0, 0.0)]


@njit(cache=True)
def sample(pieces: Array, total_s: float, t_s: float, row: Array) -> None:
    """A row (9,) at an instant of pieces (3, ``_PIECES``, 5)."""
    for axis in range(3):
        last = 0
        for k in range(1, _PIECES):
            if pieces[axis, k, 0] <= t_s:
                last = k
        piece = pieces[axis, last]
        t, a, j = t_s - piece[0], piece[3], piece[4]
        row[axis] = piece[1] + t * (piece[2] + t * (a / 2.0 + t * j / 6.0))
        row[3 + axis] = piece[2] + t * (a + t * j / 2.0) if t_s < total_s else 0.0
        row[6 + axis] = a + t * j if t_s < total_s else 0.0


@njit(cache=True)
def _rows(pieces: Array, total_s: float, first: int, step: int, period_s: float, out: Array) -> None:
    for n in range(len(out)):
        sample(pieces, total_s, max(first + n * step, 0) * period_s, out[n])


def towards(state: Array, target_m: Array, limits: Limits) -> InFlight:
    """Fastest motion from ``state`` (3, 3) to rest at ``target_m`` (3,); the axes arrive together.

    From rest the path is the straight line. Raises ``TrajectoryError`` where ruckig finds no way.
    """
    way_m, velocity, acceleration = (target_m - state[0]).tolist(), state[1].tolist(), state[2].tolist()
    if any(velocity) or any(acceleration):
        problem, length_m, time_s = _problem(way_m, velocity, acceleration, limits)
        problem.synchronization = ruckig.Synchronization.Phase
        problem.target_position = [value / length_m for value in way_m]
        spans_m = [length_m] * 3
    else:  # one axis, the longest, stands for all: no more can be asked for, and planning takes a third of the time
        size_m = max(map(abs, way_m))
        problem, length_m, time_s = _problem([size_m], [0.0], [0.0], limits)
        problem.target_position = [size_m / length_m]
        spans_m = [length_m * (value / size_m) for value in way_m] if size_m else [0.0] * 3
    planned = InFlight(_planned(problem), state[0], spans_m, time_s)
    planned.end_m = target_m.copy()  # without the rounding
    return planned


def to_rest(state: Array, limits: Limits) -> InFlight:
    """Motion from ``state`` (3, 3) to rest, wherever that is, each axis as soon as its limits allow."""
    problem, length_m, time_s = _problem([0.0] * 3, state[1].tolist(), state[2].tolist(), limits)
    problem.control_interface = ruckig.ControlInterface.Velocity
    problem.synchronization = ruckig.Synchronization.No
    return InFlight(_planned(problem), state[0], [length_m] * 3, time_s)


def _problem(
    way_m: list[float], velocity: list[float], acceleration: list[float], limits: Limits
) -> tuple[ruckig.InputParameter, float, float]:
    """The problem in units of its own size, as ruckig's tolerances are absolute; and these units."""
    v, a, j = limits
    axes = len(way_m)
    speed, pull = max(map(abs, velocity)), max(map(abs, acceleration))
    length_m = max(max(map(abs, way_m)), speed**2 / a, pull**3 / j**2, _NEAREST_M)
    time_s = length_m / v + math.sqrt(length_m / a) + (length_m / j) ** (1 / 3)
    problem = ruckig.InputParameter(axes)
    problem.current_velocity = [value * (time_s / length_m) for value in velocity]
    problem.current_acceleration = [value * (time_s**2 / length_m) for value in acceleration]
    problem.max_velocity = [v * time_s / length_m] * axes
    problem.max_acceleration = [min(a * time_s**2 / length_m, _NO_BOUND)] * axes
    problem.max_jerk = [min(j * time_s**3 / length_m, _NO_BOUND)] * axes
    return problem, length_m, time_s


def _planned(problem: ruckig.InputParameter) -> ruckig.Trajectory:
    planned = ruckig.Trajectory(problem.degrees_of_freedom)
    try:
        result = _PLANNERS[problem.degrees_of_freedom].calculate(problem, planned)
    except (ruckig.RuckigError, ValueError) as error:  # ValueError: a result that its Python binding has no name for
        raise TrajectoryError(f"no way there inside these limits: {error}") from None
    if result not in (ruckig.Result.Working, ruckig.Result.Finished):
        raise TrajectoryError(f"no way there inside these limits: {result}")
    return planned
