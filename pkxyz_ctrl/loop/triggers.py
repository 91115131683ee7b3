"""Trigger bits for the instant at which an output of this tick acts, with the voltages. PURE and compiled.

Where the stage is then: the set-point of that instant, and how far the estimate has been from its own of late; its
noise from tick to tick, averaged out, is not known beforehand. A position trigger fires in the tick nearest to the
passage, so it is early as often as late, and says by how much.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

LINE, PIXEL, FRAME, POSITION, IN_POSITION = 1, 2, 4, 8, 16
"""On a line; in an even pixel of it; on the first line of a frame; passed a position; in position."""

MEMORY_TICKS = 32
"""Time constant of the mean of what the estimate is off."""

POSITION_TRIGGER = np.dtype(
    [
        ("axis", "i4"),
        ("direction", "i4"),  # 1 or -1: towards larger or smaller coordinates; 0: both
        ("start_m", "f8"),
        ("pitch_m", "f8"),
        ("count", "i8"),  # start, start + pitch, ...: how many positions
        ("off_m", "f8"),  # estimate less set-point, of late
        ("begun", "i4"),  # 0: not asked yet
        ("passed", "i8"),  # positions below where the stage was
        ("late_s", "f8"),  # how long before the instant of action the position was passed; negative: after it
        ("at_m", "f8"),  # which position that was
    ],
    align=True,
)


@njit(cache=True, error_model="numpy")
def position_bit(trigger: np.void, now_m: Array, then: Array, estimate_m: Array, period_s: float) -> int:
    """``POSITION`` if the stage passes a position of ``trigger`` within half a period of the instant of action, else 0.

    Set-point (3,) and estimate (3,) of now, and the row (9,) of the reference at that instant. Of several within one
    period the last counts: the pitch has to be more than the way of a period.
    """
    i = trigger["axis"]
    speed = then[3 + i]
    if trigger["begun"] == 0:
        trigger["off_m"] = estimate_m[i] - now_m[i]
    trigger["off_m"] += (estimate_m[i] - now_m[i] - trigger["off_m"]) / MEMORY_TICKS
    at = then[i] + trigger["off_m"]
    ahead = (at + 0.5 * period_s * speed - trigger["start_m"]) / trigger["pitch_m"]
    below = min(max(math.floor(ahead) + 1, 0), trigger["count"])
    was, trigger["passed"] = trigger["passed"], below
    if trigger["begun"] == 0:
        trigger["begun"] = 1
        return 0
    if below == was or speed == 0.0 or trigger["direction"] * (below - was) < 0 or (below > was) != (speed > 0.0):
        return 0
    trigger["at_m"] = trigger["start_m"] + trigger["pitch_m"] * (below - 1 if below > was else below)
    late_s = (at - trigger["at_m"]) / speed
    trigger["late_s"] = (at - trigger["at_m"] + 0.5 * then[6 + i] * late_s * late_s) / speed
    return POSITION


@njit(cache=True, error_model="numpy")
def scan_bits(lines: NDArray[np.int64], pixels: int, path_row: float) -> int:
    """Bits of a scan at a row of its path, that of the instant of action. ``lines`` (n, 3): first and last row of each,
    in order, and the number of its frame. In a pixel's first half ``PIXEL`` is 1.
    """
    low, high = 0, len(lines)
    while low < high:
        middle = (low + high) // 2
        if lines[middle, 0] <= path_row:
            low = middle + 1
        else:
            high = middle
    n = low - 1
    if n < 0 or not path_row < lines[n, 1]:
        return 0
    share = (path_row - lines[n, 0]) / (lines[n, 1] - lines[n, 0]) * pixels
    bits = LINE
    if share - math.floor(share) < 0.5:
        bits |= PIXEL
    if n == 0 or lines[n, 2] != lines[n - 1, 2]:
        bits |= FRAME
    return bits
