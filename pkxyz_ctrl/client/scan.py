"""A scan as frames: what came by, tick by tick, put where on its lines the path was."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.client.protocol import Block

Array = NDArray[np.float64]
PATH_ROW = "path_row"
"""Field of telemetry: where on the path the set-point is, in its rows; NaN off it."""


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
