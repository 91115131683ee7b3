"""Waypoints: a list of points joined by straight lines, with a stop at each or with corners rounded off."""

import math
from collections.abc import Callable
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field

from pkxyz_ctrl.config.files import FrozenModel
from pkxyz_ctrl.trajectory.motion import Array, TrajectoryError
from pkxyz_ctrl.trajectory.pieces import Phases, Pieces, from_phases, joined
from pkxyz_ctrl.trajectory.segments import Limits, NotNegative, Plan, Position, Positive, straight

_KEPT = 0.999  # of each bound on a corner's speed, so that rounding leaves the legs room
_INSTANT_S = 1e-9


class Waypoints(FrozenModel):
    """Through the points in order, from where the stage stands, and to rest at the last; limits hold for each axis."""

    kind: Literal["waypoints"]
    points_m: Annotated[tuple[Position, ...], Field(min_length=1, max_length=10_000)]
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
        path = _Path(points, along, length, limits)
        speed = _corner_speeds(path, self.deviation_m)
        parts: list[Pieces] = []
        for n in range(len(along)):
            parts.append(path.leg(n, speed[n], speed[n + 1]))
            if speed[n + 1] > 0:
                parts.append(path.corner(n + 1, speed[n + 1]))
        pieces = joined(parts)
        return Plan((pieces,), points[-1], scan_s=(0.0, pieces.total_s))


class _Path(NamedTuple):
    """The straight lines between points, and how they are run."""

    points_m: Array
    """(n + 1, 3)"""
    along: Array
    """(n, 3), unit vector of each leg"""
    length_m: Array
    """(n,)"""
    limits: Limits

    def turn_time_s(self, n: int, speed_m_per_s: float) -> float:
        """Shortest time to turn the velocity at an inner point with a triangle of acceleration inside the limits."""
        change = speed_m_per_s * float(np.abs(self.along[n] - self.along[n - 1]).max())
        return max(2 * change / self.limits.acceleration_m_per_s2, 2 * math.sqrt(change / self.limits.jerk_m_per_s3))

    def cut_m(self, n: int, speed_m_per_s: float) -> float:
        """What the corner at a point takes of the legs before and after it."""
        return speed_m_per_s * self.turn_time_s(n, speed_m_per_s) / 2 if speed_m_per_s > 0 else 0.0

    def corner(self, n: int, speed_m_per_s: float) -> Pieces:
        """Two pieces: acceleration rises evenly to its peak and falls to 0."""
        before, after = self.along[n - 1], self.along[n]
        start_m = self.points_m[n] - before * self.cut_m(n, speed_m_per_s)
        start = np.array([start_m, before * speed_m_per_s, np.zeros(3)])
        time_s = self.turn_time_s(n, speed_m_per_s)
        if time_s == 0:  # straight on
            return from_phases(start, [Phases([_INSTANT_S], [0.0])] * 3, _INSTANT_S)
        jerk = 4 * speed_m_per_s * (after - before) / time_s**2
        return from_phases(start, [Phases([time_s / 2] * 2, [j, -j]) for j in jerk.tolist()], time_s)

    def leg(self, n: int, speed_start_m_per_s: float, speed_end_m_per_s: float) -> Pieces:
        """From the corner at point n to that at n + 1."""
        start = self.points_m[n] + self.along[n] * self.cut_m(n, speed_start_m_per_s)
        end = self.points_m[n + 1] - self.along[n] * self.cut_m(n + 1, speed_end_m_per_s)
        return straight(start, end, self.limits, speed_start_m_per_s, speed_end_m_per_s)

    def time_about_s(self, n: int, speed: list[float]) -> float:
        """Time of an inner point's corner and of the legs on both sides."""
        legs_s = sum(self.leg(k, speed[k], speed[k + 1]).total_s for k in (n - 1, n))
        return legs_s + (self.turn_time_s(n, speed[n]) if speed[n] > 0 else 0.0)


def _corner_speeds(path: _Path, deviation_m: float) -> list[float]:
    """Speed at each point (n + 1), 0 at both ends: what the corner allows and what the legs let it reach.

    A corner at which a stop is quicker gets one: to pass it slowly costs more than to brake into it.
    """
    count = len(path.along)
    room_m = path.length_m / 2  # half of each leg is left for changes of speed
    speed = [0.0, *(_KEPT * _corner_speed(path, n, deviation_m) for n in range(1, count)), 0.0]
    for n in range(1, count):
        speed[n] = min(speed[n], _KEPT * _reachable(speed[n - 1], path.along[n - 1], room_m[n - 1], path.limits))
    for n in reversed(range(1, count)):
        speed[n] = min(speed[n], _KEPT * _reachable(speed[n + 1], path.along[n], room_m[n], path.limits))
    for n in range(1, count):
        neighbours = ((speed[n - 1], n - 1), (speed[n + 1], n))
        if all(v <= _KEPT * _reachable(0.0, path.along[k], room_m[k], path.limits) for v, k in neighbours):
            stopping = [*speed[:n], 0.0, *speed[n + 1 :]]
            if path.time_about_s(n, stopping) <= path.time_about_s(n, speed):
                speed = stopping
    return speed


def _corner_speed(path: _Path, n: int, deviation_m: float) -> float:
    """Fastest passage of a corner.

    Jerk +-j turns the velocity by dv = v (after - before) along an S in a time T, j = 4 dv / T^2; the path passes the
    point by |dv| T / 12, and takes v T / 2 of each leg.
    """
    legs = path.along[n - 1 : n + 1]
    turn = float(np.linalg.norm(legs[1] - legs[0]))
    room_m = float(path.length_m[n - 1 : n + 1].min()) / 4

    def fits(v: float) -> bool:
        return v * turn * path.turn_time_s(n, v) / 12 <= deviation_m and path.cut_m(n, v) <= room_m

    return _largest(fits, path.limits.velocity_m_per_s / float(np.abs(legs).max()))


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
