"""Set-points for a native loop, which reads them while they are made: in sheets, of which it never finds one half made.

A sheet grows behind its last row. Where rows change that the loop may have read, another sheet is made, and the loop
takes it if its first changed row is behind all that the law has seen; else it refuses it and goes on with the one
before. Then everything here is as it was, and what was asked for is done again from the row that is free by then.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.operate.feed import Feed
from hil.operate.setpoints import BLOCK_ROWS, PIECE_ROWS, Setpoints, Source, Standing
from pkxyz_ctrl.export.shared import SHEET_ROWS
from pkxyz_ctrl.trajectory import TrajectoryError

Array = NDArray[np.float64]

_AHEAD_S, _AHEAD_LEAST_ROWS = 0.03, 128
"""So far ahead there are rows, and at least so many: for a session that stands still."""
_FIRST_ROWS = 12
"""Made before the loop is told; the others follow."""
_MARGIN_LEAST, _MARGIN_KEPT, _MARGIN_MOST = 1, 6, 64
"""How many rows behind those that the law has seen something begins: at least; at most once the loop has taken it; and
where it was refused.
"""
_IN_TIME = 6  # sheets in a row with a tick to spare, until the margin is a row less
_NEVER = np.iinfo(np.int64).max

assert SHEET_ROWS == BLOCK_ROWS


class _Before(NamedTuple):
    """What there was before what the loop has not answered yet."""

    source: Source
    feed: Feed
    target_m: Array
    page: int
    base: int
    filled: int


class Sheets(Setpoints):
    """``Setpoints`` in ``sheets`` (2,) of ``SHEET``. ``page``: the one in use. ``changed_from``: its first row that the
    one before has otherwise, as long as the loop has not answered; None if it has this one.
    """

    def __init__(
        self, period_us: int, delay_periods: int, ramp_rows: int, sheets: NDArray[np.void],
        present_row: Callable[[], int], planned_rows: int = 0,
    ) -> None:  # fmt: skip
        """``present_row``: which row the loop is at, as it says now. ``planned_rows``: that a law looks ahead."""
        self._pages: list[Any] = [sheets[0], sheets[1]]
        self.page = self.row = self._base = self._filled = 0
        self._present_row = present_row
        self.changed_from: int | None = None
        self._before: _Before | None = None
        self._steps: list[Callable[[], None]] = []
        self._source, self._feed, self.target_m = Standing(np.zeros(3)), Feed(0), np.zeros(3)
        self._first_rows = max(_FIRST_ROWS, planned_rows)
        self._reach_rows = max(_AHEAD_LEAST_ROWS, math.ceil(_AHEAD_S * 1e6 / period_us))
        super().__init__(period_us, delay_periods, ramp_rows)
        self._seen_rows, self._in_time = self._kept, 0
        self._plan_ahead(_MARGIN_LEAST)

    def extend(self) -> None:
        """Make rows as far ahead as they are to be, where the path has them; to be called once the loop knows of all
        else.
        """
        while self._filled - self.row < self._reach_rows:
            needed = math.ceil(self._feed.at(self._filled + PIECE_ROWS)) + 2
            if not self._source.has(min(needed, self._source.rows)):
                break
            self._sample(PIECE_ROWS)

    def answered(self, late_rows: int) -> None:
        """The loop has taken the sheet, if there was another: it came ``late_rows`` too late, which is 0 or less."""
        if self._steps:
            margin = min(self._kept - self._seen_rows, _MARGIN_KEPT)
            self._in_time = self._in_time + 1 if late_rows < 0 else 0
            if self._in_time == _IN_TIME:
                margin, self._in_time = max(_MARGIN_LEAST, margin - 1), 0
            self._plan_ahead(margin)
        self.changed_from = self._before = None
        self._steps.clear()

    def refused(self, row: int, late_rows: int) -> None:
        """The loop has come to ``row`` with the sheet before, as this one was ``late_rows`` too late: again."""
        assert self._before is not None, "a sheet that was not handed in is not refused"
        self._source, self._feed, self.target_m, self.page, self._base, self._filled = self._before
        self._rows, steps = self._pages[self.page]["rows"], self._steps
        self.changed_from, self._before, self._steps = None, None, []
        margin, self._in_time = self._kept - self._seen_rows + late_rows, 0
        self.advance(row)
        self.extend()
        self._plan_ahead(max(_MARGIN_LEAST, min(margin, self._filled - row - self._seen_rows, _MARGIN_MOST)))
        for step in steps:
            try:
                self._do(step)
            except TrajectoryError as error:
                self.objection = str(error)
                break

    def advance(self, row: int) -> None:
        if row > self._filled - self._kept:  # it stood, and nobody has made rows for a while
            self.row = row
            self._renew(_NEVER)
            self._begin(row)
        super().advance(row)

    def _catch_up(self) -> None:
        if (row := self._present_row()) > self.row:
            self.advance(row)

    def _plan_ahead(self, rows: int) -> None:
        """Whatever is asked for begins so many rows behind those that the law has seen, as it takes its time."""
        self._kept = self._seen_rows + rows

    def _room(self) -> NDArray[np.void]:
        rows: NDArray[np.void] = self._pages[self.page]["rows"]
        return rows

    def _do(self, step: Callable[[], None]) -> None:
        super()._do(step)
        self._steps.append(step)

    def _renew(self, row: int) -> None:
        """On another page, up to there with the rows of this one."""
        if self._before is None:
            self._before = _Before(self._source, self._feed, self.target_m, self.page, self._base, self._filled)
            before, page = self._pages[self.page], self._pages[1 - self.page]
            at, left = self.row - self._base, max(0, self._filled - self.row) if self.row >= self._base else 0
            page["rows"][:left] = before["rows"][at : at + left]
            page["first"], page["count"], page["rests_from"] = self.row, left, before["rests_from"]
            self.page, self._rows, self._base = 1 - self.page, page["rows"], self.row
        self.changed_from = row if self.changed_from is None else min(row, self.changed_from)

    def _move_block(self) -> None:
        self._renew(_NEVER)

    def _sample(self, count: int) -> None:
        super()._sample(count)
        last, page = self._filled - 1, self._pages[self.page]
        if not (self._feed.at(last) >= self._source.rows or self._feed.stands_at(last)):
            page["rests_from"] = _NEVER
        elif page["rests_from"] > last:
            page["rests_from"] = last
        page["first"], page["count"] = self._base, self._filled - self._base
