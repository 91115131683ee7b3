"""The medium: one CAN or CAN FD bus in lockstep, with arbitration, exact frame times and ISO 11898-1's error states.

Conventions. Time on the wire is counted in ns, so rounding never accumulates; what endpoints see happens at the first
whole microsecond at or after it. A frame is delivered to all others and confirmed to its sender at the end of its
EOF; its interframe space then still keeps the wire. Frames compete if they are queued no later than the microsecond
in which the start of frame lies.
"""

import random
from collections import deque
from collections.abc import Callable
from enum import IntEnum
from functools import partial
from heapq import heapify, heappop, heappush
from typing import NamedTuple
from weakref import WeakValueDictionary

from hil.clock import Lockstep
from hil.frame_time import (
    BIT_RATE_SWITCH,
    ERROR_PASSIVE,
    INTERFRAME_BITS,
    IS_EXTENDED,
    IS_FD,
    IS_REMOTE,
    FrameFormatError,
    duration_ns_kernel,
    frame_bit_counts,
)
from pkxyz_ctrl.can.frame import Frame

ERROR_DELIMITER_BITS = 8  # the error flags themselves, 6 + 1 bits, lie where the frame's EOF would have been
SUSPEND_BITS = 8  # an error-passive sender waits so long after its own frame
RECOVERY_RUNS = 128  # of 11 recessive bits each
RECESSIVE_RUN_BITS = 11  # also what ends every frame and error frame: delimiter or ACK delimiter and EOF, and 3 bits

# classes of an error frame, as in linux/can/error.h
ERROR_ACK, ERROR_PROTOCOL, ERROR_BUS_OFF, ERROR_BUS, ERROR_RESTARTED = 0x020, 0x008, 0x040, 0x080, 0x100

_channels: "WeakValueDictionary[str, Wire]" = WeakValueDictionary()


class ErrorState(IntEnum):
    ACTIVE = 0
    PASSIVE = 1  # a counter at 128 or more
    BUS_OFF = 2  # transmit counter at 256 or more


class Outcome(NamedTuple):
    """What a fault makes of a frame: an error frame, or deliveries as (delay_us, frame) in the receivers."""

    corrupt: bool = False
    deliveries: tuple[tuple[int, Frame], ...] = ()


CORRUPTED = Outcome(corrupt=True)
DROPPED = Outcome()

FaultTap = Callable[[Frame, str, int], Outcome | None]
"""Called with frame, sender's name and t_us as each frame ends; None leaves it alone."""

_Entry = tuple[int, int, Frame, int]  # arbitration key, order of queueing, frame, duration_ns


