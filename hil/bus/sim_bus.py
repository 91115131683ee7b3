"""The simulated wire as a python-can interface: ``can.Bus(interface="pkxyz-sim", channel=...)``.

canopen, cantools and python-can's own tools attach to the wire through it. It is for tools and tests: the loop talks
to ``Wire`` itself, since a python-can ``Message`` costs several microseconds.

Time is the wire's: ``timestamp`` is simulated seconds and ``recv`` lets simulated time pass. No threads: a ``Notifier``
would run the clock from another thread and must not be used; call ``recv`` and hand messages on instead.
"""

from collections import deque
from collections.abc import Callable, Sequence
from itertools import count

import can
from can.broadcastmanager import (
    LimitedDurationCyclicSendTaskABC,
    ModifiableCyclicTaskABC,
    RestartableCyclicTaskABC,
)

from hil.bus.clock import Lockstep
from hil.bus.endpoint import ErrorState
from hil.bus.frame_time import FrameFormatError
from hil.bus.published_wires import find_wire, publish
from hil.bus.wire import Wire
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.io.can_port import to_frame

_STATES = {
    ErrorState.ACTIVE: can.BusState.ACTIVE,
    ErrorState.PASSIVE: can.BusState.PASSIVE,
    ErrorState.BUS_OFF: can.BusState.ERROR,
}
_numbers = count(1)


def to_message(frame: Frame, t_us: int, channel: str, is_rx: bool = True) -> can.Message:
    """``frame`` with its time; seconds are ``t_us * 1e-6``."""
    return can.Message(
        timestamp=t_us * 1e-6,
        arbitration_id=frame.can_id,
        is_extended_id=frame.is_extended,
        is_remote_frame=frame.is_remote,
        is_error_frame=frame.is_error,
        channel=channel,
        dlc=len(frame.data),
        data=None if frame.is_remote else frame.data,
        is_fd=frame.is_fd,
        is_rx=is_rx,
        bitrate_switch=frame.bitrate_switch,
    )


class SimBus(can.BusABC):
    """One endpoint of the wire published as ``channel``; if there is none, a wire with a clock of its own is made.

    ``fd``, ``bitrate`` and ``data_bitrate`` (bit/s) describe a new wire: 1 Mbit/s, and 5 Mbit/s for data if ``fd``.
    Given for an existing wire they must agree with it; ``timing`` gives the same. ``single_handle``, which python-can's
    tools give to every interface, means nothing here. The wire lives as long as someone holds it.
    """

    def __init__(
        self,
        channel: str,
        can_filters: can.typechecking.CanFilters | None = None,
        fd: bool | None = None,
        bitrate: int | None = None,
        data_bitrate: int | None = None,
        receive_own_messages: bool = False,
        receive_error_frames: bool = True,
        listen_only: bool = False,
        queue_limit: int = 4096,
        timing: can.BitTiming | can.BitTimingFd | None = None,
        single_handle: bool = True,
    ) -> None:
        channel = str(channel)
        if isinstance(timing, can.BitTimingFd):
            fd, bitrate, data_bitrate = True, timing.nom_bitrate, timing.data_bitrate
        elif timing is not None:
            bitrate = timing.bitrate
        self.wire = _existing_or_new_wire(channel, fd, bitrate, data_bitrate)
        self._inbox: deque[tuple[Frame, int, bool]] = deque()
        self._queue_limit = queue_limit
        self.overruns = 0
        self.endpoint = self.wire.attach(
            f"{channel} #{next(_numbers)}",
            lambda frame, t_us: self._keep(frame, t_us, True),
            queue_limit,
            on_sent=(lambda frame, t_us: self._keep(frame, t_us, False)) if receive_own_messages else None,
            listen_only=listen_only,
            error_frames=receive_error_frames,
        )
        self.channel = channel
        self.channel_info = f"pkxyz-sim {channel}"
        super().__init__(channel, can_filters)
        is_fd = self.wire.data_bitrate is not None
        self._can_protocol = can.CanProtocol.CAN_FD if is_fd else can.CanProtocol.CAN_20

    def _keep(self, frame: Frame, t_us: int, is_rx: bool) -> None:
        if len(self._inbox) < self._queue_limit:
            self._inbox.append((frame, t_us, is_rx))
        else:
            self.overruns += 1

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Queue ``msg``; it is on the wire as time passes. ``timeout`` (s): how long to wait for room in the queue.

        Raises CanOperationError if the wire cannot carry it, the queue stays full or the endpoint is bus-off.
        """
        frame = to_frame(msg)
        clock = self.wire.clock
        deadline_us = clock.now_us + round(1e6 * (timeout or 0.0))
        try:
            while not self.endpoint.send(frame):
                next_us = clock.next_event_us()
                if clock.running or next_us is None or next_us > deadline_us:
                    reason = "bus-off" if self.endpoint.bus_off else "the transmit queue is full"
                    raise can.CanOperationError(f"{self.channel_info}: {reason}")
                clock.run_until(next_us)
        except (FrameFormatError, RuntimeError) as error:
            raise can.CanOperationError(f"{self.channel_info}: {error}") from error

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The oldest message that passes the filters; simulated time passes until one comes, at most ``timeout`` s.

        None if none came, or if with no timeout nothing is left that could ever happen. From inside an event of the
        clock this never waits.
        """
        clock = self.wire.clock
        deadline_us = None if timeout is None else clock.now_us + max(0, round(timeout * 1e6))
        while True:
            while self._inbox:
                message = to_message(*self._from_inbox())
                if self._matches_filters(message):
                    return message
            if clock.running or deadline_us == clock.now_us:
                return None
            next_us = clock.next_event_us()
            if deadline_us is not None and (next_us is None or next_us > deadline_us):
                next_us = deadline_us
            if next_us is None:
                return None
            clock.run_until(next_us)

    def _from_inbox(self) -> tuple[Frame, int, str, bool]:
        frame, t_us, is_rx = self._inbox.popleft()
        return frame, t_us, self.channel, is_rx

    def _send_periodic_internal(
        self,
        msgs: Sequence[can.Message] | can.Message,
        period: float,
        duration: float | None = None,
        autostart: bool = True,
        modifier_callback: Callable[[can.Message], None] | None = None,
    ) -> "LockstepCyclicTask":
        return LockstepCyclicTask(self, msgs, period, duration, autostart, modifier_callback)

    @property
    def state(self) -> can.BusState:
        return _STATES[self.endpoint.state]

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        raise can.CanOperationError("the error state can't be set: it follows from what happens on the wire")

    def flush_tx_buffer(self) -> None:
        self.endpoint.flush()

    def shutdown(self) -> None:
        super().shutdown()
        self.endpoint.detach()


