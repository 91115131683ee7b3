"""A run in blocks of ticks: so many rows of the reference handed out, so many rows of the record handed on."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hil.excitation import Excitation
from pkxyz_ctrl.row import ROW
from pkxyz_ctrl.trajectory import Trajectory

BLOCK_TICKS = 4096
"""0.8 s at 5 kHz; bounds the memory of a run and what a killed one loses."""

PREVIEW_ROWS = 25
"""Rows of the reference that the law may look at past its own: two periods of delay, the longest horizon of a plan, and
the intervals after them."""


class Blocks:
    """Hands a lane its reference and takes its rows. ``rows`` (BLOCK_TICKS,) of ``ROW`` is filled by the lane."""

    def __init__(
        self,
        trajectory: Trajectory,
        period_us: int,
        ticks: int,
        on_block: Callable[[NDArray[np.void]], None],
        on_progress: Callable[[int, int], None],
        excitation: Excitation | None = None,
    ) -> None:
        self.ticks = ticks
        self.rows = np.zeros(BLOCK_TICKS, ROW)
        self.done = 0
        self._trajectory = trajectory
        self._period_us = period_us
        self._excitation = excitation
        self._on_block = on_block
        self._on_progress = on_progress

    def next_count(self) -> int:
        """Ticks of the next block, 0 at the end."""
        return min(BLOCK_TICKS, self.ticks - self.done)

    def reference(self, memory: NDArray[np.void]) -> NDArray[np.float64]:
        """Rows (n, 9) of the trajectory that the next block may need, or (n, 12) with an excitation; says in
        ``memory`` (1,) where they begin.
        """
        first, count = int(memory["reference_tick"][0]), BLOCK_TICKS + PREVIEW_ROWS
        memory["input"]["reference_base"] = first
        rows = self._trajectory.sample(first, count, self._period_us)
        return rows if self._excitation is None else np.hstack([rows, self._excitation.sample(first, count)])

    def hand_on(self, count: int) -> None:
        """The first ``count`` rows are complete."""
        self.done += count
        if count:
            self._on_block(self.rows[:count])
        self._on_progress(self.done, self.ticks)
