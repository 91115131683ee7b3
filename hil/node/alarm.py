"""A timer that can be moved and cancelled, on a clock whose appointments cannot."""

from collections.abc import Callable
from typing import Protocol


class Scheduler(Protocol):
    """Owner of time: integer microseconds, and appointments that are kept in order."""

    @property
    def now_us(self) -> int: ...

    def call_at(self, t_us: int, fn: Callable[[], None], /) -> object: ...


class Alarm:
    """Rings once at ``due_us``. Moving it to a later time costs nothing: the pending appointment renews itself."""

    __slots__ = ("_armed_us", "_clock", "_ring", "due_us")

    def __init__(self, clock: Scheduler, ring: Callable[[int], None]) -> None:
        self._clock = clock
        self._ring = ring
        self._armed_us: int | None = None  # the appointment that counts; earlier-made ones wake up and go back to sleep
        self.due_us: int | None = None

    def set(self, t_us: int) -> None:
        """Ring at ``t_us`` (not before now) instead of whenever it was to ring."""
        self.due_us = t_us
        if self._armed_us is None or t_us < self._armed_us:
            self._armed_us = t_us
            self._clock.call_at(t_us, self._wake)

    def cancel(self) -> None:
        self.due_us = None

    def _wake(self) -> None:
        now_us = self._clock.now_us
        if self._armed_us is None or now_us < self._armed_us:
            return
        self._armed_us = None
        due_us = self.due_us
        if due_us is None:
            return
        if now_us < due_us:
            self.set(due_us)
        else:
            self.due_us = None
            self._ring(now_us)
