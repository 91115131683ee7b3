"""Waypoints: a list of points joined by straight lines, with a stop at each or with corners rounded off."""

import math
from collections.abc import Callable
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from pkxyz_ctrl.config import FrozenModel
from pkxyz_ctrl.trajectory.motion import Array, TrajectoryError
from pkxyz_ctrl.trajectory.pieces import Phases, Pieces, from_phases, joined
from pkxyz_ctrl.trajectory.segments import Limits, NotNegative, Plan, Position, Positive, straight

_KEPT = 0.999  # of each bound on a corner's speed, so that rounding leaves the legs room


class Waypoints(FrozenModel):
    """Through the points in order, from where the stage stands, and to rest at the last; limits hold for each axis."""

    kind: Literal["waypoints"]
    points_m: Annotated[tuple[Position, ...], Field(min_length=1)]
    deviation_m: NotNegative = 0.0
    """how far the path may pass by a point to round its corner off; 0: stop at each"""
    velocity_max_m_per_s: Positive
    acceleration_max_m_per_s2: Positive
    jerk_max_m_per_s3: Positive

    def plan(self, start_m: Array) -> Plan:
        """Legs and rounded corners in turn; the scan is all of it."""
        limits = Limits(self.velocity_max_m_per_s, self.acceleration_max_m_per_s2, self.jerk_max_m_per_s3)
        points = np.array([start_m, *self.points_m])
        way = np.diff(points, axis=0)
        length = np.linalg.norm(way, axis=1)
        if length.min() < 1e-12:
            n = int(np.argmin(length))
            raise TrajectoryError(
                f"points_m.{n} is where the path already is; leave it out, or use a hold to wait there"
            )
        along = way / length[:, None]
        speed = _corner_speeds(along, length, limits, self.deviation_m)
        parts: list[Pieces] = []
        at = points[0]
        for n, direction in enumerate(along):
            corner_s = _corner_time_s(direction, along[n + 1], speed[n + 1], limits) if n + 1 < len(along) else 0.0
            end = points[n + 1] - direction * speed[n + 1] * corner_s / 2
            parts.append(straight(at, end, limits, speed[n], speed[n + 1]))
            at = end
            if speed[n + 1] > 0:
                parts.append(_corner(end, direction, along[n + 1], speed[n + 1], corner_s))
                at = points[n + 1] + along[n + 1] * speed[n + 1] * corner_s / 2
        pieces = joined(parts)
        return Plan((pieces,), points[-1], scan_s=(0.0, pieces.total_s))


def _corner_speeds(along: Array, length: Array, limits: Limits, deviation_m: float) -> list[float]:
    """Speed at each point (n + 1), 0 at both ends: what the corner allows and what the legs let it reach."""
    speed = [0.0] * (len(length) + 1)
    for n in range(1, len(length)):
        top = min(limits.velocity_m_per_s / float(np.abs(along[k]).max()) for k in (n - 1, n))
        room_m = float(min(length[n - 1], length[n])) / 4  # half of each leg is left for changes of speed
        speed[n] = _KEPT * _corner_speed(along[n - 1], along[n], top, room_m, limits, deviation_m)
    for n in range(1, len(length)):
        speed[n] = min(speed[n], _KEPT * _reachable(speed[n - 1], along[n - 1], length[n - 1] / 2, limits))
    for n in reversed(range(1, len(length))):
        speed[n] = min(speed[n], _KEPT * _reachable(speed[n + 1], along[n], length[n] / 2, limits))
    return speed


def _corner_speed(
    before: Array, after: Array, top_m_per_s: float, room_m: float, limits: Limits, deviation_m: float
) -> float:
    """Fastest passage of a corner between two directions (3,).

    Jerk +-j turns the velocity by dv = v (after - before) along an S in a time T, j = 4 dv / T^2; the path passes the
    point by |dv| T / 12, and takes v T / 2 of each leg.
    """
    turn = float(np.linalg.norm(after - before))

    def fits(v: float) -> bool:
        time_s = _corner_time_s(before, after, v, limits)
        return v * turn * time_s / 12 <= deviation_m and v * time_s / 2 <= room_m

    return _largest(fits, top_m_per_s)


def _corner_time_s(before: Array, after: Array, speed_m_per_s: float, limits: Limits) -> float:
    """Shortest time to turn the velocity with a triangle of acceleration inside the limits."""
    change = speed_m_per_s * float(np.abs(after - before).max())
    return max(2 * change / limits.acceleration_m_per_s2, 2 * math.sqrt(change / limits.jerk_m_per_s3))


def _corner(start_m: Array, before: Array, after: Array, speed_m_per_s: float, time_s: float) -> Pieces:
    """Two pieces: acceleration rises evenly to its peak and falls to 0."""
    start = np.array([start_m, before * speed_m_per_s, np.zeros(3)])
    if time_s == 0:  # straight on
        return from_phases(start, [Phases([1e-9], [0.0])] * 3, 1e-9)
    jerk = 4 * speed_m_per_s * (after - before) / time_s**2
    return from_phases(start, [Phases([time_s / 2] * 2, [j, -j]) for j in jerk.tolist()], time_s)


def _reachable(speed_m_per_s: float, along: Array, length_m: float, limits: Limits) -> float:
    """Largest speed that can be had at the end of a leg that is entered with another, no acceleration at both ends."""
    v, a, j = (limit / float(np.abs(along).max()) for limit in limits)

    def fits(end: float) -> bool:
        gain = max(end - speed_m_per_s, 0.0)
        time_s = 2 * math.sqrt(gain / j) if gain * j <= a * a else gain / a + a / j
        return (speed_m_per_s + end) / 2 * time_s <= length_m

    return _largest(fits, v)


def _largest(fits: Callable[[float], bool], top: float) -> float:
    """Largest value of 0..top that fits, by bisection: if one fits, all below do."""
    if fits(top):
        return top
    low, high = 0.0, top
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low
