"""What the combs can hold and follow, asked between two ticks, before anything moves.

Combs only pull, and only up to their voltage: the positions that can be held are a body that begins in a point at rest.
Forces and limits are those of ``trajectory.check``, which looks for the worst of a whole reference and says how to mend
its file; here the first objection ends the question, so that a motion of a hundred rows takes some 50 us.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hil.operate.sample_axes import PLAIN, Turn
from pkxyz_ctrl.core import kinematics
from pkxyz_ctrl.stage import Stage
from pkxyz_ctrl.trajectory.check import DriveLimits
from pkxyz_ctrl.trajectory.comb_forces import INERTIA, ROUNDING_M, ROUNDING_N, forces_of, inertia_of

Array = NDArray[np.float64]
Records = NDArray[np.void]

_LIMITS = np.dtype(
    [
        ("stroke_min_m", "f8"),
        ("stroke_max_m", "f8"),
        ("force_max_n", "f8", (3,)),
        ("gain_n_per_v2", "f8", (3,)),
        ("slew_v", "f8"),  # most that a voltage may change in a period
        ("inertia", INERTIA),
    ],
    align=True,
)
_FINE, _NUMBER, _DOMAIN, _STROKE, _PUSH, _VOLTAGE, _SLEW = range(7)
_HALVINGS = 28
_SPAN_STROKES, _PROBES = 2.5, 101
_AXES = "xyz"


class Reach:
    """Asks for one stage and drive; what it answers is a sentence, or None where there is no objection. Positions are
    the stage's; sentences, axes and how far one can go along them are those of ``turn``, the sample's.
    """

    def __init__(self, stage: Stage, drive: DriveLimits) -> None:
        self._stage = stage
        self.turn = Turn(PLAIN)
        self._limit_v = min(stage.voltage_max_v, drive.voltage_max_v)
        limits = stage.config.limits
        self._limits = np.zeros(1, _LIMITS)
        numbers = self._limits[0]
        numbers["stroke_min_m"], numbers["stroke_max_m"] = limits.stroke_min_m, limits.stroke_max_m
        numbers["gain_n_per_v2"] = stage.force_gain_n_per_v2
        numbers["force_max_n"] = stage.force_gain_n_per_v2 * self._limit_v**2
        numbers["slew_v"] = drive.slew_max_v_per_s * drive.period_us * 1e-6
        numbers["inertia"] = inertia_of(stage)[0]
        self._span_m = _SPAN_STROKES * limits.stroke_max_m

    def holds(self, position_m: Array) -> bool:
        """Whether a position (3,) can be held."""
        return self._look(position_m)[0] == _FINE

    def target_refusal(self, position_m: Array) -> str | None:
        """Why a position (3,) can't be held: axis, value, unit and limit."""
        code, comb, value = self._look(position_m)
        if code == _FINE:
            return None
        if code == _NUMBER:
            return "a target has to be finite"
        return (
            f"{self.where(position_m)} can't be held: {self._words(code, comb, value)}{self._range_words(position_m)}"
        )

    def motion_refusal(self, rows: Array, periods: int = 1) -> str | None:
        """Why rows (n, 9) of a motion, so many periods apart, can't be followed: where, comb, value, unit, limit."""
        at, code, comb, value = _first_beyond(
            self._stage.geometry, self._stage.elasticity, self._limits, np.ascontiguousarray(rows), periods
        )
        if code == _FINE:
            return None
        if code == _NUMBER:
            return "a motion has to be finite"
        return f"on the way, at {self.where(rows[at, 0:3])}, {self._words(code, comb, value)}"

    def farthest(self, position_m: Array, axis: int, direction: float) -> float:
        """How far along an axis (0, 1, 2) one can go from a position that is held, in m; 0 where it isn't held."""
        way = np.zeros(3)
        way[axis] = math.copysign(self._span_m, direction)
        return self.share(position_m, self.turn.way_to_stage(way)) * self._span_m

    def share(self, position_m: Array, way_m: Array) -> float:
        """What share of a way (3,) one can go from a position that is held; 0 where it isn't held."""
        geometry, elastic = self._stage.geometry, self._stage.elasticity
        return float(_share(geometry, elastic, self._limits, np.ascontiguousarray(position_m), way_m))

    def outline(self, position_m: Array, first: int, second: int, points: int = 72) -> Array:
        """What can be held in the plane of two axes through a position that is held: its border (points, 3)."""
        border = np.tile(np.asarray(position_m, np.float64), (points, 1))
        for n, angle in enumerate(np.linspace(0.0, 2.0 * math.pi, points, endpoint=False)):
            way = np.zeros(3)
            way[first], way[second] = self._span_m * math.cos(angle), self._span_m * math.sin(angle)
            way = self.turn.way_to_stage(way)
            border[n] += self.share(position_m, way) * way
        return border

    def surface(self, position_m: Array, rings: int = 12, around: int = 24) -> Array:
        """What can be held about a position that is, as far as one can go straight: points (rings + 1, around + 1, 3)
        of its surface, from straight down to straight up.
        """
        tilt, angle = np.linspace(0.0, math.pi, rings + 1)[:, None], np.linspace(0.0, 2.0 * math.pi, around + 1)
        down, ones = -np.cos(tilt), np.ones_like(angle)
        ways = self._span_m * np.stack(
            [np.sin(tilt) * np.cos(angle), np.sin(tilt) * np.sin(angle), down * ones], axis=-1
        )
        shares = np.array([[self.share(position_m, way) for way in ring] for ring in ways])
        return np.asarray(position_m + shares[:, :, None] * ways)

    def range_along(self, position_m: Array, axis: int) -> tuple[float, float] | None:
        """Least and greatest coordinate of an axis that can be held, the others as they are; None if none is found."""
        geometry, elastic = self._stage.geometry, self._stage.elasticity
        base = np.array(self.turn.to_sample(position_m), dtype=np.float64)
        base[axis] = 0.0
        way = self.turn.way_to_stage(np.eye(3)[axis])
        coordinates = np.linspace(-self._span_m, self._span_m, _PROBES)
        origin = np.ascontiguousarray(self.turn.to_stage(base))
        n = _held_along(geometry, elastic, self._limits, origin, np.ascontiguousarray(way), coordinates)
        if n < 0:
            return None
        value = float(coordinates[n])
        probe = origin + value * way
        return value - self.farthest(probe, axis, -1.0), value + self.farthest(probe, axis, 1.0)

    def where(self, position_m: Array) -> str:
        """A position (3,) in words."""
        return f"({', '.join(_um(v) for v in self.turn.to_sample(position_m))}) um"

    def _look(self, position_m: Array) -> tuple[int, int, float]:
        position_m = np.ascontiguousarray(position_m)
        code, comb, value = _objection_at_rest(self._stage.geometry, self._stage.elasticity, self._limits, position_m)
        return int(code), int(comb), float(value)

    def _range_words(self, position_m: Array) -> str:
        """How far one can go along an axis instead, the others as they are asked for."""
        asked_m = self.turn.to_sample(position_m)
        for axis, name in enumerate(_AXES):
            found = self.range_along(position_m, axis)
            if found is not None and found[1] - found[0] > 1e-9:
                others = ", ".join(f"{a} = {_um(v)}" for a, v in zip(_AXES, asked_m, strict=True) if a != name)
                low, high = found
                asked = f"; {name} = {_um(asked_m[axis])} um is asked for"
                return f"{asked}, limits {_um(low)} to {_um(high)} um at {others} um"
        return "; no single axis can mend that: go nearer to the middle of the workspace"

    def _words(self, code: int, comb: int, value: float) -> str:
        limits, name = self._limits[0], f"comb {comb + 1}"
        if code == _DOMAIN:
            return "the links can't reach it"
        if code == _STROKE:
            low, high = _um(limits["stroke_min_m"]), _um(limits["stroke_max_m"])
            return f"stroke {comb + 1} would be {_um(value)} um, limits {low} to {high} um"
        if code == _PUSH:
            return f"{name} would have to push with {-value * 1e6:.3g} uN, and combs only pull"
        if code == _VOLTAGE:
            volts = math.sqrt(value / limits["gain_n_per_v2"][comb])
            return f"{name} would need {volts:.1f} V, limit {self._limit_v:g} V"
        slew_v = limits["slew_v"]
        return f"the voltage of {name} would change by {value:.3g} V in a period, limit {slew_v:.3g} V: go slower"


