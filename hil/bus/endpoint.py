"""A CAN controller on the simulated wire: its queues, its error counters and its error state."""

from collections import deque
from collections.abc import Callable
from enum import IntEnum
from typing import Protocol

from hil.bus.arbitration import Entry
from hil.bus.clock import Lockstep
from pkxyz_ctrl.can.frame import Frame


class ErrorState(IntEnum):
    ACTIVE = 0
    PASSIVE = 1  # a counter at 128 or more
    BUS_OFF = 2  # transmit counter at 256 or more


Listener = Callable[[Frame, int], object]
Kind = tuple[int, int, dict[bytes, int]]  # flags, arbitration key, durations of frames that recur


class Medium(Protocol):
    """What a CAN controller is plugged into: it carries the frames, and knows when."""

    clock: Lockstep

    def way_in(self, sender: "Endpoint") -> Callable[[Frame], bool]:
        """What queues a frame of ``sender``."""

    def flush(self, endpoint: "Endpoint") -> None: ...

    def recover(self, endpoint: "Endpoint") -> None: ...

    def detach(self, endpoint: "Endpoint") -> None: ...

    def introduce(self) -> None:
        """Find out anew who is to get whose frames."""


class Endpoint:
    """One CAN controller on a wire, made by ``Wire.attach``."""

    __slots__ = (
        "_earliest_ns",
        "_kinds",
        "_listeners",
        "_medium",
        "_on_frame",
        "_queues",
        "_received",
        "_take",
        "_to_send",
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
        "send",
        "send_drops",
        "transmit_errors",
    )

    def __init__(
        self,
        medium: Medium,
        name: str,
        on_frame: Listener | None,
        queue_limit: int,
        on_full: Callable[[], object] | None,
        on_sent: Listener | None,
        listen_only: bool,
        error_frames: bool,
        auto_recover: bool,
    ) -> None:
        self._medium: Medium | None = medium
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
        self._to_send: list[Entry] = []  # a heap, and the same list for ever
        self.pending = self._to_send.__len__
        """Number of frames queued and not yet sent, the one on the wire included."""
        self._kinds: dict[int, Kind] = {}  # by identifier: the latest that was sent
        self.send = medium.way_in(self)
        """Queue a frame; False if it was refused because the queue is full or the endpoint is bus-off.

        Raises FrameFormatError for a frame that cannot exist on this wire, RuntimeError if detached or listen-only.
        """
        self._listeners: tuple[Endpoint, ...] = ()  # the others that are called, and those whose queues are filled
        self._queues: tuple[tuple[deque[tuple[Frame, int]], int, Endpoint], ...] = ()
        self._received: deque[tuple[Frame, int]] = deque()
        self._earliest_ns = 0

    @property
    def on_frame(self) -> Listener | None:
        """Called with each frame of the others and the time in us at which it ended; None: they are queued."""
        return self._on_frame

    @on_frame.setter
    def on_frame(self, on_frame: Listener | None) -> None:
        self._on_frame = on_frame
        self._take = on_frame or self._keep
        if self._medium is not None:
            self._medium.introduce()

    @property
    def state(self) -> ErrorState:
        if self.bus_off:
            return ErrorState.BUS_OFF
        return ErrorState.PASSIVE if self.is_passive else ErrorState.ACTIVE

    @property
    def is_passive(self) -> bool:
        """True if a counter is at 128 or more."""
        return self.transmit_errors >= 128 or self.receive_errors >= 128

    def _keep(self, frame: Frame, t_us: int) -> None:
        """Queue a frame that has come."""
        if len(self._received) < self.queue_limit:
            self._received.append((frame, t_us))
        else:
            self._overrun(frame, t_us)

    def _overrun(self, frame: Frame, t_us: int) -> None:
        """There is no room for a frame that has come."""
        if self._medium is None:
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
        if not received and self._medium is not None:
            self._medium.clock.run_while_empty(received, deadline_us)
        return received.popleft()[0] if received else None

    def receive_all(self) -> list[tuple[Frame, int]]:
        """All received frames with their times, oldest first."""
        received = list(self._received)
        self._received.clear()
        return received

    def put_back(self, received: list[tuple[Frame, int]]) -> None:
        """Frames that were taken and not read, oldest first: they are the next ones."""
        self._received.extendleft(reversed(received))

    def flush(self) -> None:
        """Discard all queued frames but the one on the wire."""
        if self._medium is not None:
            self._medium.flush(self)

    def recover(self) -> None:
        """Leave bus-off after 128 runs of 11 recessive bits. For endpoints without ``auto_recover``."""
        if self.bus_off and self._medium is not None:
            self._medium.recover(self)

    def detach(self) -> None:
        """Unplug. A frame on its way is cut off; received frames stay readable."""
        if self._medium is not None:
            self._medium.detach(self)

    def _unplug(self) -> None:
        self._medium = None
        self._on_frame = self.on_sent = None
        self._take = _ignore  # in the middle of a delivery, too
        self._received = self._received.copy()
        self.bus_off = True
        self.send_drops += len(self._to_send)
        self._to_send.clear()


def _ignore(frame: Frame, t_us: int) -> None:
    """What a controller does with a frame that has no wire."""
