"""The machine's clock for ``runtime``: sleep until shortly before the instant, then spin."""

import time
from collections.abc import Callable

SPIN_US = 60
"""How long before an instant sleeping ends: more than a wake-up is late (20-30 us at p99.9 under SCHED_FIFO), and too
little for the kernel's throttle of real-time processes (95 %) even at 5 kHz."""

HISTOGRAM_US = 2000
"""Entries of a histogram by whole microseconds, the last all beyond."""


class WallClock:
    """``runtime.Clock`` that runs by itself: integer microseconds of CLOCK_MONOTONIC since it was made, less those for
    which it stood still.
    """

    def __init__(self, spin_us: int = SPIN_US) -> None:
        self._origin_ns = time.monotonic_ns()
        self._stood_ns = 0
        self._spin_us = spin_us

    @property
    def now_us(self) -> int:
        """Microseconds since the clock was made."""
        return (time.monotonic_ns() - self._origin_ns) // 1000

    def wait_until(self, t_us: int) -> None:
        """Return at ``t_us``, or at once if that is past."""
        monotonic_ns, end_ns = time.monotonic_ns, self._origin_ns + t_us * 1000
        sleep_ns = end_ns - monotonic_ns() - self._spin_us * 1000
        if sleep_ns > 0:
            time.sleep(sleep_ns * 1e-9)  # clock_nanosleep to an absolute time, resumed after signals
        while monotonic_ns() < end_ns:
            pass

    def stand_at(self, t_us: int) -> None:
        """It is ``t_us`` again, where it has become later."""
        stood_ns = time.monotonic_ns() - t_us * 1000 - self._origin_ns
        if stood_ns > 0:
            self._origin_ns += stood_ns
            self._stood_ns += stood_ns

    @property
    def stood_us(self) -> int:
        """For how long the clock stood still, in all."""
        return self._stood_ns // 1000

    def spend(self, compute_us: int) -> None:
        """Computing takes the time that it takes."""


class TickClock:
    """A ``runtime.Clock`` for a loop at rate: it looks after what a tick must not begin with.

    - What came after a tick had given up waiting is taken before the next tick begins, by ``late_frames``, which is
      told until when there is time for it. Otherwise a single sense frame that was late would leave every later one to
      be taken a tick too late.
    - A tick that is woken so late that no answer could come in time, more than ``latest_start_us``, is given up: it
      waits for the next, and the loop counts it as skipped.
    - So is a tick whose predecessor ended less than ``guard_us`` before it began: two drive frames would be too near.
    - For ``standstill_us`` the clock stands still instead, and no tick is given up. Nor does what is computed come so
      late that the next tick would be.

    ``lateness_us`` counts wake-ups by whole microseconds of lateness, the last entry all beyond.
    """

    def __init__(
        self,
        clock: WallClock,
        period_us: int,
        *,
        latest_start_us: int,
        guard_us: int,
        standstill_us: int = 0,
        late_frames: Callable[[int], object] = lambda until_us: None,
        leave: Callable[[], object] = lambda: None,
    ) -> None:
        """``leave`` is called between ticks; it raises what is to end the loop."""
        self._clock = clock
        self._period_us = period_us
        self._latest_start_us = latest_start_us
        self._guard_us = guard_us
        self._standstill_us = standstill_us
        self._late_frames = late_frames
        self._leave = leave
        self.lateness_us = [0] * HISTOGRAM_US
        self._begun_us = 0

    @property
    def now_us(self) -> int:
        """As the clock below has it."""
        return self._clock.now_us

    def wait_until(self, t_us: int) -> None:
        """Return at ``t_us``, or at a later tick where that one is given up."""
        clock, period_us, lateness = self._clock, self._period_us, self.lateness_us
        while True:
            self._leave()
            behind_us = clock.now_us + self._guard_us - t_us
            if 0 < behind_us <= self._standstill_us:
                clock.stand_at(t_us - self._guard_us)
            elif behind_us > 0:
                t_us += -(-behind_us // period_us) * period_us
            last_look_us = t_us - self._guard_us // 2
            self._late_frames(last_look_us)
            clock.wait_until(last_look_us)
            self._late_frames(t_us)  # what comes later than this came in a tick of its own
            clock.wait_until(t_us)
            late_us = clock.now_us - t_us
            count_us(lateness, late_us)
            if self._latest_start_us < late_us <= self._standstill_us:
                clock.stand_at(t_us)
            elif late_us > self._latest_start_us:
                continue
            self._begun_us = t_us
            return

    def spend(self, compute_us: int) -> None:
        """Computing takes the time that it takes, unless time may stand still."""
        spent_at_most_us = self._period_us - 2 * self._guard_us
        if self._standstill_us and self._clock.now_us < self._begun_us + spent_at_most_us + self._standstill_us:
            self._clock.stand_at(self._begun_us + spent_at_most_us)


def count_us(histogram: list[int], time_us: int, times: int = 1) -> None:
    """``time_us`` came so many ``times`` more, in a histogram by whole microseconds."""
    last_us = len(histogram) - 1
    histogram[time_us if time_us < last_us else last_us] += times


def percentile_us(histogram: list[int], share: float) -> int:
    """The time in us that a share 0..1 of those counted does not exceed; 0 if there were none."""
    wanted, seen = share * sum(histogram), 0
    for time_us, count in enumerate(histogram):
        seen += count
        if seen >= wanted:
            return time_us
    return 0
