"""The owner of time in lockstep: integer microseconds that move only when the scheduler moves them."""

from collections.abc import Callable, Sized
from heapq import heappop, heappush


class TimeInPastError(ValueError):
    """An event or a target time lies before the present."""


class ClockReentryError(RuntimeError):
    """An event asked the clock to run, while the clock is running that very event."""


class Lockstep:
    """Discrete-event clock.

    Events run in order of time, those of equal time in order of insertion. An event may add events, at its own time
    too, but may not run the clock. If an event raises, the clock stays at that event's time and can be run on.
    """

    __slots__ = ("_heap", "_order", "now_us", "running")

    def __init__(self, start_us: int = 0) -> None:
        self.now_us = start_us  # attributes, not properties, for speed: read them, never assign them
        self.running = False  # True inside an event
        self._heap: list[tuple[int, int, Callable[[], object]]] = []
        self._order = 0

    def call_at(self, t_us: int, fn: Callable[[], object]) -> None:
        """Run ``fn()`` at ``t_us`` (integer, not before now). Raises TimeInPastError."""
        if t_us < self.now_us:
            raise TimeInPastError(f"event at {t_us} us, but it is already {self.now_us} us")
        self._order = order = self._order + 1
        heappush(self._heap, (t_us, order, fn))

    def run_until(self, t_us: int) -> None:
        """Run all events up to and including ``t_us``, then make it ``t_us``.

        Raises TimeInPastError if ``t_us`` is before now, ClockReentryError if called from inside an event.
        """
        if self.running:
            raise ClockReentryError(f"run_until({t_us}) called from inside the event at {self.now_us} us")
        if t_us < self.now_us:
            raise TimeInPastError(f"cannot run until {t_us} us: it is already {self.now_us} us")
        heap = self._heap
        self.running = True
        try:
            while heap and heap[0][0] <= t_us:
                self.now_us, _, fn = heappop(heap)
                fn()
            self.now_us = t_us
        finally:
            self.running = False

    def wait_until(self, t_us: int) -> None:
        """Let events happen until it is ``t_us``; return at once if that is past."""
        if t_us >= self.now_us:
            self.run_until(t_us)

    def first_us(self, is_meant: Callable[[Callable[[], object]], bool]) -> int | None:
        """Time of the first event for which ``is_meant``; None if there is none."""
        heap, found, places = self._heap, None, [0]
        while places:  # below a place nothing is earlier: of thousands of appointments only the next ones are looked at
            place = places.pop()
            if place >= len(heap) or (found is not None and heap[place][0] >= found):
                continue
            if is_meant(heap[place][2]):
                found = heap[place][0]
            else:
                places += (2 * place + 1, 2 * place + 2)
        return found

    def leap(self, t_us: int) -> None:
        """It is ``t_us``: what was due until then runs only now. For who has seen to it that nothing minds."""
        self.now_us = t_us
        while self._heap and self._heap[0][0] <= t_us:
            heappop(self._heap)[2]()

    def spend(self, compute_us: int) -> None:
        """Let ``compute_us`` pass: computing costs what one says that it costs."""
        t_us = self.now_us + compute_us
        if self._heap and self._heap[0][0] <= t_us:
            self.run_until(t_us)
        else:
            self.now_us = t_us

    def run_while_empty(self, queue: Sized, t_us: int) -> None:
        """Run events one by one until ``queue`` holds something or it is ``t_us``; an earlier ``t_us`` is now."""
        if self.running:
            raise ClockReentryError(f"asked to wait until {t_us} us from inside the event at {self.now_us} us")
        heap = self._heap
        self.running = True
        try:
            while not queue:
                if heap and heap[0][0] <= t_us:
                    self.now_us, _, fn = heappop(heap)
                    fn()
                else:
                    self.now_us = max(self.now_us, t_us)
                    break
        finally:
            self.running = False

    def next_event_us(self) -> int | None:
        """Time of the next event, None if there is none."""
        return self._heap[0][0] if self._heap else None

    def run_until_event(self) -> int | None:
        """Run all events of the next event's time; return that time, None (and time stands still) if there is none."""
        if self.running:
            raise ClockReentryError(f"run_until_event() called from inside the event at {self.now_us} us")
        t_us = self.next_event_us()
        if t_us is not None:
            self.run_until(t_us)
        return t_us
