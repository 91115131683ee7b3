"""A run in blocks of ticks: so many rows of the reference handed out, so many rows of the record handed on.

Where the run learns, a block ends when a window of it does, so that what was seen can act on the rows that follow.
"""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from hil.lanes.excitation import Excitation
from pkxyz_ctrl.learning import Learner
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.trajectory import Trajectory

BLOCK_TICKS = 2048
"""0.4 s at 5 kHz; bounds the memory of a run and what a killed one loses."""

PREVIEW_ROWS = 25
"""Rows of the reference that the law may look at past its own: two periods of delay, the longest horizon of a plan, and
the intervals after them."""


@lru_cache(maxsize=16)
def _sampled(trajectory: Trajectory, first: int, count: int, period_us: int) -> NDArray[np.void]:
    """Rows that nobody writes to: a study runs one scan again and again."""
    rows = reference_rows(trajectory.sample(first, count, period_us), first)
    rows["output"] = trajectory.outputs(first, count, period_us)
    return rows


class Handout:
    """The rows of the reference that a stretch of ticks needs."""

    def __init__(
        self,
        trajectory: Trajectory,
        period_us: int,
        excitation: Excitation | None = None,
        learner: Learner | None = None,
    ) -> None:
        self._trajectory = trajectory
        self._period_us = period_us
        self._excitation = excitation
        self._learner = learner

    def ticks(self, memory: NDArray[np.void], most: int) -> int:
        """How many ticks the next stretch may have, at most ``most``."""
        if self._learner is None:
            return most
        left = self._learner.due - int(memory["reference_tick"][0])
        return min(most, left) if left > 0 else most  # a hold has carried the path past it: nothing is learnt then

    def rows(self, memory: NDArray[np.void], ticks: int) -> NDArray[np.void]:
        """Rows (n,) of ``REFERENCE`` that so many ticks may need, from where ``memory`` (1,) says that the path is."""
        first, count = int(memory["reference_tick"][0]), ticks + PREVIEW_ROWS
        rows = _sampled(self._trajectory, first, count, self._period_us)
        if self._excitation is None and self._learner is None:
            return rows
        rows = rows.copy()
        if self._excitation is not None:
            rows["added_m"] = self._excitation.sample(first, count)
        if self._learner is not None:
            self._learner.finish()
            rows["motion"] += self._learner.shift(first, count)
        return rows

    def see(self, rows: NDArray[np.void]) -> None:
        """The rows of the record that came of it, in order."""
        if self._learner is not None:
            self._learner.see(rows)


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
        learner: Learner | None = None,
    ) -> None:
        self.ticks = ticks
        self.rows = np.empty(BLOCK_TICKS, ROW)
        self.done = 0
        self._handout = Handout(trajectory, period_us, excitation, learner)
        self._on_block = on_block
        self._on_progress = on_progress

    def next_count(self, memory: NDArray[np.void]) -> int:
        """Ticks of the next block, 0 at the end."""
        return self._handout.ticks(memory, min(BLOCK_TICKS, self.ticks - self.done))

    def reference(self, memory: NDArray[np.void]) -> NDArray[np.void]:
        """``Handout.rows`` of the next block."""
        return self._handout.rows(memory, min(BLOCK_TICKS, self.ticks - self.done))

    def hand_on(self, count: int) -> None:
        """The first ``count`` rows are complete."""
        self.done += count
        if count:
            self._handout.see(self.rows[:count])
            self._on_block(self.rows[:count])
        self._on_progress(self.done, self.ticks)
