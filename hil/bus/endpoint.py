"""A CAN controller on the simulated wire: its queues, its error counters and its error state."""

from collections import deque
from collections.abc import Callable
from enum import IntEnum
from heapq import heappush
from typing import TYPE_CHECKING

from hil.bus.frame_time import FrameFormatError, frame_duration_ns
from pkxyz_ctrl.can.frame import Frame

if TYPE_CHECKING:
    from hil.bus.wire import Wire


class ErrorState(IntEnum):
    ACTIVE = 0
    PASSIVE = 1  # a counter at 128 or more
    BUS_OFF = 2  # transmit counter at 256 or more


_REMEMBERED = 1024  # identifiers, and durations of each

Listener = Callable[[Frame, int], object]
Entry = tuple[int, int, Frame, int]  # arbitration key, order of queueing, frame, duration_ns
Kind = tuple[int, int, dict[bytes, int]]  # flags, arbitration key, durations of frames that recur
_UNSEEN: Kind = (-1, 0, {})


class Endpoint:
    """One CAN controller on a wire, made by ``Wire.attach``."""

    __slots__ = (
        "_earliest_ns",
        "_kinds",
        "_listeners",
        "_on_frame",
        "_queues",
        "_received",
        "_recovery_runs",
        "_take",
        "_to_send",
        "_wire",
        "auto_recover",
        "bus_off",
        "error_frames",
        "listen_only",
        "name",
        "on_full",
        "on_sent",
        "overruns",
        "pending",
        "queue_limit",
        "receive_errors",
        "send_drops",
        "transmit_errors",
    )

    def __init__(
        self,
        wire: "Wire",
        name: str,
        on_frame: Listener | None,
        queue_limit: int,
        on_full: Callable[[], object] | None,
        on_sent: Listener | None,
        listen_only: bool,
        error_frames: bool,
        auto_recover: bool,
    ) -> None:
        self._wire: Wire | None = wire
        self.name = name
        self._on_frame = on_frame
        self._take: Listener = on_frame or self._keep  # what becomes of a frame of another
        self.on_sent = on_sent
        self.queue_limit = queue_limit
        self.on_full = on_full
        self.listen_only = listen_only
        self.error_frames = error_frames
        self.auto_recover = auto_recover
        self.transmit_errors = 0  # TEC of ISO 11898-1
        self.receive_errors = 0  # REC
        self.bus_off = False
        self.overruns = 0  # frames lost because the receive queue was full
        self.send_drops = 0  # frames refused or discarded unsent
        self._to_send: list[Entry] = []
        self.pending = self._to_send.__len__
        """Number of frames queued and not yet sent, the one on the wire included."""
        self._kinds: dict[int, Kind] = {}  # by identifier: the latest that was sent
        self._listeners: tuple[Endpoint, ...] = ()  # the others that are called, and those whose queues are filled
        self._queues: tuple[tuple[deque[tuple[Frame, int]], int, Endpoint], ...] = ()
        self._received: deque[tuple[Frame, int]] = deque()
        self._earliest_ns = 0
        self._recovery_runs = 0

    @property
    def on_frame(self) -> Listener | None:
        """Called with each frame of the others and the time in us at which it ended; None: they are queued."""
        return self._on_frame

    @on_frame.setter
    def on_frame(self, on_frame: Listener | None) -> None:
        self._on_frame = on_frame
        self._take = on_frame or self._keep
        if self._wire is not None:
            self._wire._introduce()

    @property
    def state(self) -> ErrorState:
        if self.bus_off:
            return ErrorState.BUS_OFF
        return ErrorState.PASSIVE if self._is_passive() else ErrorState.ACTIVE

    def _is_passive(self) -> bool:
        return self.transmit_errors >= 128 or self.receive_errors >= 128

    def send(self, frame: Frame) -> bool:
        """Queue ``frame``; False if it was refused because the queue is full or the endpoint is bus-off.

        Raises FrameFormatError for a frame that cannot exist on this wire, RuntimeError if detached or listen-only.
        """
        wire = self._wire
        if wire is not None and wire._is_calm:
            # The short way, for speed: a frame of a kind that was sent before, with nothing else on its way.
            can_id, data, flags = frame
            known_flags, key, known_ns = self._kinds.get(can_id, _UNSEEN)
            if flags == known_flags:
                duration_ns = (known_ns and known_ns.get(data)) or wire._duration_ns(can_id, data, flags)
                if duration_ns > 0:
                    wire._is_calm = False
                    wire._sender = self
                    wire._entry = entry = key, 0, frame, duration_ns
                    self._to_send.append(entry)
                    start_ns = wire.clock.now_us * 1000
                    if start_ns < wire._free_ns:
                        start_ns = wire._free_ns
                    wire._start_ns = start_ns
                    wire._end_us = end_us = (start_ns + duration_ns + wire._to_end_ns) // 1000
                    wire._call_at(end_us, wire._completion)
                    return True
        return self._queue(frame)

    def _queue(self, frame: Frame) -> bool:
        wire = self._wire
        if wire is None or self.listen_only:
            raise RuntimeError(f"endpoint {self.name!r} is {'listen-only' if wire else 'detached'}")
        is_passive = self._is_passive()
        duration_ns = frame_duration_ns(frame, *wire._bitrates, is_passive)
        if frame.is_fd and wire.data_bitrate is None:
            raise FrameFormatError("a CAN FD frame on a classic wire (no data bit rate)")
        if self.bus_off or len(self._to_send) >= self.queue_limit:
            self.send_drops += 1
            return False
        key = arbitration_key(frame)
        if not is_passive:
            self._remember(frame, key, duration_ns)
        wire._has_queue = True
        wire._order = order = wire._order + 1
        heappush(self._to_send, (key, order, frame, duration_ns))
        if not wire._has_started():
            wire._arbitrate()
        return True

    def _remember(self, frame: Frame, key: int, duration_ns: int) -> None:
        can_id, data, flags = frame
        if can_id not in self._kinds and len(self._kinds) >= _REMEMBERED:
            return
        kind = self._kinds.get(can_id, _UNSEEN)
        if kind[0] != flags:
            kind = self._kinds[can_id] = flags, key, {}
        if len(data) < 3 and len(kind[2]) < _REMEMBERED:  # SYNC and heartbeats recur; process data hardly ever does
            kind[2][data] = duration_ns

    def _keep(self, frame: Frame, t_us: int) -> None:
        """Queue a frame that has come."""
        if len(self._received) < self.queue_limit:
            self._received.append((frame, t_us))
        else:
            self._overrun(frame, t_us)

    def _overrun(self, frame: Frame, t_us: int) -> None:
        """There is no room for a frame that has come."""
        if self._wire is None:
            return
        if self.on_full is not None:
            self.on_full()
        if len(self._received) < self.queue_limit:
            self._received.append((frame, t_us))
        else:
            self.overruns += 1

    def receive_nowait(self) -> tuple[Frame, int] | None:
        """The oldest received frame and its time in us, None if there is none. For endpoints without ``on_frame``."""
        return self._received.popleft() if self._received else None

    def receive(self, deadline_us: int) -> Frame | None:
        """The oldest received frame; time passes until there is one, or until ``deadline_us``, and then it is None."""
        received = self._received
        if not received and self._wire is not None:
            self._wire.clock.run_while_empty(received, deadline_us)
        return received.popleft()[0] if received else None

    def receive_all(self) -> list[tuple[Frame, int]]:
        """All received frames with their times, oldest first."""
        received = list(self._received)
        self._received.clear()
        return received

    def flush(self) -> None:
        """Discard all queued frames but the one on the wire."""
        wire = self._wire
        kept = [e for e in self._to_send if wire is not None and wire._has_started() and e is wire._entry]
        self.send_drops += len(self._to_send) - len(kept)
        self._to_send[:] = kept
        if wire is not None and wire._end_us >= 0 and not wire._has_started() and wire._sender is self:
            wire._arbitrate()

    def recover(self) -> None:
        """Leave bus-off after 128 runs of 11 recessive bits. For endpoints without ``auto_recover``."""
        if self.bus_off and self._wire is not None:
            self._wire._begin_recovery(self)

    def detach(self) -> None:
        """Unplug. A frame on its way is cut off; received frames stay readable."""
        if self._wire is not None:
            self._wire._detach(self)

    def _unplug(self) -> None:
        self._wire = None
        self._on_frame = self.on_sent = None
        self._take = _ignore  # in the middle of a delivery, too
        self._received = self._received.copy()
        self.bus_off = True
        self.send_drops += len(self._to_send)
        self._to_send.clear()


def _ignore(frame: Frame, t_us: int) -> None:
    """What a controller does with a frame that has no wire."""


def arbitration_key(frame: Frame) -> int:
    """The bits that arbitrate, as one number: the smaller wins. Base identifier, RTR or SRR, IDE, extension, RTR."""
    if not frame.is_extended:
        return frame.can_id << 21 | frame.is_remote << 20
    return (frame.can_id >> 18) << 21 | 3 << 19 | (frame.can_id & 0x3FFFF) << 1 | frame.is_remote


def dominance(frame: Frame) -> tuple[bool, int, bytes]:
    """Order of frames with equal arbitration bits: the first bit where they differ decides (FDF, DLC, data)."""
    return frame.is_fd, len(frame.data), frame.data
