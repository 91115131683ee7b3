"""Figures of a run, taken block by block, and the verdict on a scenario's checks.

Errors are true position less reference at the same sample, in nm; "scanning" is the scan with its turn-arounds, without
lead-in and lead-out. A hold is looked at after its settling time: about the set-point, and about its own mean, which
forgives an offset and a slow drift of whole holds.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hil.runs.warnings import Warnings
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Mode

if TYPE_CHECKING:
    from pkxyz_ctrl.trajectory import Trajectory

METRICS: dict[str, str] = {
    "rms_error_nm": "RMS error while scanning, each axis",
    "max_error_nm": "largest error while scanning, each axis",
    "error_deviation_nm": "RMS error while scanning about its own mean, which an offset in sensing shifts, each axis",
    "hold_rms_nm": "RMS of the true position about the set-point in holds, each axis",
    "hold_noise_nm": "standard deviation of the true position in holds about each hold's own mean, each axis",
    "estimate_error_nm": "RMS of estimated less true position while scanning, each axis",
    "line_error_nm": "RMS error on the lines of the last whole period of a scan that repeats, each axis",
    "learning_factor": "periodic error as it is sensed: first period over that after five more",
    "learning_factor_true": "the same of the true position",
    "ticks": "ticks recorded",
    "saturated_ticks": "ticks in which a comb force met a bound",
    "missed_ticks": "ticks that were skipped, late on the wire, or without the sample that the amplifier owed",
    "faults": "number of faults",
    "warnings": "number of things that the device has changed in",
    "refused_frames": "frames that the interface did not take, at rate",
    "dropped_frames": "frames that a bus among processes lost, at rate",
    "blocked_frames": "frames that our own gate held back, at rate",
    "lost_rows": "rows that the recording's writer was too slow for, at rate",
    "bus_load": "share of time in which the bus was busy, 0 to 1",
    "realtime_factor": "stage time by wall-clock time",
}
"""What a scenario's checks may bound; a bound on a metric of each axis holds for each of the three."""

AXES = ("x", "y", "z")
_NM = 1e9


class _HasBounds(Protocol):
    @property
    def min(self) -> float | None: ...
    @property
    def max(self) -> float | None: ...


@dataclass(frozen=True)
class RowFigures:
    """Figures by name of ``METRICS``, those that come from rows; None for what did not take place."""

    ticks: int
    saturated_ticks: int
    rms_error_nm: Mapping[str, float] | None
    max_error_nm: Mapping[str, float] | None
    error_deviation_nm: Mapping[str, float] | None
    hold_rms_nm: Mapping[str, float] | None
    hold_noise_nm: Mapping[str, float] | None
    estimate_error_nm: Mapping[str, float] | None
    warnings: tuple[str, ...] = ()
    """what of the device has changed during the run"""


@dataclass(frozen=True)
class Verdict:
    """What became of a check. ``ok`` is None where there is nothing that could be measured."""

    name: str
    value: float | None
    min: float | None
    max: float | None
    ok: bool | None

    def as_json(self) -> dict[str, Any]:
        """Plain data; a bound that isn't there has no key."""
        return {key: value for key, value in asdict(self).items() if value is not None or key in ("value", "ok")}


class _Sums:
    """Count, sum and sum of squares of (n, 3) values, and the largest magnitudes."""

    def __init__(self) -> None:
        self.count = 0
        self.total = np.zeros(3)
        self.squares = np.zeros(3)
        self.largest = np.zeros(3)

    def add(self, values: NDArray[np.float64]) -> None:
        if len(values):
            rows = np.ascontiguousarray(values.T)  # reductions along long rows are several times faster
            self.count += len(values)
            self.total += rows.sum(axis=1)
            self.squares += np.einsum("ij,ij->i", rows, rows)
            self.largest = np.maximum(self.largest, np.maximum(rows.max(axis=1), -rows.min(axis=1)))

    def rms(self) -> NDArray[np.float64]:
        return np.sqrt(self.squares / self.count)

    def deviation(self) -> NDArray[np.float64]:
        return np.sqrt(self.squared_deviations() / self.count)

    def squared_deviations(self) -> NDArray[np.float64]:
        return np.maximum(self.squares - self.total**2 / self.count, 0.0)


