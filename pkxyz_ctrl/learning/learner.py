"""Learning inside a run: rows of the record in, shifts of the reference out, the same bits in every lane.

All that happens is tied to ticks of the trajectory. What a window teaches is worked out between its last row and the
tick at which it begins to act, in pieces short enough for the time between two ticks; a lane without a clock does them
all at once.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.learning import update
from pkxyz_ctrl.learning.config import LearningConfig, LearningError
from pkxyz_ctrl.learning.harmonics import count_up_to, fade, harmonics, noise, period_rows, weighted
from pkxyz_ctrl.learning.store import Stored
from pkxyz_ctrl.learning.timetable import FADE_TICKS, Timetable, timetable
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.monitors import SenseStatus
from pkxyz_ctrl.trajectory import Trajectory

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Rows = NDArray[np.void]

NEVER = 2**62
PIECES = 12
"""In how many pieces the limits of a shifted period are looked at."""
SCALINGS = (1.0, 0.5, 0.25)
"""Shares of a change that are tried before it is dropped, when the shifted scan would pass a limit."""
_UNUSABLE = int(
    SenseStatus.MISSING | SenseStatus.CRC | SenseStatus.LENGTH | SenseStatus.DUPLICATE | SenseStatus.IMPLAUSIBLE
)


@dataclass(frozen=True)
class Step:
    """What became of one window, for people."""

    window: int
    learnt: int
    """harmonics"""
    reverted: int
    share: float | None
    """of the change that the limits allowed; None for a window with ticks missing, from which nothing is learnt"""


class Learner:
    """One run's learning.

    ``within_limits`` is asked about rows (n, 9) of the shifted scan. ``sense_delay_s`` is the delay that the law
    reckons with: a sensor shows where the stage was.
    """

    def __init__(
        self,
        config: LearningConfig,
        table: Timetable,
        trajectory: Trajectory,
        period_us: int,
        within_limits: Callable[[Array], bool],
        sense_delay_s: float = 0.0,
        stored: Stored | None = None,
    ) -> None:
        self.table = table
        self.steps: list[Step] = []
        self._tick_s = period_us * 1e-6
        self._within_limits = within_limits
        count = count_up_to(config.cutoff_hz, table.period, self._tick_s)
        self._reference = trajectory.sample(table.begin, table.period, period_us)
        self._lag_m = sense_delay_s * self._reference[:, 3:6]
        start = _beginning(stored, count)
        if stored is not None:
            _require_followed(self._reference + self._period(start), within_limits)
        self._known = update.beginning(start, config.gain)
        # (first tick of fading in, rows of a period), in order; older ones have faded out
        self._changes: list[tuple[int, Array]] = [(table.begin - FADE_TICKS, self._period(start))]
        windows = 0 if config.mode == "apply" else table.windows
        self._last = windows if config.updates is None else min(windows, config.updates)
        self._window = 0
        self._seen = np.zeros((table.window, 3))
        self._seen_ticks = 0
        self._offset: int | None = None  # ticks since power-on less those of the trajectory
        self._held = False
        self._latest = -1  # tick of the trajectory
        self._lost = False
        self._work: Iterator[None] | None = None

    @property
    def correction(self) -> Complex:
        """(K, 3) in m: what acts in the end, as far as it is known to have done no harm."""
        return self._known.best

    @property
    def due(self) -> int:
        """Tick of the trajectory by which all rows before it have to be seen; ``NEVER``
        if there is nothing to learn any more.
        """
        over = self._window >= self._last or self._lost or self._held
        return NEVER if over else self.table.window_end(self._window)

    def see(self, rows: Rows) -> None:
        """Take in rows (n,) of ``ROW``, all of them in order, up to ``due`` at most."""
        tracked = rows[rows["mode"] == Mode.TRACKING]
        if len(tracked) == 0 or self._lost:
            return
        tick = tracked["reference_tick"]
        if tick[0] <= self._latest:  # the trajectory has begun anew: what belongs where is not known any more
            self._lost, self._work = True, None
            return
        self._latest = int(tick[-1])
        self._offset = int(tracked["tick"][0] - tick[0]) if self._offset is None else self._offset
        if (tracked["tick"] - tick != self._offset).any():  # from a hold on, the path may stand between its ticks
            self._held = True
        begin, due = self.table.window_begin(self._window), self.due
        if due == NEVER:
            return
        usable = (tracked["sense_status"] & _UNUSABLE == 0) & (tracked["overrun"] == 0)
        good = usable & (tick >= begin) & (tick < due)
        chosen = tracked[good]
        self._seen[tick[good] - begin] = chosen["measurement_m"] - chosen["reference_m"]
        self._seen_ticks += len(chosen)
        if self._latest >= due - 1:
            self._work = self._teach(self._window, self._seen_ticks == self.table.window)
            self._window += 1
            self._seen_ticks = 0

    def work(self) -> bool:
        """Do one piece of what there is to do; False if there is nothing."""
        if self._work is None:
            return False
        if next(self._work, True):
            self._work = None
        return self._work is not None

    def finish(self) -> None:
        """Do all that there is to do."""
        while self.work():
            pass

    def shift(self, first_tick: int, count: int) -> Array:
        """(count, 9): what is added to the rows of the trajectory at ticks first_tick, first_tick + 1, ...

        Known up to the ``LEAD_TICKS`` after ``due``; work that there was is done by then.
        """
        out = np.zeros((count, 9))
        if self._lost:
            return out
        tick = first_tick + np.arange(count, dtype=np.int64)
        ends = [*(begin for begin, _ in self._changes[1:]), self.table.end]
        for (begin, rows), end in zip(self._changes, ends, strict=True):
            inside = np.flatnonzero((tick >= begin) & (tick < end + FADE_TICKS))
            if len(inside) == 0 or not rows.any():
                continue
            t = tick[inside]
            rising, falling = fade(t, begin, self._tick_s), fade(t, end, self._tick_s)
            leaving = (1.0 - falling[0], -falling[1], -falling[2])
            out[inside] += weighted(weighted(rows[(t - self.table.begin) % self.table.period], rising), leaving)
        return out

    def _period(self, correction: Complex) -> Array:
        return period_rows(correction, self.table.period, self._tick_s)

    def _teach(self, window: int, complete: bool) -> Iterator[None]:
        """Pieces of work, one a ``yield``."""
        if not complete:
            self.steps.append(Step(window, 0, 0, None))
            return
        table, before = self.table, self._known
        phase = (table.window_begin(window) - table.begin) % table.period
        error = self._seen.reshape(-1, table.period, 3).mean(axis=0) + np.roll(self._lag_m, -phase, axis=0)
        yield
        noise_m2 = noise(error)
        known, lesson = update.learn(before, harmonics(error, phase, len(before.correction)), noise_m2)
        yield
        for share in SCALINGS:
            correction = known.best + share * (known.correction - known.best)
            rows = self._period(correction)
            yield
            for within in self._looked_at(rows):
                yield
                if not within:
                    break
            else:
                break
        else:
            share, correction = 0.0, known.best
            rows = self._period(correction)
        self._known = update.with_correction(known, correction)
        self._changes = [*self._changes[-2:], (table.change(window), rows)]
        self.steps.append(Step(window, lesson.learnt, lesson.reverted, share))

    def _looked_at(self, shift: Array) -> Iterator[bool]:
        return _looked_at(self._reference + shift, self._within_limits)


def require_followed(
    stored: Stored, cutoff_hz: float, trajectory: Trajectory, period_us: int, within_limits: Callable[[Array], bool]
) -> None:
    """Raise ``LearningError`` if a stored correction carries the scan beyond a limit: files come from anywhere.

    A ``Learner`` asks the same; who reads the file asks before anything has begun.
    """
    table, tick_s = timetable(trajectory, period_us), period_us * 1e-6
    start = _beginning(stored, count_up_to(cutoff_hz, table.period, tick_s))
    rows = trajectory.sample(table.begin, table.period, period_us) + period_rows(start, table.period, tick_s)
    _require_followed(rows, within_limits)


def _beginning(stored: Stored | None, count: int) -> Complex:
    """(count, 3): the harmonics that a run begins with."""
    start = np.zeros((count, 3), np.complex128)
    if stored is not None:
        start[: len(stored.harmonics_m)] = stored.harmonics_m[:count]
    return start


def _require_followed(rows: Array, within_limits: Callable[[Array], bool]) -> None:
    if not all(_looked_at(rows, within_limits)):
        raise LearningError(
            "the stored correction carries the scan beyond what the stage can follow: a stroke, a pull, a voltage or "
            "its slew; learn anew (--learn)"
        )


def _looked_at(rows: Array, within_limits: Callable[[Array], bool]) -> Iterator[bool]:
    """Whether each piece of a period, and of its way on into the next one, is within the limits."""
    length = -(-len(rows) // PIECES)
    for begin in range(0, len(rows), length):
        yield within_limits(np.take(rows, np.arange(begin, begin + length + 1), axis=0, mode="wrap"))
