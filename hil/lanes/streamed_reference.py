"""The reference of a loop at rate: sampled ahead, a few rows after each tick, however long the trajectory is."""

import numpy as np
from numpy.typing import NDArray

from hil.lanes.blocks import PREVIEW_ROWS
from hil.lanes.excitation import Excitation
from pkxyz_ctrl.loop.reference import REFERENCE, write_rows
from pkxyz_ctrl.trajectory import Trajectory

BLOCK_ROWS = 1024
PIECE_ROWS = 32
"""Sampled at once, some 50 us: a 32nd of a block, so a block is ready long before the one in use has ended."""


class StreamedReference:
    """``runtime.Reference`` of two blocks: the loop reads one while ``prepare``,
    called after each tick, fills the other.

    A reference that begins anew, as after a fault that was cleared, is sampled in that tick.
    """

    def __init__(
        self, trajectory: Trajectory, period_us: int, memory: NDArray[np.void], excitation: Excitation | None = None
    ) -> None:
        """``memory``: the controller's, (1,) of ``cycle.MEMORY``; says where the path is."""
        self._trajectory = trajectory
        self._excitation = excitation
        self._period_us = period_us
        self._memory = memory
        self._rows, self._next = (np.zeros(BLOCK_ROWS + PREVIEW_ROWS, REFERENCE) for _ in range(2))
        self._base = self._filled = 0
        self._begin(0)

    def __call__(self, tick: int) -> NDArray[np.void]:
        """Rows (n,) of ``REFERENCE`` for this tick."""
        at = int(self._memory["reference_tick"][0])
        ahead = at - self._base
        if ahead == BLOCK_ROWS and self._filled == len(self._next):
            self._rows, self._next = self._next, self._rows
            self._take(at)
        elif not 0 <= ahead < BLOCK_ROWS:
            self._begin(at)
        return self._rows

    def prepare(self) -> None:
        """Sample the next few rows, if there are any left to be sampled."""
        begin, end = self._filled, min(self._filled + PIECE_ROWS, len(self._next))
        if begin < end:
            first = self._base + BLOCK_ROWS + begin
            self._write(self._next[begin:end], first)
            self._filled = end

    def _begin(self, at: int) -> None:
        self._write(self._rows, at)
        self._take(at)

    def _write(self, rows: NDArray[np.void], first: int) -> None:
        write_sampled(rows, self._trajectory, first, self._period_us, self._excitation)

    def _take(self, at: int) -> None:
        """The rows in use begin at trajectory tick ``at``; of those after them there is none yet."""
        self._base, self._filled = at, 0


def write_sampled(
    rows: NDArray[np.void], trajectory: Trajectory, first: int, period_us: int, excitation: Excitation | None
) -> None:
    """Write rows (n,) of ``REFERENCE`` that are there: the trajectory from tick ``first`` on, with what is added."""
    write_rows(rows, trajectory.sample(first, len(rows), period_us), first)
    rows["output"] = trajectory.outputs(first, len(rows), period_us)
    if excitation is not None:
        rows["added_m"] = excitation.sample(first, len(rows))
