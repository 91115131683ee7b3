"""Raster scan in three dimensions: lines along x, steps along y during the turn-around, layers along z, to and fro."""

import math
from typing import Literal, NamedTuple, Self

import numpy as np
from pydantic import model_validator

from pkxyz_ctrl.config.files import FrozenModel
from pkxyz_ctrl.trajectory.motion import Array, TrajectoryError, at_rest
from pkxyz_ctrl.trajectory.pieces import Phases, Pieces, from_phases, joined
from pkxyz_ctrl.trajectory.segments import COUNT_MAX, Count, Limits, NotNegative, Plan, Position, Positive, travel


class Raster(FrozenModel):
    """Lines along x at constant velocity, serpentine in x, y and z, around a centre at which it ends.

    Each turn-around reverses x and steps y (or z, between layers) inside the limits; it takes as long as they ask for,
    and the lines get the rest of the period.
    """

    kind: Literal["raster"]
    centre_m: Position | None = None
    """centre of the scanned block; unset: where the stage stands"""
    line_length_m: Positive
    """the constant-velocity part; turn-arounds reach beyond it"""
    lines: Count
    """lines in a layer"""
    line_pitch_m: NotNegative
    layers: Count = 1
    layer_pitch_m: NotNegative = 0.0
    frames: Count = 1
    """how often the block is scanned; from its last line the scan goes back to its first, in one turn-around"""
    line_rate_hz: Positive
    """lines a second; a line's period holds one pass and one turn-around"""
    velocity_max_m_per_s: Positive
    acceleration_max_m_per_s2: Positive
    jerk_max_m_per_s3: Positive

    @model_validator(mode="after")
    def _not_too_many(self) -> Self:
        if (total := self.lines * self.layers * self.frames) > COUNT_MAX:
            raise ValueError(f"{total} lines in all layers and frames; at most {COUNT_MAX} are planned")
        return self

    @model_validator(mode="after")
    def _comes_back(self) -> Self:
        if self.frames > 1 and self.lines * self.layers % 2:
            raise ValueError(
                f"{self.lines * self.layers} lines end on the far side of the first one; with frames, the number of "
                "lines in all layers has to be even"
            )
        return self

    def plan(self, start_m: Array) -> Plan:
        """Lead-in, lines and turn-arounds, lead-out to the centre."""
        centre = start_m if self.centre_m is None else np.array(self.centre_m)
        limits = self._limits()
        speed = self.line_speed_m_per_s()
        line_s = self.line_length_m / speed
        turn_s = 1 / self.line_rate_hz - line_s
        starts = self._line_starts(centre, speed) * self.frames
        lead_in = travel(at_rest(start_m), starts[0], limits)
        parts: list[Pieces] = [lead_in]
        for n, start in enumerate(starts):
            line = from_phases(start, [Phases([line_s], [0.0])] * 3, line_s)
            parts.append(line)
            if n + 1 < len(starts):
                parts.append(self._turn(line.end(), starts[n + 1], turn_s))
        parts.append(travel(parts[-1].end(), at_rest(centre), limits))
        begin = lead_in.total_s
        lines = tuple(
            (begin + n / self.line_rate_hz, begin + n / self.line_rate_hz + line_s) for n in range(len(starts))
        )
        period_s = self.lines * self.layers / self.line_rate_hz if self.frames > 1 else None
        return Plan((joined(parts),), centre, scan_s=(begin, lines[-1][1]), lines_s=lines, period_s=period_s)

    def line_speed_m_per_s(self) -> float:
        """Least speed at which pass and turn-around fit the line's period; ``TrajectoryError`` if none does."""
        v_max, a, j = limits = self._limits()
        step_s = step_time_s(self._longest_step_m(), limits)

        def period_s(v: float) -> float:
            return self.line_length_m / v + max(reversal_time_s(v, a, j), step_s)

        # the period falls with v until the turn-around grows faster than the line shrinks
        jerk_bound = (self.line_length_m * math.sqrt(j / 2)) ** (2 / 3)
        fastest = jerk_bound if jerk_bound <= a * a / (2 * j) else math.sqrt(self.line_length_m * a / 2)
        fastest = min(max(fastest, _reversible_speed(step_s, a, j)), v_max)
        if period_s(fastest) * self.line_rate_hz > 1:
            raise TrajectoryError(
                f"{self.line_rate_hz:g} lines/s is beyond the {1 / period_s(fastest):.4g} lines/s that its "
                "velocity, acceleration and jerk limits allow; lower line_rate_hz or line_length_m, or raise the limits"
            )
        low, high = self.line_length_m * self.line_rate_hz, fastest
        while (middle := low + (high - low) / 2) not in (low, high):
            low, high = (low, middle) if period_s(middle) * self.line_rate_hz <= 1 else (middle, high)
        return high

    def _limits(self) -> Limits:
        return Limits(self.velocity_max_m_per_s, self.acceleration_max_m_per_s2, self.jerk_max_m_per_s3)

    def _longest_step_m(self) -> float:
        """Along y or z, in a turn-around."""
        steps = [self.line_pitch_m, self.layer_pitch_m if self.layers > 1 else 0.0]
        if self.frames > 1:
            steps += [(self.lines - 1) * self.line_pitch_m, (self.layers - 1) * self.layer_pitch_m]
        return max(steps)

    def _line_starts(self, centre: Array, speed: float) -> list[Array]:
        """State (3, 3) at the start of each line."""
        states = []
        for n in range(self.lines * self.layers):
            layer, row = divmod(n, self.lines)
            row = row if layer % 2 == 0 else self.lines - 1 - row
            way = 1.0 if n % 2 == 0 else -1.0
            offset = [
                -way * self.line_length_m / 2,
                (row - (self.lines - 1) / 2) * self.line_pitch_m,
                (layer - (self.layers - 1) / 2) * self.layer_pitch_m,
            ]
            states.append(np.array([centre + offset, (way * speed, 0.0, 0.0), (0.0, 0.0, 0.0)]))
        return states

    def _turn(self, start: Array, end: Array, turn_s: float) -> Pieces:
        x = reversal(float(end[1, 0]), self._limits(), turn_s)
        y, z = (step(float(d), self._limits(), turn_s) for d in (end[0] - start[0])[1:])
        return from_phases(start, [x, y, z], turn_s)


