"""The fixed-rate loop: wait, exchange, compute, record. Whoever owns the time and the bus is handed in.

The same loop runs in lockstep, at wall-clock rate and against hardware; only ``Clock`` and ``Port`` differ.
"""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.loop.controller import Controller

_POLL_US = 1000
_UNPOLLED_MOST_US = 20_000  # of a start-up in which frame after frame comes, none of them the one that is waited for

Reference = Callable[[int], NDArray[np.void]]
"""Rows of ``REFERENCE`` for the tick of an index."""


class Clock(Protocol):
    """Who owns the time. Integer microseconds."""

    @property
    def now_us(self) -> int: ...

    def wait_until(self, t_us: int) -> None:
        """Return at ``t_us``, or at once if that is past."""

    def spend(self, compute_us: int) -> None:
        """Account for the time that computing takes; on a clock that runs by itself there is nothing to do."""


class Port(Protocol):
    """One connection to a bus."""

    def send(self, frame: Frame) -> object: ...

    def receive(self, deadline_us: int) -> Frame | None:
        """The next frame, or None once it is ``deadline_us``; one that already waits may come later than that."""

    def unsent(self) -> int:
        """Frames that still wait to go out, as far as the port can tell."""


def start(clock: Clock, port: Port, controller: Controller) -> None:
    """Bring the amplifier to operation. Raises ``StartUpError``."""
    controller.start(clock.now_us)
    polled_us = clock.now_us
    while True:
        frame = port.receive(clock.now_us + _POLL_US)
        if frame is None:
            polled_us = clock.now_us
        elif clock.now_us - polled_us > _UNPOLLED_MOST_US:
            polled_us = clock.now_us
            controller.dialogue(None, polled_us)
        if controller.dialogue(frame, clock.now_us):
            return


def run(
    clock: Clock, port: Port, controller: Controller, reference: Reference, ticks: int, record: Callable[[int], object]
) -> None:
    """Run ``ticks`` periods from the next instant of ``clock``. The controller counts those that are missed."""
    go_on(clock, port, controller, reference, range(ticks), record, clock.now_us + controller.period_us)


def go_on(
    clock: Clock, port: Port, controller: Controller, reference: Reference, ticks: range,
    record: Callable[[int], object], t_us: int,
) -> int:  # fmt: skip
    """Run these ticks, the first of them at ``t_us``. Returns when the one behind them begins.

    Deadlines are absolute: a tick that begins late shifts no other, and ticks that are past are skipped whole. Other
    frames than the one that is waited for do not put the deadline off, however many there are.
    """
    period_us, compute_us = controller.period_us, controller.can.compute_us
    answer_us, heartbeat_us = controller.can.sense_deadline_us, controller.can.heartbeat_deadline_us
    begin, receive, compute, finish = controller.begin, controller.receive, controller.compute, controller.finish
    wait_until, spend, receive_frame, unsent = clock.wait_until, clock.spend, port.receive, port.unsent
    for tick in ticks:
        wait_until(t_us)
        overrun = 0
        if clock.now_us - t_us >= period_us:
            overrun = (clock.now_us - t_us) // period_us
            t_us += overrun * period_us
        if unsent():
            controller.missed_ticks += 1
        begin(t_us)
        deadline_us = t_us + answer_us
        while (frame := receive_frame(deadline_us)) is not None:
            if receive(frame, clock.now_us) or clock.now_us > deadline_us:
                break
        compute(reference(tick), overrun)
        spend(compute_us)
        finish(clock.now_us, t_us + heartbeat_us)
        record(tick)
        t_us += period_us
    return t_us