class Endpoint:
    """One CAN controller on a wire, made by ``Wire.attach``."""

    __slots__ = (
        "_earliest_ns",
        "_received",
        "_recovery_runs",
        "_to_send",
        "_wire",
        "auto_recover",
        "bus_off",
        "error_frames",
        "listen_only",
        "name",
        "on_frame",
        "on_sent",
        "overruns",
        "queue_limit",
        "receive_errors",
        "send_drops",
        "transmit_errors",
    )

    def __init__(
        self,
        wire: "Wire",
        name: str,
        on_frame: Callable[[Frame, int], object] | None,
        queue_limit: int,
        on_sent: Callable[[Frame, int], object] | None,
        listen_only: bool,
        error_frames: bool,
        auto_recover: bool,
    ) -> None:
        self._wire: Wire | None = wire
        self.name = name
        self.on_frame = on_frame
        self.on_sent = on_sent
        self.queue_limit = queue_limit
        self.listen_only = listen_only
        self.error_frames = error_frames
        self.auto_recover = auto_recover
        self.transmit_errors = 0  # TEC of ISO 11898-1
        self.receive_errors = 0  # REC
        self.bus_off = False
        self.overruns = 0  # frames lost because the receive queue was full
        self.send_drops = 0  # frames refused or discarded unsent
        self._to_send: list[_Entry] = []
        self._received: deque[tuple[Frame, int]] = deque()
        self._earliest_ns = 0
        self._recovery_runs = 0

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
        if wire is None or self.listen_only:
            raise RuntimeError(f"endpoint {self.name!r} is {'listen-only' if wire else 'detached'}")
        can_id, data, is_fd, bitrate_switch, is_remote, is_extended, is_error = frame
        flags = (IS_FD if is_fd else 0) | (BIT_RATE_SWITCH if bitrate_switch else 0)
        key = can_id << 21
        if is_remote or is_extended or is_error:
            flags |= (IS_REMOTE if is_remote else 0) | (IS_EXTENDED if is_extended else 0)
            key = _arbitration_key(frame)
        if self.transmit_errors >= 128 or self.receive_errors >= 128:
            flags |= ERROR_PASSIVE
        duration_ns = duration_ns_kernel(can_id, data, flags, wire.nominal_bitrate, wire._fast_bitrate)
        if duration_ns < 0 or (is_fd and wire.data_bitrate is None):
            wire._refuse(frame)
        to_send = self._to_send
        if self.bus_off or len(to_send) >= self.queue_limit:
            self.send_drops += 1
            return False
        wire._order = order = wire._order + 1
        heappush(to_send, (key, order, frame, duration_ns))
        if not wire._delivering and (wire._end_us < 0 or wire.clock.now_us * 1000 <= wire._start_ns):
            wire._arbitrate()
        return True

    def receive_nowait(self) -> tuple[Frame, int] | None:
        """The oldest received frame and its time in us, None if there is none. For endpoints without ``on_frame``."""
        return self._received.popleft() if self._received else None

    def pending(self) -> int:
        """Number of frames queued and not yet sent, the one on the wire included."""
        return len(self._to_send)

    def flush(self) -> None:
        """Discard all queued frames but the one on the wire."""
        wire = self._wire
        kept = [e for e in self._to_send if wire is not None and e is wire._entry and wire._has_started()]
        self.send_drops += len(self._to_send) - len(kept)
        self._to_send[:] = kept
        if wire is not None and not kept and wire._sender is self:
            wire._arbitrate()

    def recover(self) -> None:
        """Leave bus-off after 128 runs of 11 recessive bits. For endpoints without ``auto_recover``."""
        if self.bus_off and self._wire is not None:
            self._wire._begin_recovery(self)

    def detach(self) -> None:
        """Unplug. A frame on its way is cut off; received frames stay readable."""
        if self._wire is not None:
            self._wire._detach(self)


class WireStatistics(NamedTuple):
    """Totals since the wire was made. ``busy_ns`` counts frames, error frames and their interframe spaces."""

    t_us: int
    busy_ns: int
    frames: int
    error_frames: int