def reversal_time_s(speed_m_per_s: float, a: float, j: float) -> float:
    """Shortest time to turn ``speed`` into its opposite, within acceleration a (zero at both ends) and jerk j."""
    change = 2 * speed_m_per_s
    return 2 * math.sqrt(change / j) if change * j <= a * a else change / a + a / j


def _reversible_speed(time_s: float, a: float, j: float) -> float:
    """Speed whose shortest reversal takes ``time_s``: the inverse of ``reversal_time_s``."""
    return j * time_s**2 / 8 if time_s <= 2 * a / j else (time_s - a / j) * a / 2


def reversal(velocity_after_m_per_s: float, limits: Limits, duration_s: float) -> Phases:
    """Phases from -velocity to +velocity: the shortest ones, stretched evenly to ``duration_s``."""
    speed, a, j = abs(velocity_after_m_per_s), limits.acceleration_m_per_s2, limits.jerk_m_per_s3
    total = reversal_time_s(speed, a, j)
    ramp = min(math.sqrt(2 * speed / j), a / j)
    stretch = duration_s / total
    jerk = math.copysign(2 * speed / (ramp * (total - ramp)), velocity_after_m_per_s) / stretch**2
    return Phases([ramp * stretch, (total - 2 * ramp) * stretch, ramp * stretch], [jerk, 0.0, -jerk])


class _StepShape(NamedTuple):
    """Times of the shortest step: jerk ramp, constant acceleration, and constant velocity between the two halves."""

    ramp_s: float
    flat_s: float
    cruise_s: float

    @property
    def total_s(self) -> float:
        return 4 * self.ramp_s + 2 * self.flat_s + self.cruise_s


def _step_shape(distance_m: float, limits: Limits) -> _StepShape:
    v, a, j = limits
    ramp, flat = (distance_m / (2 * j)) ** (1 / 3), 0.0
    if ramp * j > a:
        ramp = a / j
        flat = (
            -3 * ramp + math.sqrt(ramp * ramp + 4 * distance_m / a)
        ) / 2  # a (ramp + flat)(2 ramp + flat) = distance
    if j * ramp * (ramp + flat) <= v:
        return _StepShape(ramp, flat, 0.0)
    ramp, flat = (math.sqrt(v / j), 0.0) if v * j <= a * a else (a / j, v / a - a / j)
    return _StepShape(ramp, flat, distance_m / v - 2 * ramp - flat)


def step_time_s(distance_m: float, limits: Limits) -> float:
    """Shortest time from rest to rest over ``distance`` inside the limits."""
    return _step_shape(distance_m, limits).total_s


def step(displacement_m: float, limits: Limits, duration_s: float) -> Phases:
    """Phases from rest to rest over a signed ``displacement``, the shortest ones stretched evenly to ``duration_s``."""
    shape = _step_shape(abs(displacement_m), limits)
    if shape.ramp_s == 0:
        return Phases([duration_s], [0.0])
    ramp, flat, cruise = (t * duration_s / shape.total_s for t in shape)
    jerk = displacement_m / (ramp * (ramp + flat) * (2 * ramp + flat + cruise))
    return Phases([ramp, flat, ramp, cruise, ramp, flat, ramp], [jerk, 0.0, -jerk, 0.0, -jerk, 0.0, jerk])
