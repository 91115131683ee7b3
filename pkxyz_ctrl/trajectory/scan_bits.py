"""Line, pixel and frame triggers of a scan: which bits each of its rows has."""

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.config.triggers import FRAME, LINE, PIXEL


def scan_bits(lines: NDArray[np.int64], pixels: int, rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Bits (n,) at rows (n,) of a path. ``lines`` (m, 3): of each its first row, the row behind its last, and the
    number of its frame, in order. In a pixel's first half ``PIXEL`` is 1.
    """
    bits = np.zeros(len(rows), np.int64)
    if not len(lines):
        return bits
    line = np.searchsorted(lines[:, 0], rows, side="right") - 1
    on = (line >= 0) & (rows < lines[line, 1])
    first, end, _ = lines[line[on]].T
    is_first = np.r_[True, lines[1:, 2] != lines[:-1, 2]][line[on]]
    bits[on] = np.where(is_first, LINE | FRAME, LINE)
    if pixels:
        share = (rows[on] - first) / (end - first) * pixels
        bits[on] |= np.where(share - np.floor(share) < 0.5, PIXEL, 0)
    return bits
