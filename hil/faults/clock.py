"""Faults of the controller's own time: ticks that begin late, ticks that are lost, and the end of the program."""

from collections.abc import Iterator, Sequence
from itertools import chain

from hil.bus.clock import Lockstep
from hil.faults.fault import Fault


class ControllerKilledError(Exception):
    """The controller's program has ended, as far as everybody else can tell."""


class FaultyClock:
    """``runtime.Clock`` over the scheduler's, which wakes the controller when the faults let it."""

    def __init__(self, clock: Lockstep, faults: Sequence[Fault], origin_us: int, period_us: int) -> None:
        self._clock = clock
        self._period_us = period_us
        own = (f for f in faults if f.family == "controller")
        self._to_come = sorted(own, key=lambda f: f.at_us, reverse=True)  # the next is the last
        self._on: list[Fault] = []
        self._origin_us = origin_us
        self._done: set[int] = set()
        self.spend = clock.spend

    @property
    def now_us(self) -> int:
        """As the clock below has it."""
        return self._clock.now_us

    def quiet_until_us(self, t_us: int) -> int | None:
        """Until when ticks from ``t_us`` on are no later than ``late_us`` says; None: for ever; ``t_us``: not even
        this one is.
        """
        now_us, ends = t_us - self._origin_us, []
        for fault in self._in_turn():
            if fault.at_us > now_us:
                ends.append(fault.at_us)
                break
            if fault.is_on(now_us):
                if fault.kind != "late_tick" and id(fault) not in self._done:
                    return t_us
                ends += [] if fault.end_us is None else [fault.end_us]
        return self._origin_us + min(ends) if ends else None

    def late_us(self, t_us: int) -> int:
        """How late the tick of ``t_us`` begins."""
        now_us, late_us = t_us - self._origin_us, 0
        for fault in self._in_turn():
            if fault.at_us > now_us:
                break
            late_us += round(fault["late_us"]) if fault.kind == "late_tick" and fault.is_on(now_us) else 0
        return late_us

    def _in_turn(self) -> Iterator[Fault]:
        """All that are not over, as they begin."""
        return chain(self._on, reversed(self._to_come))

    def _due(self) -> list[Fault]:
        """Those that are on; what is over is forgotten."""
        now_us = self._clock.now_us - self._origin_us
        while self._to_come and self._to_come[-1].at_us <= now_us:
            self._on.append(self._to_come.pop())
        if self._on:
            self._on = [f for f in self._on if f.is_on(now_us)]
        return self._on

    def wait_until(self, t_us: int) -> None:
        """Return at ``t_us``, or later; raises ``ControllerKilledError`` if there is nobody any more to return to."""
        clock = self._clock
        clock.wait_until(t_us)
        for fault in self._due():
            if fault.kind == "killed":
                raise ControllerKilledError
            if fault.kind == "late_tick":
                clock.wait_until(clock.now_us + round(fault["late_us"]))
            elif id(fault) not in self._done:
                self._done.add(id(fault))
                clock.wait_until(clock.now_us + round(fault["ticks"]) * self._period_us)