def _um(metres: float) -> str:
    return f"{round(metres * 1e6, 5) + 0.0:.4g}"


@njit(cache=True)
def _objection(
    geometry: Records, elastic: Records, limits: Records, row: Array, force: Array
) -> tuple[int, int, float]:
    """The limit that a row (9,) of a reference passes, the comb, and the value; ``force`` (3,): what the combs give."""
    bounds = limits[0]
    for k in range(9):
        if not math.isfinite(row[k]):
            return _NUMBER, 0, 0.0
    position = row[0:3]
    if kinematics.in_domain(geometry[0], position) != 0:
        return _DOMAIN, 0, 0.0
    kinematics.strokes(geometry[0], position, force)
    for i in range(3):
        if force[i] < bounds["stroke_min_m"] - ROUNDING_M or force[i] > bounds["stroke_max_m"] + ROUNDING_M:
            return _STROKE, i, force[i]
    forces_of(geometry[0], elastic[0], bounds["inertia"], row, force)
    for i in range(3):
        if force[i] < -ROUNDING_N:
            return _PUSH, i, force[i]
        if force[i] > bounds["force_max_n"][i]:
            return _VOLTAGE, i, force[i]
    return _FINE, 0, 0.0


@njit(cache=True)
def _objection_at_rest(
    geometry: Records, elastic: Records, limits: Records, position_m: Array
) -> tuple[int, int, float]:
    """The same of a position (3,)."""
    row = np.zeros(9)
    row[0:3] = position_m
    return _objection(geometry, elastic, limits, row, np.empty(3))  # type: ignore[no-any-return]