class Metrics:
    """Accumulates the figures of one run; holds sums, never rows."""

    def __init__(self, trajectory: "Trajectory", period_us: int) -> None:
        self._period_us = period_us
        self._scans = [s.scan_us for s in trajectory.segments if s.scan_us]
        self._stills = [s.still_us for s in trajectory.segments if s.still_us]
        self._error = _Sums()
        self._estimate = _Sums()
        self._noise = [_Sums() for _ in self._stills]
        self._warnings = Warnings()
        self.ticks = 0
        self.saturated_ticks = 0

    def update(self, block: NDArray[np.void]) -> None:
        """Take in a block (n,) of ``ROW``."""
        if block.dtype != ROW:
            raise TypeError(f"a block of rows is expected, got {block.dtype}")
        self.ticks += len(block)
        self.saturated_ticks += int(np.count_nonzero(block["saturated"]))
        self._warnings.update(block)
        tick = block["reference_tick"]
        t_us = np.where((tick >= 0) & (block["mode"] == Mode.TRACKING), tick * self._period_us, -1)
        if len(t_us) == 0:
            return
        span = int(t_us.min()), int(t_us.max())
        for window in self._scans:
            inside = _inside(t_us, span, window)
            if inside is not None:
                truth = block["position_m"][inside]
                self._error.add(truth - block["reference_m"][inside])
                self._estimate.add(block["estimate_m"][inside] - truth)
        for window, noise in zip(self._stills, self._noise, strict=True):
            inside = _inside(t_us, span, window)
            if inside is not None:  # less the reference, which is constant here: keeps digits
                noise.add(block["position_m"][inside] - block["reference_m"][inside])

    def figures(self) -> RowFigures:
        """What has come together so far."""
        scanned = self._error.count > 0
        return RowFigures(
            ticks=self.ticks,
            saturated_ticks=self.saturated_ticks,
            rms_error_nm=_by_axis(self._error.rms()) if scanned else None,
            max_error_nm=_by_axis(self._error.largest) if scanned else None,
            error_deviation_nm=_by_axis(self._error.deviation()) if scanned else None,
            hold_rms_nm=self._hold_rms(),
            hold_noise_nm=self._hold_noise(),
            estimate_error_nm=_by_axis(self._estimate.rms()) if scanned else None,
            warnings=self._warnings.sentences,
        )

    def _hold_rms(self) -> dict[str, float] | None:
        """About the set-points, pooled over the holds."""
        holds = [noise for noise in self._noise if noise.count > 0]
        if not holds:
            return None
        return _by_axis(np.sqrt(np.sum([h.squares for h in holds], axis=0) / sum(h.count for h in holds)))

    def _hold_noise(self) -> dict[str, float] | None:
        """About each hold's own mean, pooled over the holds."""
        holds = [noise for noise in self._noise if noise.count > 1]
        if not holds:
            return None
        squares = np.sum([h.squared_deviations() for h in holds], axis=0)
        return _by_axis(np.sqrt(squares / sum(h.count - 1 for h in holds)))


def _inside(t_us: NDArray[np.int64], span: tuple[int, int], window: tuple[int, int]) -> Any:
    """What selects the instants inside a window: all, a mask, or None for none. Most blocks lie on one side of most."""
    begin, end = window
    if span[1] < begin or span[0] >= end:
        return None
    if begin <= span[0] and span[1] < end:
        return slice(None)
    mask = (t_us >= begin) & (t_us < end)
    return mask if mask.any() else None


def evaluate(checks: Mapping[str, _HasBounds], figures: Mapping[str, Any]) -> tuple[Verdict, ...]:
    """The verdict on each check, by figures of the names in ``METRICS``.

    The value of a metric of three axes is that of the worst one. Without a value a check is not met, save that of the
    bus load where there is no bus: there ``ok`` is None.
    """
    verdicts = []
    for name, bound in checks.items():
        values = _values(figures.get(name))
        if not values:
            verdicts.append(Verdict(name, None, bound.min, bound.max, None if name == "bus_load" else False))
            continue
        low = bound.min is not None and min(values) < bound.min
        worst = min(values) if low or bound.max is None else max(values)
        ok = not low and (bound.max is None or max(values) <= bound.max) and all(map(math.isfinite, values))
        verdicts.append(Verdict(name, worst, bound.min, bound.max, ok))
    return tuple(verdicts)


def _values(measured: Any) -> list[float]:
    if measured is None:
        return []
    if isinstance(measured, Mapping):
        return [float(v) for v in measured.values()]
    if isinstance(measured, list | tuple):
        return [float(len(measured))]
    return [float(measured)]


def _by_axis(values_m: NDArray[np.float64]) -> dict[str, float]:
    return {axis: float(value) * _NM for axis, value in zip(AXES, values_m, strict=True)}


def bound_words(check: Verdict) -> str:
    """The bound of a check as people write it."""
    low, high = check.min, check.max
    if low is None:
        return f"≤ {high:g}"
    return f"≥ {low:g}" if high is None else f"{low:g} to {high:g}"
