"""Where on its path a set-point is, row by row: at the path's own speed, slowing down, standing, or starting again.

The ramps are those of ``core.feed_hold``, so a path that is paused is not left.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pkxyz_ctrl.core import feed_hold

Array = NDArray[np.float64]
Records = NDArray[np.void]


class Feed(NamedTuple):
    """How path time passes with the loop's rows: ``direction`` is that of ``core.feed_hold``, since row ``origin``."""

    origin: int
    """row of the loop at which the ramp, or the path, began"""
    phase: float = 0.0
    """row of the path there"""
    direction: int = feed_hold.STEADY
    ramp: int = 2
    """rows that a ramp takes, an even number"""

    def at(self, row: int) -> float:
        """Row of the path at a row of the loop."""
        if self.direction == feed_hold.STEADY:
            return self.phase + (row - self.origin)
        advanced, _, _ = feed_hold.advance(self.direction, row - self.origin, self.ramp)
        return self.phase + float(advanced)

    def nearest(self, first: int, count: int) -> NDArray[np.int64]:
        """Row of the path that is nearest to each of ``count`` rows of the loop from ``first`` on."""
        if self.direction == feed_hold.STEADY:
            begin = math.floor(self.phase + (first - self.origin) + 0.5)
            return np.arange(begin, begin + count)
        return np.array([math.floor(self.at(row) + 0.5) for row in range(first, first + count)])

    def turned(self, direction: int, row: int) -> "Feed":
        """Slowing down or starting from ``row`` on; in the middle of the other, from the speed that there is."""
        if self.direction == direction:
            return self
        age = 0
        if self.direction != feed_hold.STEADY:
            age = max(0, self.ramp - (row - self.origin))  # where the mirrored ramp has this speed
        advanced, _, _ = feed_hold.advance(direction, age, self.ramp)
        return Feed(row - age, self.at(row) - float(advanced), direction, self.ramp)

    @property
    def is_plain(self) -> bool:
        """Whether rows of the loop are rows of the path."""
        return self.direction == feed_hold.STEADY

    def stands_at(self, row: int) -> bool:
        """Whether the path has come to a stop by a row of the loop."""
        return self.direction == feed_hold.SLOWING and row - self.origin >= self.ramp


@njit(cache=True)
def fed_rows(
    window: Records,
    window_first: int,
    first_age: int,
    phase: float,
    direction: int,
    ramp: int,
    period_s: float,
    out: Array,
) -> None:
    """Rows (n, 9) of a path at the ages ``first_age``, +1, ... of a ramp. ``window`` (m,) has the path's rows as
    ``motion`` from ``window_first`` on, as many as are needed.
    """
    for n in range(len(out)):
        advanced, speed, change = feed_hold.advance(direction, first_age + n, ramp)
        feed_hold.sample(window, phase + advanced - window_first, speed, change, period_s, out[n])
