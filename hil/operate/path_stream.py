"""A path whose rows come while it is followed: planned and sampled elsewhere, judged here block by block."""

import numpy as np
from numpy.typing import NDArray

from hil.operate.commands import PATH_ROWS
from hil.operate.reach import Reach

Array = NDArray[np.float64]

_KEPT_ROWS = 8192
_STEP_MOST_M = 2e-6
"""Between two rows: what no path that was planned within its limits does; a jump belongs into a move."""
NEAR_M = 1e-12
"""At the same place."""


class PathStream:
    """A ``setpoints.Source`` of ``rows`` rows, from ``start_m`` (3,) to ``end_m`` (3,). ``objection``: why what came
    can't be followed, once something can't.
    """

    def __init__(self, number: int, rows: int, start_m: Array, end_m: Array, reach: Reach) -> None:
        self.number = number
        self.rows = max(0, rows - 1)
        """number of the last row, where the path is at rest"""
        self.start_m, self.end_m = start_m, end_m
        self.objection: str | None = None
        self._reach = reach
        self._kept = np.zeros((_KEPT_ROWS, 9))
        self._outputs = np.zeros(_KEPT_ROWS, np.int64)
        self._known = 0
        self._before = np.concatenate([start_m, np.zeros(6)])

    @property
    def wants(self) -> int:
        """The row with which the next block has to begin."""
        return self._known

    def has_room(self, row: int) -> bool:
        """Whether one more block would overwrite nothing that is still needed at ``row``."""
        return self._known + PATH_ROWS - row < _KEPT_ROWS - PATH_ROWS

    def take(self, number: int, first: int, motion: Array, outputs: NDArray[np.int32]) -> None:
        """A block (n, 9) of the rows from ``first`` on, with their trigger bits (n,); one of another path, or out of
        turn, is left aside.
        """
        if number != self.number or first != self._known or self.objection is not None or not len(motion):
            return
        rows = np.concatenate([self._before[None], motion])
        if not np.isfinite(rows).all() or float(np.abs(np.diff(rows[:, 0:3], axis=0)).max()) > _STEP_MOST_M:
            self.objection = f"row {first} of the path jumps, or is not a number"
            return
        self.objection = self._reach.motion_refusal(rows) or self._end_objection(motion[self.rows - first :])
        if self.objection is None:
            places = np.arange(first, first + len(motion)) % _KEPT_ROWS
            self._kept[places], self._outputs[places] = motion, outputs
            self._before = motion[-1].copy()
            self._known = first + len(motion)

    def _end_objection(self, motion: Array) -> str | None:
        """Against rows (n, 9) of the path from its last on, if they have come."""
        if not len(motion) or float(np.abs(motion[0, 0:3] - self.end_m).max()) <= NEAR_M:
            return None
        return f"the path does not end where it was said to, at {self._reach.where(self.end_m)}"

    def has(self, row: int) -> bool:
        return min(row, self.rows) < self._known

    def sample(self, first: int, count: int) -> Array:
        return self._kept[self._places(np.arange(first, first + count))]

    def outputs(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        return self._outputs[self._places(rows)]

    def _places(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        last = min(self.rows, self._known - 1)
        return np.clip(rows, 0, max(last, 0)) % _KEPT_ROWS
