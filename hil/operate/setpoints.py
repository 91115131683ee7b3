"""The set-points of a stage in operation: rows of the reference, made while the loop runs and changed while it moves.

The law has seen some rows ahead of the present one, and what it has seen is kept: whatever is asked for begins with the
row behind them, from the position, velocity and acceleration that are there.
"""

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hil.lanes.blocks import PREVIEW_ROWS
from hil.operate.feed import Feed, fed_rows
from pkxyz_ctrl.core import feed_hold
from pkxyz_ctrl.loop.reference import REFERENCE, write_rows
from pkxyz_ctrl.trajectory import TrajectoryError
from pkxyz_ctrl.trajectory.in_flight import InFlight, to_rest, towards
from pkxyz_ctrl.trajectory.segments import Limits

Array = NDArray[np.float64]

BLOCK_ROWS = 1024
PIECE_ROWS = 16
"""Sampled at once, some 10 us, so that no tick has much to do."""
_LOOKED_AT_ROWS = 128


Judge = Callable[[Array, int], str | None]
"""Why rows (n, 9) that are so many periods apart can't be followed, if they can't."""


class Source(Protocol):
    """Where a set-point goes by itself, in rows since its own start, at rest in the first and from the last on."""

    rows: int

    def sample(self, first: int, count: int) -> Array:
        """(count, 9) from row ``first`` on; before 0 and past the end as these."""
        ...

    def has(self, row: int) -> bool:
        """Whether all rows up to this one can be sampled."""
        ...

    def outputs(self, rows: NDArray[np.int64]) -> NDArray[np.int64] | None:
        """Trigger bits (n,) of rows (n,); None where there never are any."""
        ...


class Standing:
    """At rest at a position (3,)."""

    rows = 0

    def __init__(self, position_m: Array) -> None:
        self._row = np.concatenate([position_m, np.zeros(6)])

    def sample(self, first: int, count: int) -> Array:
        return np.tile(self._row, (count, 1))

    def has(self, row: int) -> bool:
        return True

    def outputs(self, rows: NDArray[np.int64]) -> None:
        return None


class Going:
    """A motion that was planned in flight."""

    def __init__(self, motion: InFlight, period_s: float) -> None:
        self._motion = motion
        self._period_s = period_s
        self.rows = math.ceil(motion.total_s / period_s)

    def sample(self, first: int, count: int) -> Array:
        return self._motion.rows(first, 1, count, self._period_s)

    def has(self, row: int) -> bool:
        return True

    def outputs(self, rows: NDArray[np.int64]) -> None:
        return None


