"""Learning at the wall clock: rows are written ahead of the law while it runs, a few between two ticks.

The same learner as in the lanes, and the same ticks; only that its work is done in pieces.
"""

import numpy as np
from numpy.typing import NDArray

from hil.lanes.blocks import PREVIEW_ROWS
from pkxyz_ctrl.learning import Learner
from pkxyz_ctrl.learning.timetable import FADE_TICKS, LEAD_TICKS
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.trajectory import Trajectory

_CHUNK = 16
"""Rows written at a time."""
_AHEAD = PREVIEW_ROWS + 2 * _CHUNK
assert _AHEAD + _CHUNK < LEAD_TICKS, "what is written ahead of the end of a window is not changed by what it teaches"


class LiveReference:
    """``rows`` (n,) of ``REFERENCE``: the whole trajectory, whose shift is filled in as it becomes known."""

    def __init__(self, trajectory: Trajectory, period_us: int, learner: Learner) -> None:
        self.learner = learner
        count = trajectory.duration_us // period_us + PREVIEW_ROWS + FADE_TICKS + 1
        self._base = trajectory.sample(0, count, period_us)
        self.rows = reference_rows(self._base)
        self.rows["output"] = trajectory.outputs(0, count, period_us)
        self._written = 0
        self._due = learner.due
        while self._written < _AHEAD:
            self._write()

    def after(self, memory: NDArray[np.void]) -> None:
        """After a tick: ``memory`` (1,) of ``cycle.MEMORY`` holds its row, and the tick that comes next."""
        learner, following = self.learner, int(memory["reference_tick"][0])
        learner.see(memory["row"])
        pending = learner.work()
        if self._written < min(following + _AHEAD, len(self.rows)):
            if pending and self._written + _CHUNK > self._due + LEAD_TICKS:
                learner.finish()  # it begins to act in the rows that are next
            self._write()
        if not pending:
            self._due = learner.due

    def _write(self) -> None:
        rows = slice(self._written, min(self._written + _CHUNK, len(self.rows)))
        shift = self.learner.shift(rows.start, rows.stop - rows.start)
        self.rows["motion"][rows] = self._base[rows] + shift
        self._written = rows.stop