class Wire:
    """A bus with the given bit rates in bit/s; ``data_bitrate`` None makes it a classic one.

    ``seed`` feeds the only randomness, ``bit_error_rate``: the probability that a bit of a frame is disturbed.
    """

    def __init__(
        self, clock: Lockstep, nominal_bitrate: int = 1_000_000, data_bitrate: int | None = None, seed: int = 0
    ) -> None:
        if nominal_bitrate <= 0 or (data_bitrate is not None and data_bitrate < nominal_bitrate):
            raise ValueError(f"bit rates {nominal_bitrate}, {data_bitrate}: need 0 < nominal <= data")
        self.clock = clock
        self.nominal_bitrate = nominal_bitrate
        self.data_bitrate = data_bitrate
        self.fault_tap: FaultTap | None = None
        self.bit_error_rate = 0.0
        self._fast_bitrate = data_bitrate or nominal_bitrate
        self._random = random.Random(seed)
        self._interframe_ns = self._bits_ns(INTERFRAME_BITS)
        self._endpoints: tuple[Endpoint, ...] = ()
        self._nodes = 0  # endpoints that acknowledge
        self._doomed: list[tuple[Callable[[Frame], bool], int]] = []  # predicate, how many more
        self._order = 0
        self._frames = 0
        self._error_frames = 0
        self._busy_ns = 0
        # the transmission under way or, until its start is past, the one that would win the arbitration
        self._sender: Endpoint | None = None
        self._entry: _Entry | None = None
        self._rivals: list[Endpoint] = []  # others that sent the same identifier at the same time
        self._start_ns = 0
        self._end_ns = 0  # end of EOF
        self._end_us = -1  # -1: idle
        self._free_ns = 0  # end of the latest interframe space
        self._delivering = False
        self._recovering: list[Endpoint] = []
        self._runs = 0  # of 11 recessive bits, counted while an endpoint recovers

    # -- endpoints ---------------------------------------------------------------------------------------------------

    def attach(
        self,
        name: str,
        on_frame: Callable[[Frame, int], object] | None = None,
        queue_limit: int = 1024,
        *,
        on_sent: Callable[[Frame, int], object] | None = None,
        listen_only: bool = False,
        error_frames: bool = False,
        auto_recover: bool = True,
    ) -> Endpoint:
        """Plug in a CAN controller.

        ``on_frame(frame, t_us)`` gets each frame of the others as it ends, ``on_sent`` each own one; without
        ``on_frame`` up to ``queue_limit`` frames wait for ``receive_nowait`` (the newest is lost on overrun).
        ``listen_only`` neither acknowledges nor sends; with ``error_frames`` error frames are delivered too.
        """
        if any(other.name == name for other in self._endpoints):
            raise ValueError(f"an endpoint named {name!r} is attached already")
        endpoint = Endpoint(self, name, on_frame, queue_limit, on_sent, listen_only, error_frames, auto_recover)
        self._endpoints = (*self._endpoints, endpoint)
        self._nodes += not listen_only
        return endpoint

    def _detach(self, endpoint: Endpoint) -> None:
        self._endpoints = tuple(e for e in self._endpoints if e is not endpoint)
        self._nodes -= not (endpoint.listen_only or endpoint.bus_off)
        if endpoint in self._recovering:
            self._recovering.remove(endpoint)
        endpoint._wire = None
        endpoint.on_frame = endpoint.on_sent = None
        endpoint.send_drops += len(endpoint._to_send)
        endpoint._to_send.clear()
        if self._end_us >= 0 and not self._has_started():
            self._arbitrate()

    def publish(self, channel: str) -> None:
        """Let ``can.Bus(interface="pkxyz-sim", channel=channel)`` find this wire for as long as it lives."""
        if _channels.get(channel, self) is not self:
            raise ValueError(f"channel {channel!r} is another wire's")
        _channels[channel] = self

    # -- statistics --------------------------------------------------------------------------------------------------

    def statistics(self) -> WireStatistics:
        now_ns = self.clock.now_us * 1000
        busy_ns = self._busy_ns - max(0, self._free_ns - now_ns)
        if self._end_us >= 0:
            busy_ns += max(0, now_ns - self._start_ns)
        return WireStatistics(self.clock.now_us, busy_ns, self._frames, self._error_frames)

    def bus_load(self, since: WireStatistics = WireStatistics(0, 0, 0, 0)) -> float:
        """Fraction of the time since ``since`` in which the wire was taken, 0..1."""
        now = self.statistics()
        return (now.busy_ns - since.busy_ns) / max(1, (now.t_us - since.t_us) * 1000)

    # -- transmission ------------------------------------------------------------------------------------------------

    def _arbitrate(self) -> None:
        """Choose the frame that starts next. May be called again until that frame's start is past."""
        ready_ns = self.clock.now_us * 1000
        if ready_ns < self._free_ns:
            ready_ns = self._free_ns
        sender, entry, tie = self._lowest(ready_ns)
        if entry is None:  # nothing to send, or only by endpoints that must wait first
            ready_ns = min((e._earliest_ns for e in self._endpoints if e._to_send), default=ready_ns)
            sender, entry, tie = self._lowest(ready_ns)
        if tie and entry is not None:
            sender, entry, self._rivals = self._most_dominant(entry[0], ready_ns)
        elif self._rivals:
            self._rivals = []
        if entry is None:
            self._sender, self._entry, self._end_us = None, None, -1
            return
        if entry is self._entry and ready_ns == self._start_ns and self._end_us >= 0:
            return
        self._sender, self._entry = sender, entry
        self._start_ns = ready_ns
        self._end_ns = end_ns = ready_ns + entry[3] - self._interframe_ns
        self._end_us = end_us = -(-end_ns // 1000)
        self.clock.call_at(end_us, self._complete)

    def _lowest(self, ready_ns: int) -> tuple[Endpoint | None, _Entry | None, bool]:
        """The endpoint and its entry that win an arbitration at ``ready_ns``; True if another sends the same key."""
        sender, entry, tie = None, None, False
        for endpoint in self._endpoints:
            if endpoint._to_send and endpoint._earliest_ns <= ready_ns:
                head = endpoint._to_send[0]
                if entry is None or head[0] < entry[0]:
                    sender, entry, tie = endpoint, head, False
                elif head[0] == entry[0]:
                    tie = True
        return sender, entry, tie

    def _most_dominant(self, key: int, ready_ns: int) -> tuple[Endpoint, _Entry, list[Endpoint]]:
        """Of several that send the same identifier at once: the one whose bits prevail, and the others."""
        tied = [e for e in self._endpoints if e._to_send and e._to_send[0][0] == key and e._earliest_ns <= ready_ns]
        tied.sort(key=lambda e: _dominance(e._to_send[0][2]))
        return tied[0], tied[0]._to_send[0], tied[1:]

    def _complete(self) -> None:
        """The frame on the wire has reached the end of its EOF."""
        t_us = self.clock.now_us
        sender, entry = self._sender, self._entry
        if t_us != self._end_us or sender is None or entry is None:
            return  # the event of a frame that lost the arbitration later on
        previous_free_ns = self._free_ns
        self._end_us = -1
        self._sender = self._entry = None
        self._free_ns = free_ns = self._end_ns + self._interframe_ns
        self._busy_ns += free_ns - self._start_ns
        if self._recovering:
            self._runs += 1 + (self._start_ns - previous_free_ns) // self._bits_ns(RECESSIVE_RUN_BITS)
        self._delivering = True
        try:
            if self._nodes < 2 or self._rivals or self.fault_tap is not None or self._doomed or self.bit_error_rate:
                self._complete_under_faults(sender, entry, t_us)
            elif sender._wire is not None:
                self._confirm(sender, entry, t_us)
                self._deliver(entry[2], t_us, sender)
        finally:
            self._delivering = False
            for endpoint in self._endpoints:
                if endpoint._to_send:
                    self._arbitrate()
                    break

    def _confirm(self, sender: Endpoint, entry: _Entry, t_us: int) -> None:
        to_send = sender._to_send
        if to_send[0] is entry:
            heappop(to_send)
        else:
            to_send.remove(entry)
            heapify(to_send)
        self._frames += 1
        if sender.transmit_errors or sender.receive_errors:
            if sender._is_passive():
                sender._earliest_ns = self._free_ns + self._bits_ns(SUSPEND_BITS)
            sender.transmit_errors = max(0, sender.transmit_errors - 1)
        if sender.on_sent is not None:
            sender.on_sent(entry[2], t_us)

    def _deliver(self, frame: Frame, t_us: int, *senders: Endpoint) -> None:
        for endpoint in self._endpoints:
            if endpoint in senders or endpoint.bus_off:
                continue
            if endpoint.receive_errors:
                # a passive receiver returns to 119..127 (ISO 11898-1, 12.1.4.2 h): the upper end
                endpoint.receive_errors = min(endpoint.receive_errors, 128) - 1
            if endpoint.on_frame is not None:
                endpoint.on_frame(frame, t_us)
            elif len(endpoint._received) < endpoint.queue_limit:
                endpoint._received.append((frame, t_us))
            else:
                endpoint.overruns += 1

    # -- faults ------------------------------------------------------------------------------------------------------

    def corrupt_next(self, predicate: Callable[[Frame], bool] = lambda frame: True, count: int = 1) -> None:
        """Destroy the next ``count`` frames for which ``predicate`` holds, retransmissions included."""
        self._doomed.append((predicate, count))

    def _complete_under_faults(self, sender: Endpoint, entry: _Entry, t_us: int) -> None:
        rivals, self._rivals = self._rivals, []
        frame = entry[2]
        twins = [e for e in rivals if e._to_send[0][2] == frame]  # bit for bit the same: nobody notices
        losers = [e for e in rivals if e not in twins]
        if sender._wire is None:
            self._count_error([], ERROR_PROTOCOL)
            return
        if any(not e._is_passive() for e in losers):
            self._count_error([sender, *rivals], ERROR_PROTOCOL)
            return
        if self._nodes < 2:
            self._count_error([sender], ERROR_ACK)
            return
        outcome = self._outcome(frame, sender.name, t_us)
        if outcome is not None and outcome.corrupt:
            self._count_error([sender, *rivals], ERROR_PROTOCOL)
            return
        for loser in losers:  # their passive error flags disturb nobody
            self._count_transmit_error(loser, ERROR_PROTOCOL)
        for twin in (sender, *twins):
            self._confirm(twin, twin._to_send[0] if twin is not sender else entry, t_us)
        for delay_us, delivered in ((0, frame),) if outcome is None else outcome.deliveries:
            if delay_us <= 0:
                self._deliver(delivered, t_us, sender, *twins)
            else:
                self.clock.call_at(t_us + delay_us, partial(self._deliver_late, delivered, sender, *twins))

    def _deliver_late(self, frame: Frame, *senders: Endpoint) -> None:
        self._deliver(frame, self.clock.now_us, *senders)

    def _outcome(self, frame: Frame, sender: str, t_us: int) -> Outcome | None:
        for i, (predicate, count) in enumerate(self._doomed):
            if predicate(frame):
                self._doomed[i : i + 1] = [(predicate, count - 1)] if count > 1 else []
                return CORRUPTED
        if self.bit_error_rate:
            bits = sum(frame_bit_counts(frame))
            if self._random.random() < 1.0 - (1.0 - self.bit_error_rate) ** bits:
                return CORRUPTED
        return None if self.fault_tap is None else self.fault_tap(frame, sender, t_us)

    # -- fault confinement (ISO 11898-1, 12.1.4) ---------------------------------------------------------------------

    def _count_error(self, senders: list[Endpoint], kind: int) -> None:
        """Destroy the frame that just ended: error frame, counters, and its retransmission when the wire is free."""
        delimiter_ns = self._bits_ns(ERROR_DELIMITER_BITS)
        self._free_ns += delimiter_ns
        self._busy_ns += delimiter_ns
        self._error_frames += 1
        for endpoint in senders:
            self._count_transmit_error(endpoint, kind)
        for endpoint in self._endpoints:
            if endpoint not in senders and not endpoint.listen_only and not endpoint.bus_off:
                endpoint.receive_errors = min(endpoint.receive_errors + 1, 128)
        worst = senders[0] if senders else None
        self._announce(kind | ERROR_BUS, worst)

    def _count_transmit_error(self, endpoint: Endpoint, kind: int) -> None:
        if endpoint._is_passive():
            endpoint._earliest_ns = self._free_ns + self._bits_ns(SUSPEND_BITS)
            if kind == ERROR_ACK:
                return  # a node alone on its bus does not go bus-off
        endpoint.transmit_errors += 8
        if endpoint.transmit_errors < 256:
            return
        endpoint.bus_off = True
        endpoint.send_drops += len(endpoint._to_send)
        endpoint._to_send.clear()  # what has waited so long would come as a surprise
        self._nodes -= 1
        self._announce(ERROR_BUS_OFF, endpoint)
        if endpoint.auto_recover:
            self._begin_recovery(endpoint)

    def _begin_recovery(self, endpoint: Endpoint) -> None:
        if endpoint in self._recovering:
            return
        self._recovering.append(endpoint)
        endpoint._recovery_runs = self._recessive_runs() + RECOVERY_RUNS
        self._await_recovery(endpoint)

    def _recessive_runs(self) -> int:
        """Runs of 11 recessive bits so far: one ends every frame, the others are the idle time."""
        idle_until_ns = self.clock.now_us * 1000
        if self._end_us >= 0:
            idle_until_ns = min(idle_until_ns, self._start_ns)
        return self._runs + max(0, idle_until_ns - self._free_ns) // self._bits_ns(RECESSIVE_RUN_BITS)

    def _await_recovery(self, endpoint: Endpoint) -> None:
        if endpoint not in self._recovering:
            return
        missing = endpoint._recovery_runs - self._recessive_runs()
        if missing > 0:  # as early as it can be: while the wire is busy the runs come more slowly
            idle_from_ns = max(self.clock.now_us * 1000, self._free_ns)
            ready_ns = idle_from_ns + missing * self._bits_ns(RECESSIVE_RUN_BITS)
            self.clock.call_at(-(-ready_ns // 1000), partial(self._await_recovery, endpoint))
            return
        self._recovering.remove(endpoint)
        endpoint.bus_off = False
        endpoint.transmit_errors = endpoint.receive_errors = 0
        self._nodes += 1
        self._announce(ERROR_RESTARTED, endpoint)

    def _announce(self, kind: int, endpoint: Endpoint | None) -> None:
        """Tell those who asked for error frames, with the counters of the endpoint concerned as in linux/can/error.h."""
        counters = (min(endpoint.transmit_errors, 255), endpoint.receive_errors) if endpoint is not None else (0, 0)
        frame = Frame(kind, bytes((0, 0, 0, 0, 0, 0, *counters)), is_error=True)
        for listener in self._endpoints:
            if listener.error_frames:
                if listener.on_frame is not None:
                    listener.on_frame(frame, self.clock.now_us)
                elif len(listener._received) < listener.queue_limit:
                    listener._received.append((frame, self.clock.now_us))

    # -- small change ------------------------------------------------------------------------------------------------

    def _bits_ns(self, n_bits: int) -> int:
        return (n_bits * 1_000_000_000 + self.nominal_bitrate // 2) // self.nominal_bitrate

    def _has_started(self) -> bool:
        return self._end_us >= 0 and self.clock.now_us * 1000 > self._start_ns

    def _refuse(self, frame: Frame) -> None:
        frame_bit_counts(frame)  # says what is wrong
        raise FrameFormatError("a CAN FD frame on a classic wire (no data bit rate)")


def find_wire(channel: str) -> Wire | None:
    """The living wire published as ``channel``."""
    return _channels.get(channel)


def _arbitration_key(frame: Frame) -> int:
    """The bits that arbitrate, as one number: the smaller wins. Base identifier, RTR or SRR, IDE, extension, RTR."""
    if not frame.is_extended:
        return frame.can_id << 21 | frame.is_remote << 20
    return (frame.can_id >> 18) << 21 | 3 << 19 | (frame.can_id & 0x3FFFF) << 1 | frame.is_remote


def _dominance(frame: Frame) -> tuple[bool, int, bytes]:
    """Order of frames with equal arbitration bits: the first dominant bit where they differ prevails (FDF, DLC, data)."""
    return frame.is_fd, len(frame.data), frame.data