class Setpoints:
    """``runtime.Reference`` of a stage in operation. ``target_m`` (3,): where the present motion ends. ``objection``:
    why what was asked for last could not be done after all, if so; then what was asked for before goes on.
    """

    def __init__(self, period_us: int, delay_periods: int, ramp_rows: int) -> None:
        """``ramp_rows``: how long a path takes to stop and to be taken up again, an even number."""
        self._period_s = period_us * 1e-6
        self._kept = delay_periods + 2  # rows that the law has looked at past that of the next tick, and the next tick
        self._ramp = ramp_rows
        self.objection: str | None = None
        self._rows = self._room()
        self._window = np.zeros(2 * PREVIEW_ROWS + 2 * PIECE_ROWS, REFERENCE)
        self.restart(np.zeros(3))

    def restart(self, position_m: Array) -> None:
        """Stand at a position (3,), from row 0 on: the loop has just been closed."""
        self.row = 0
        self._renew(0)
        self._source: Source = Standing(position_m)
        self._feed = Feed(0, ramp=self._ramp)
        self.target_m = position_m.copy()
        self._begin(0)

    def __call__(self, tick: int) -> NDArray[np.void]:
        """Rows (n,) of ``REFERENCE`` for the row said by ``advance``."""
        return self._rows

    # -- what is asked ------------------------------------------------------------------------------------------------

    def go(self, target_m: Array, limits: Limits, judge: Judge) -> None:
        """Set out to a target (3,), from where the set-point will be. Raises ``TrajectoryError``, also with the words
        of ``judge``; then nothing has changed.
        """
        self._do(lambda: self._go(target_m, limits, judge))

    def brake(self, limits: Limits) -> None:
        """Come to rest by the shortest way, off the path if there is one."""
        self._do(lambda: self._brake(limits))

    def follow(self, path: Source, end_m: Array) -> None:
        """Set out on a path that begins, at rest, where the set-point stands, and ends at ``end_m`` (3,)."""
        self._do(lambda: self._set_out(path, end_m, self.free_row))

    def stop_on_path(self) -> None:
        """Slow down to a stop without leaving the path."""
        self._do(lambda: self._turn(feed_hold.SLOWING))

    def go_on(self) -> None:
        """Go on along the path."""
        self._do(lambda: self._turn(feed_hold.STARTING))

    def leave_path(self) -> None:
        """Where the path has come to a stop, stand: it is not gone on with."""
        self._do(self._leave)

    # -- what is so ---------------------------------------------------------------------------------------------------

    @property
    def free_row(self) -> int:
        """The first row that the law has not seen."""
        return self.row + self._kept

    def state(self) -> Array:
        """(3, 3) in the last row that the law has seen: position, velocity, acceleration; every plan starts there."""
        motion: Array = self._rows["motion"][self.free_row - 1 - self._base]
        return motion.reshape(3, 3).copy()

    @property
    def path_row(self) -> float:
        """Row of the path at the present set-point."""
        return min(max(self._feed.at(self.row), 0.0), float(self._source.rows))

    def follows(self, path: Source | None) -> bool:
        """Whether the set-points are those of a path."""
        return self._source is path

    @property
    def has_arrived(self) -> bool:
        """Whether the set-point stands at the end of its motion."""
        return self._feed.at(self.row) >= self._source.rows

    @property
    def stands_on_path(self) -> bool:
        """Whether it has come to a stop that was asked for."""
        return self._feed.stands_at(self.row)

    @property
    def is_stopping(self) -> bool:
        """Whether it slows down on its path, or stands on it."""
        return self._feed.direction == feed_hold.SLOWING

    @property
    def runs_short(self) -> bool:
        """Whether the rows that are there will soon only suffice to stop on the path."""
        needed = math.ceil(self._feed.at(self.row)) + self._ramp // 2 + PREVIEW_ROWS + 2 * PIECE_ROWS
        return not self._source.has(min(needed, self._source.rows))

    # -- from tick to tick --------------------------------------------------------------------------------------------

    def advance(self, row: int) -> None:
        """The next tick is that of ``row``; make sure of its rows, and sample a few more."""
        self.row = row
        if row - self._base > BLOCK_ROWS - self._reach_rows - 2 * PIECE_ROWS:
            self._move_block()
        ahead = self._filled - row
        if ahead < PREVIEW_ROWS + PIECE_ROWS:
            self._sample(max(PIECE_ROWS, PREVIEW_ROWS - ahead))

    _reach_rows = PREVIEW_ROWS
    """for which there is always room ahead"""
    _first_rows = PREVIEW_ROWS
    """made at once where something is asked for"""

    def _room(self) -> NDArray[np.void]:
        """Where rows stand, (BLOCK_ROWS,) of ``REFERENCE``."""
        return np.zeros(BLOCK_ROWS, REFERENCE)

    def _do(self, step: Callable[[], None]) -> None:
        """Do what is asked."""
        step()
        self.objection = None

    def _catch_up(self) -> None:
        """With the loop, if that has gone on meanwhile."""

    def _renew(self, row: int) -> None:
        """Rows from ``row`` on are about to become other ones."""

    def _go(self, target_m: Array, limits: Limits, judge: Judge) -> None:
        motion = towards(self.state(), target_m, limits)
        rows = math.ceil(motion.total_s / self._period_s)
        step = -(-rows // _LOOKED_AT_ROWS) or 1
        count = -(-rows // step) + 1
        if (why := judge(motion.rows(0, step, count, self._period_s), step)) is not None:
            raise TrajectoryError(why)
        if self.has_arrived:  # a motion from rest may begin whenever it is ready
            self._catch_up()
        self._set_out(Going(motion, self._period_s), target_m, self.free_row - 1)

    def _brake(self, limits: Limits) -> None:
        motion = to_rest(self.state(), limits)
        self._set_out(Going(motion, self._period_s), motion.end_m, self.free_row - 1)

    def _leave(self) -> None:
        position = self.state()[0]
        self._set_out(Standing(position), position, self.row)

    def _set_out(self, source: Source, target_m: Array, origin: int) -> None:
        self._renew(self.free_row)
        self._source, self.target_m = source, target_m.copy()
        self._feed = Feed(origin, ramp=self._ramp)
        self._anew()

    def _turn(self, direction: int) -> None:
        self._renew(self.free_row)
        self._feed = self._feed.turned(direction, self.free_row - 1)
        self._anew()

    def _anew(self) -> None:
        self._filled = self.free_row
        self._sample(self._first_rows)

    def _begin(self, row: int) -> None:
        self._base = self._filled = row
        self._sample(PREVIEW_ROWS + PIECE_ROWS)

    def _move_block(self) -> None:
        """What is still needed goes to the front, in place: the loop goes on reading the same rows."""
        played = self.row - self._base
        left = self._filled - self.row
        self._rows[:left] = self._rows[played : played + left].copy()
        self._base = self.row

    def _sample(self, count: int) -> None:
        first, at = self._filled, self._filled - self._base
        write_rows(self._rows[at : at + count], self._motion(first, count), first)
        if (outputs := self._source.outputs(self._feed.nearest(first, count))) is not None:
            self._rows["output"][at : at + count] = outputs
        self._filled = first + count

    def _motion(self, first: int, count: int) -> Array:
        """(count, 9) of the loop's rows from ``first`` on."""
        feed = self._feed
        if feed.is_plain:
            return self._source.sample(first - feed.origin + int(feed.phase), count)
        begin, end = math.floor(feed.at(first)), math.floor(feed.at(first + count - 1)) + 2
        window = self._window[: end - begin]
        window["motion"] = self._source.sample(begin, end - begin)
        out = np.empty((count, 9))
        fed_rows(window, begin, first - feed.origin, feed.phase, feed.direction, feed.ramp, self._period_s, out)
        return out


def rows_of(law: NDArray[np.void]) -> tuple[int, int]:
    """``delay_periods`` and ``ramp_rows`` of a law (1,) of ``cycle.LAW``."""
    return int(law["tick"]["delay_periods"][0]), int(law["feed_hold_ticks"][0])


def planned_rows_of(law: NDArray[np.void]) -> int:
    """How many rows more a law (1,) of ``cycle.LAW`` looks at that plans ahead; 0 for another one."""
    return int(law["tick"]["predictive"]["horizon"][0])
