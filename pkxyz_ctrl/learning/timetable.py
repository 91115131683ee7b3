"""When is learnt and when is changed: ticks of the trajectory, the same in every lane and at the wall clock.

A window of whole periods is looked at; ``LEAD_TICKS`` later what it taught begins to act, and fades in; when that has
settled, the next window begins.
"""

import math
from dataclasses import dataclass

from pkxyz_ctrl.learning.config import LearningError
from pkxyz_ctrl.trajectory import Trajectory

LEAD_TICKS = 100
"""From the end of a window to where its update begins to act: time to compute, in pieces, and the law's preview."""
FADE_TICKS = 50
"""In which one correction gives way to the next: 10 ms at 5 kHz, six periods of the first resonance."""
SETTLE_TICKS = 50
"""After that, before the next window: what the change stirred up is gone."""
WINDOW_MIN_TICKS = 200
"""A shorter period is averaged over as many of it as make this."""
PERIOD_MIN_TICKS = 16

_DRIFT_TICKS = 1e-6  # from period to period, for decimals that are none in binary


@dataclass(frozen=True)
class Timetable:
    """Of the one scan of a trajectory that repeats. All in ticks; ticks of the trajectory count from its start."""

    segment: int
    """of the trajectory"""
    begin: int
    """first tick of the scan"""
    end: int
    """first tick after it"""
    period: int
    """N"""
    window: int
    """whole periods"""

    def window_begin(self, n: int) -> int:
        """First tick of window n = 0, 1, ..."""
        return self.begin + SETTLE_TICKS + n * (self.window + LEAD_TICKS + FADE_TICKS + SETTLE_TICKS)

    def window_end(self, n: int) -> int:
        """First tick after window n: here its rows are needed."""
        return self.window_begin(n) + self.window

    def change(self, n: int) -> int:
        """Tick at which what was learnt from window n begins to fade in."""
        return self.window_end(n) + LEAD_TICKS

    @property
    def windows(self) -> int:
        """How many windows end inside the scan, early enough for what they teach to act there."""
        step = self.window_begin(1) - self.window_begin(0)
        return max(0, (self.end - FADE_TICKS - self.change(0)) // step + 1)

    @property
    def periods(self) -> int:
        """Whole periods in the scan."""
        return (self.end - self.begin) // self.period


def timetable(trajectory: Trajectory, period_us: int) -> Timetable:
    """Raises ``LearningError`` for a trajectory without exactly one scan that repeats, each time in whole ticks."""
    found = [(n, s) for n, s in enumerate(trajectory.segments) if s.period_s is not None and s.scan_us is not None]
    if len(found) != 1:
        kinds = ", ".join(f"reference.{n} ({s.kind})" for n, s in found) or "none does"
        raise LearningError(
            "learning: needs exactly one segment that repeats itself (a raster with frames, circle, sine, lissajous, "
            f"rosette); here: {kinds}"
        )
    n, segment = found[0]
    assert segment.period_s is not None
    assert segment.scan_us is not None
    ticks = segment.period_s * 1e6 / period_us
    period = round(ticks)
    where = f"learning: reference.{n} ({segment.kind})"
    if abs(ticks - period) > _DRIFT_TICKS:
        raise LearningError(
            f"{where} repeats after {segment.period_s * 1e3:.6g} ms, which is {ticks:.6g} ticks of {period_us} us; "
            "choose a rate that makes it a whole number"
        )
    if period < PERIOD_MIN_TICKS:
        raise LearningError(f"{where} repeats after {period} ticks; at least {PERIOD_MIN_TICKS} are needed")
    begin, end = -(-segment.scan_us[0] // period_us), segment.scan_us[1] // period_us
    table = Timetable(n, begin, end, period, period * math.ceil(WINDOW_MIN_TICKS / period))
    if table.windows < 1:
        raise LearningError(
            f"{where} ends before anything learnt could act: it lasts {end - begin} ticks and needs "
            f"{table.change(0) + FADE_TICKS - begin}; let it run for more periods (frames, turns, cycles, duration_s)"
        )
    return table