@njit(cache=True)
def _first_beyond(
    geometry: Records, elastic: Records, limits: Records, rows: Array, periods: int
) -> tuple[int, int, int, float]:
    """Index of the first row (n, 9) that passes a limit, which, of which comb, and the value."""
    force, before = np.empty(3), np.empty(3)
    for n in range(len(rows)):
        code, comb, value = _objection(geometry, elastic, limits, rows[n], force)
        if code != _FINE:
            return n, code, comb, value
        for i in range(3):
            volts = math.sqrt(max(force[i], 0.0) / limits[0]["gain_n_per_v2"][i])
            if n > 0 and abs(volts - before[i]) > periods * limits[0]["slew_v"]:
                return n, _SLEW, i, abs(volts - before[i]) / periods
            before[i] = volts
    return 0, _FINE, 0, 0.0


@njit(cache=True)
def _share(geometry: Records, elastic: Records, limits: Records, position_m: Array, way_m: Array) -> float:
    """What share of a way (3,) from a position (3,) can be gone so that what is reached can be held, by bisection."""
    row, force = np.zeros(9), np.empty(3)
    low, high = 0.0, 1.0
    for step in range(_HALVINGS + 1):
        middle = 0.0 if step == 0 else (low + high) / 2
        for i in range(3):
            row[i] = position_m[i] + middle * way_m[i]
        held = _objection(geometry, elastic, limits, row, force)[0] == _FINE
        if step == 0 and not held:
            return 0.0
        if held:
            low = middle
        else:
            high = middle
    return low


@njit(cache=True)
def _held_along(
    geometry: Records, elastic: Records, limits: Records, origin_m: Array, way: Array, coordinates_m: Array
) -> int:
    """Which is the first of the coordinates along a way (3,) from an origin (3,) that can be held; -1 if none."""
    row, force = np.zeros(9), np.empty(3)
    for n in range(len(coordinates_m)):
        for i in range(3):
            row[i] = origin_m[i] + coordinates_m[n] * way[i]
        if _objection(geometry, elastic, limits, row, force)[0] == _FINE:
            return n
    return -1
