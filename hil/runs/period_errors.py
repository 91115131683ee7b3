"""The error of a scan that repeats, period by period: what learning is judged by.

Periodic error: the harmonics of one period's error up to the cutoff of learning, RMS over the period, root of the sum
of squares over the axes; the noise of that one period is in it, constant errors are not. "sensed" is measured position
less reference, all that a controller can know; "true" is true position less reference.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.recording.recording import Recording
from pkxyz_ctrl.learning import LearningConfig, timetable
from pkxyz_ctrl.learning.harmonics import count_up_to, harmonics
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.trajectory import Trajectory

Array = NDArray[np.float64]

AXES = ("x", "y", "z")
WITHIN = 5
"""Periods after which the error is compared with that of the first one."""
_NM = 1e9


@dataclass(frozen=True)
class PeriodFigures:
    """Figures by name of ``METRICS``, and those of each period; None for what did not take place."""

    line_error_nm: Mapping[str, float] | None
    learning_factor: float | None
    learning_factor_true: float | None
    periods: Mapping[str, Sequence[float] | Sequence[Mapping[str, float]] | None]
    """sensed_nm, true_nm and line_error_nm, each a value a period"""


class PeriodErrors:
    """Takes in the rows of a run, in blocks; keeps one period at a time, and the first."""

    def __init__(self, trajectory: Trajectory, period_us: int, config: LearningConfig) -> None:
        self.table = timetable(trajectory, period_us)
        self.period_us = period_us
        self.sensed_nm: list[float] = []
        self.true_nm: list[float] = []
        self.line_error_nm: list[Array] = []
        """(3,) of each period: true error on the lines, RMS; none of a scan without lines"""
        self.first_m: Array | None = None
        """(N, 3) true error of the first whole period, or measured where nobody knows the truth"""
        self.last_m: Array | None = None
        self._count = count_up_to(config.cutoff_hz, self.table.period, period_us * 1e-6)
        self._errors = np.zeros((self.table.period, 2, 3))
        self._filled = 0
        t_us = (self.table.begin + np.arange(self.table.periods * self.table.period)) * period_us
        lines = trajectory.segments[self.table.segment].lines_us
        on_line = np.any([(t_us >= a) & (t_us < b) for a, b in lines] or [np.zeros(len(t_us), bool)], axis=0)
        self._on_line = on_line.reshape(self.table.periods, self.table.period)

    def update(self, block: NDArray[np.void]) -> None:
        """Take in rows (n,) of ``ROW``."""
        n, last = self.table.period, self.table.begin + self.table.periods * self.table.period
        tick = block["reference_tick"]
        rows = block[(block["mode"] == Mode.TRACKING) & (tick >= self.table.begin) & (tick < last)]
        done = 0
        while done < len(rows):
            at = int(rows["reference_tick"][done] - self.table.begin) % n
            part = rows[done : done + n - at]
            errors = np.stack([part["measurement_m"], part["position_m"]], axis=1) - part["reference_m"][:, None]
            self._errors[at : at + len(part)] = errors
            self._filled = len(part) if at == 0 else self._filled + len(part)
            if self._filled == n and at + len(part) == n:
                self._close()
            done += len(part)

    def look_at(self, recording: Recording) -> None:
        """Take in all rows of a recording."""
        for rows in recording.rows(("mode", "reference_tick", "measurement_m", "position_m", "reference_m")):
            self.update(rows)

    def _close(self) -> None:
        """A whole period is there."""
        sensed, true = self._errors[:, 0], self._errors[:, 1]
        known = bool(np.isfinite(true).all())
        self.sensed_nm.append(self._periodic_nm(sensed))
        if known:
            self.true_nm.append(self._periodic_nm(true))
        self.last_m = (true if known else sensed).copy()
        if self.first_m is None:
            self.first_m = self.last_m
        period = len(self.sensed_nm) - 1
        if period < len(self._on_line) and self._on_line[period].any():
            self.line_error_nm.append(np.sqrt((self.last_m[self._on_line[period]] ** 2).mean(axis=0)) * _NM)

    def _periodic_nm(self, error_m: Array) -> float:
        return float(np.sqrt(2.0 * (np.abs(harmonics(error_m, 0, self._count)) ** 2).sum())) * _NM

    def figures(self) -> PeriodFigures:
        """What has come together so far."""
        lines = [dict(zip(AXES, map(float, line), strict=True)) for line in self.line_error_nm]
        return PeriodFigures(
            lines[-1] if lines else None,
            _factor(self.sensed_nm),
            _factor(self.true_nm),
            {"sensed_nm": self.sensed_nm, "true_nm": self.true_nm or None, "line_error_nm": lines or None},
        )


def _factor(errors_nm: list[float]) -> float | None:
    """How many times smaller the error is after ``WITHIN`` periods, or in the last one of fewer."""
    return errors_nm[0] / errors_nm[min(WITHIN, len(errors_nm) - 1)] if len(errors_nm) > 1 else None
