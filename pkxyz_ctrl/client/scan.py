"""Paths: what is asked, what is told before one is followed, and a scan's frames, put together tick by tick."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.client.protocol import Block
from pkxyz_ctrl.client.reply import StageError

Array = NDArray[np.float64]
PATH_ROW = "path_row"
"""Field of telemetry: where on the path the set-point is, in its rows; NaN off it."""


def limits_of(v: float | None, a: float | None, j: float | None) -> dict[str, float]:
    """Of velocity, acceleration and jerk those that are given, as the server is told them."""
    limits = {"velocity_m_per_s": v, "acceleration_m_per_s2": a, "jerk_m_per_s3": j}
    return {key: value for key, value in limits.items() if value is not None}


def path_of(
    scenario: str | None, segments: Sequence[Mapping[str, Any]] | None, table_csv: str | None, limits: dict[str, float]
) -> dict[str, Any]:
    """A path as the server is told it; ``limits`` are those of a table. Raises ``StageError`` unless it is one of the
    three.
    """
    sources = {"scenario": scenario, "segments": segments, "table": table_csv}
    path: dict[str, Any] = {key: value for key, value in sources.items() if value is not None}
    if len(path) != 1:
        raise StageError("give one of scenario, segments and table_csv")
    return path if table_csv is None else path | limits


@dataclass(frozen=True)
class PathPreview:
    """A path that could be followed."""

    name: str
    duration_s: float
    points_m: Array
    """(n, 3), some hundreds along it"""
    low_m: Array
    """(3,), least of each axis"""
    high_m: Array

    @classmethod
    def of(cls, data: Mapping[str, Any]) -> Self:
        """From the server's words."""
        places = {name: np.array(data[name], np.float64) for name in ("points_m", "low_m", "high_m")}
        return cls(name=data["name"], duration_s=data["duration_s"], **places)


@dataclass(frozen=True)
class ScanFrame:
    """One pass over the lines of a raster. ``frame["estimate_m"]`` is (lines, pixels, 3): means over the ticks that
    fell into each pixel, NaN where none did.
    """

    number: int
    """0 for the first"""
    columns: Mapping[str, Array]
    ticks: NDArray[np.int64]
    """(lines, pixels): how many fell into each"""

    def __getitem__(self, field: str) -> Array:
        """A field: (lines, pixels), or (lines, pixels, 3). Pixels run as those of the first line do."""
        return self.columns[field]


class Frames:
    """Takes blocks, gives frames. ``lines``: for each its first and last row of the path, and its frame's number."""

    def __init__(self, lines: Sequence[tuple[int, int, int]], backward: Sequence[bool], pixels: int) -> None:
        self._first, self._last, self._frame = (np.array(column, np.int64) for column in zip(*lines, strict=True))
        self._backward, self._pixels = np.array(backward), pixels
        self._sums: dict[str, Array] = {}
        self._ticks = np.zeros((len(lines), pixels), np.int64)
        self._handed_over = 0
        self.count = int(self._frame[-1]) + 1

    def take(self, block: Block, fields: Sequence[str]) -> list[ScanFrame]:
        """Frames that are whole now."""
        row = np.asarray(block[PATH_ROW], np.float64)
        on_path = np.isfinite(row)
        row = np.where(on_path, row, -1.0)
        line = np.searchsorted(self._first, row, side="right") - 1
        on_line = on_path & (line >= 0) & (row < self._last[line])
        at, rows = line[on_line], row[on_line]
        share = (rows - self._first[at]) / (self._last[at] - self._first[at])
        share = np.where(self._backward[at], 1.0 - share, share)
        pixel = np.minimum((share * self._pixels).astype(int), self._pixels - 1)
        np.add.at(self._ticks, (at, pixel), 1)
        for field in fields:
            values = np.asarray(block[field], np.float64)
            sums = self._sums.setdefault(field, np.zeros((*self._ticks.shape, *values.shape[1:])))
            np.add.at(sums, (at, pixel), values[on_line])
        passed = float(row.max(initial=-1.0))
        found = []
        while self._handed_over < self.count and passed >= self._last[self._frame == self._handed_over].max():
            found.append(self._frame_of(self._handed_over))
            self._handed_over += 1
        return found

    def _frame_of(self, number: int) -> ScanFrame:
        lines = self._frame == number
        ticks = self._ticks[lines]
        with np.errstate(invalid="ignore"):
            columns = {
                field: sums[lines] / (ticks[..., None] if sums.ndim == 3 else ticks)
                for field, sums in self._sums.items()
            }
        return ScanFrame(number, columns, ticks)