class LockstepCyclicTask(LimitedDurationCyclicSendTaskABC, ModifiableCyclicTaskABC, RestartableCyclicTaskABC):
    """Periodic sending by events of the lockstep clock, where python-can would start a thread.

    ``period`` and ``duration`` in s; the period is rounded to whole microseconds. What a full queue or bus-off
    refuses is counted in the endpoint's ``send_drops``.
    """

    def __init__(
        self,
        bus: SimBus,
        messages: Sequence[can.Message] | can.Message,
        period: float,
        duration: float | None,
        autostart: bool,
        modifier_callback: Callable[[can.Message], None] | None,
    ) -> None:
        super().__init__(messages, period, duration)
        self._bus = bus
        self._period_us = max(1, round(period * 1e6))
        self._modify = modifier_callback
        self._running = False
        self._round = 0  # outdates the events of an earlier start
        self._sent = 0
        self._end_us: int | None = None
        if autostart:
            self.start()

    def start(self) -> None:
        if self._running:
            return
        self._running = True
        self._round += 1
        self._sent = 0
        now_us = self._bus.wire.clock.now_us
        self._end_us = None if self.duration is None else now_us + round(self.duration * 1e6)
        self._send(self._round, now_us)

    def stop(self) -> None:
        self._running = False

    def _send(self, start_round: int, t_us: int) -> None:
        if not self._running or start_round != self._round:
            return
        if self._bus._is_shutdown or (self._end_us is not None and t_us >= self._end_us):
            self._running = False
            return
        message = self.messages[self._sent % len(self.messages)]
        self._sent += 1
        if self._modify is not None:
            self._modify(message)
        self._bus.endpoint.send(to_frame(message))
        next_us = t_us + self._period_us
        self._bus.wire.clock.call_at(next_us, lambda: self._send(start_round, next_us))


def _existing_or_new_wire(channel: str, fd: bool | None, bitrate: int | None, data_bitrate: int | None) -> Wire:
    wire = find_wire(channel)
    if wire is None:
        if data_bitrate is not None and fd is False:
            raise can.CanInitializationError(f"channel {channel!r}: data_bitrate needs fd=True")
        fast = (data_bitrate or 5_000_000) if fd or data_bitrate else None
        try:
            wire = Wire(Lockstep(), bitrate or 1_000_000, fast)
        except ValueError as error:
            raise can.CanInitializationError(f"channel {channel!r}: {error}") from error
        publish(wire, channel)
        return wire
    for name, wanted, actual in (
        ("fd", fd, wire.data_bitrate is not None),
        ("bitrate", bitrate, wire.nominal_bitrate),
        ("data_bitrate", data_bitrate, wire.data_bitrate),
    ):
        if wanted is not None and wanted != actual:
            raise can.CanInitializationError(f"channel {channel!r} exists with {name}={actual}, not {wanted}")
    return wire
