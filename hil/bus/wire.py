"""The medium: one CAN or CAN FD bus in lockstep, with arbitration, exact frame times and ISO 11898-1's error states.

Conventions. Time on the wire is counted in ns, so rounding never accumulates; what endpoints see happens at the first
whole microsecond at or after it. A frame is delivered to all others and confirmed to its sender at the end of its
EOF; its interframe space then still keeps the wire. Frames compete if they are queued no later than the microsecond
in which the start of frame lies.
"""

from collections.abc import Callable
from functools import partial
from heapq import heapify, heappop
from typing import NamedTuple

from hil.bus.clock import Lockstep
from hil.bus.disturbance import Disturbance
from hil.bus.endpoint import Endpoint, Entry, Listener, dominance
from hil.bus.frame_time import INTERFRAME_BITS, duration_ns_kernel
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.compiled.direct_call import direct

ERROR_DELIMITER_BITS = 8  # the error flags themselves, 6 + 1 bits, lie where the frame's EOF would have been
SUSPEND_BITS = 8  # an error-passive sender waits so long after its own frame
RECOVERY_RUNS = 128  # of 11 recessive bits each
RECESSIVE_RUN_BITS = 11  # also what ends every frame and error frame: delimiter or ACK delimiter and EOF, and 3 bits

# classes of an error frame, as in linux/can/error.h
ERROR_ACK, ERROR_PROTOCOL, ERROR_BUS_OFF, ERROR_BUS, ERROR_RESTARTED = 0x020, 0x008, 0x040, 0x080, 0x100

_duration_ns = direct(duration_ns_kernel, 0, 0, 0, b"", 0)


class WireStatistics(NamedTuple):
    """Totals since the wire was made. ``busy_ns`` counts frames, error frames and their interframe spaces."""

    t_us: int
    busy_ns: int
    frames: int
    error_frames: int


class Wire:
    """A bus with the given bit rates in bit/s; ``data_bitrate`` None makes it a classic one.

    ``seed`` feeds the only randomness, the bit errors that ``disturbance`` can be told to make.
    """

    def __init__(
        self, clock: Lockstep, nominal_bitrate: int = 1_000_000, data_bitrate: int | None = None, seed: int = 0
    ) -> None:
        if nominal_bitrate <= 0 or (data_bitrate is not None and data_bitrate < nominal_bitrate):
            raise ValueError(f"bit rates {nominal_bitrate}, {data_bitrate}: need 0 < nominal <= data")
        self.clock = clock
        self.nominal_bitrate = nominal_bitrate
        self.data_bitrate = data_bitrate
        self.disturbance = Disturbance(seed, self._look_closely)
        self._bitrates = nominal_bitrate, data_bitrate or nominal_bitrate
        self._duration_ns = partial(_duration_ns, *self._bitrates)
        self._to_end_ns = 999 - self._bits_ns(INTERFRAME_BITS)  # to where the EOF ends, rounded up to a microsecond
        self._endpoints: tuple[Endpoint, ...] = ()
        self._nodes = 0  # endpoints that acknowledge
        self._order = 0
        self._frames = 0
        self._error_frames = 0
        self._busy_ns = 0
        self._first = WireStatistics(clock.now_us, 0, 0, 0)
        # the transmission under way or, until its start is past, the one that would win the arbitration
        self._sender: Endpoint
        self._entry: Entry
        self._rivals: list[tuple[Endpoint, Entry]] = []  # others that send the same identifier at the same time
        self._start_ns = 0
        self._end_us = -1  # end of EOF; -1: idle, and what follows from the last frame is done
        self._free_ns = 0  # end of the latest interframe space
        self._recovering: list[Endpoint] = []
        self._is_ordinary = False  # at least two nodes, and no error counted anywhere: a frame takes the short way
        self._has_queue = False  # somebody may have a frame to send besides the one on its way
        self._is_calm = False  # ordinary, idle and nothing queued: a frame that is sent has no rival
        self._runs = 0  # of 11 recessive bits, counted while an endpoint recovers
        self._call_at, self._completion = clock.call_at, self._complete

    # -- endpoints ---------------------------------------------------------------------------------------------------

    def attach(
        self,
        name: str,
        on_frame: Listener | None = None,
        queue_limit: int = 1024,
        *,
        on_full: Callable[[], object] | None = None,
        on_sent: Listener | None = None,
        listen_only: bool = False,
        error_frames: bool = False,
        auto_recover: bool = True,
    ) -> Endpoint:
        """Plug in a CAN controller.

        ``on_frame(frame, t_us)`` gets each frame of the others as it ends, ``on_sent`` each own one; without
        ``on_frame`` up to ``queue_limit`` frames wait for ``receive_nowait``. When there is no room for another,
        ``on_full`` is called to make some; else that one is lost.
        ``listen_only`` neither acknowledges nor sends; with ``error_frames`` error frames are delivered too.
        """
        if any(other.name == name for other in self._endpoints):
            raise ValueError(f"an endpoint named {name!r} is attached already")
        endpoint = Endpoint(
            self, name, on_frame, queue_limit, on_full, on_sent, listen_only, error_frames, auto_recover
        )
        self._nodes += not listen_only
        self._endpoints = (*self._endpoints, endpoint)
        self._introduce()
        return endpoint

    def _introduce(self) -> None:
        """Tell every endpoint who is to get its frames."""
        for endpoint in self._endpoints:
            others = [e for e in self._endpoints if e is not endpoint]
            endpoint._listeners = tuple(e for e in others if e.on_frame is not None)
            endpoint._queues = tuple((e._received, e.queue_limit, e) for e in others if e.on_frame is None)

    def _detach(self, endpoint: Endpoint) -> None:
        self._is_ordinary = self._is_calm = False
        self._nodes -= not (endpoint.listen_only or endpoint.bus_off)
        if endpoint in self._recovering:
            self._recovering.remove(endpoint)
        self._endpoints = tuple(e for e in self._endpoints if e is not endpoint)
        self._introduce()
        endpoint._unplug()
        if self._end_us >= 0 and not self._has_started():
            self._arbitrate()

    # -- statistics --------------------------------------------------------------------------------------------------

    def statistics(self) -> WireStatistics:
        now_ns = self.clock.now_us * 1000
        busy_ns = self._busy_ns - max(0, self._free_ns - now_ns)
        if self._end_us > self.clock.now_us:
            busy_ns += max(0, now_ns - self._start_ns)
        return WireStatistics(self.clock.now_us, busy_ns, self._frames, self._error_frames)

    def bus_load(self, since: WireStatistics | None = None) -> float:
        """Fraction of the time since ``since`` (None: since the wire was made) in which the wire was taken, 0..1."""
        now, then = self.statistics(), since or self._first
        return (now.busy_ns - then.busy_ns) / max(1, (now.t_us - then.t_us) * 1000)

    # -- transmission ------------------------------------------------------------------------------------------------

    def _arbitrate(self) -> None:
        """Choose the frame that starts next. May be called again until that frame's start is past."""
        ready_ns = self.clock.now_us * 1000
        if ready_ns < self._free_ns:
            ready_ns = self._free_ns
        sender, entry, tie, suspended = None, None, False, 0
        for endpoint in self._endpoints:
            if endpoint._to_send:
                head = endpoint._to_send[0]
                if endpoint._earliest_ns > ready_ns:
                    suspended += 1
                elif entry is None or head[0] < entry[0]:
                    sender, entry, tie = endpoint, head, False
                elif head[0] == entry[0]:
                    tie = True
        if tie or (suspended and entry is None) or self._rivals:
            ready_ns, sender, entry = self._arbitrate_slowly(ready_ns)
        if sender is None or entry is None:
            self._end_us = -1
        elif self._end_us < 0 or entry is not self._entry or ready_ns != self._start_ns:
            self._begin(sender, entry, ready_ns)

    def _begin(self, sender: Endpoint, entry: Entry, start_ns: int) -> None:
        """Put ``entry`` on the wire at ``start_ns`` unless a better one is queued until then."""
        self._is_calm = False
        self._sender, self._entry, self._start_ns = sender, entry, start_ns
        self._end_us = end_us = (start_ns + entry[3] + self._to_end_ns) // 1000
        self._call_at(end_us, self._completion)

    def _arbitrate_slowly(self, ready_ns: int) -> tuple[int, Endpoint | None, Entry | None]:
        """The cases that are rare: senders that must wait after their own frame, and equal identifiers."""
        ready = [e for e in self._endpoints if e._to_send]
        ready_ns = max(ready_ns, min((e._earliest_ns for e in ready), default=ready_ns))
        ready = [e for e in ready if e._earliest_ns <= ready_ns]
        ready.sort(key=lambda e: (e._to_send[0][0], dominance(e._to_send[0][2])))
        self._rivals = [(e, e._to_send[0]) for e in ready[1:] if e._to_send[0][0] == ready[0]._to_send[0][0]]
        self._is_ordinary = self._is_ordinary and not self._rivals
        return (ready_ns, ready[0], ready[0]._to_send[0]) if ready else (ready_ns, None, None)

    def _complete(self) -> None:
        """The frame on the wire has reached the end of its EOF."""
        t_us = self.clock.now_us
        if t_us != self._end_us:
            return  # the event of a frame that lost the arbitration later on
        if not self._is_ordinary:
            self._complete_out_of_the_ordinary(t_us)
            return
        # _confirm and _deliver in one go, for speed: it happens three times a tick
        sender = self._sender
        _, _, frame, duration_ns = entry = self._entry
        self._free_ns = self._start_ns + duration_ns
        self._busy_ns += duration_ns
        self._frames += 1
        if self._has_queue:
            self._unqueue(sender, entry)
        else:
            sender._to_send.clear()
        try:
            if sender.on_sent is not None:
                sender.on_sent(frame, t_us)
            for endpoint in sender._listeners:
                endpoint._take(frame, t_us)
            received = frame, t_us
            for queue, limit, endpoint in sender._queues:
                if len(queue) < limit:
                    queue.append(received)
                else:
                    endpoint._overrun(frame, t_us)
        finally:
            self._end_us = -1
            if self._has_queue:
                self._go_on()
            else:
                self._is_calm = self._is_ordinary

    def _go_on(self) -> None:
        """The wire is free: whoever has something to send may."""
        if any(e._to_send for e in self._endpoints):
            self._arbitrate()
        else:
            self._has_queue = False
            self._is_calm = self._is_ordinary

    def _look_closely(self) -> None:
        """The next frame takes the long way, and whether the one behind it has to is seen there."""
        self._is_ordinary = False

    def _complete_out_of_the_ordinary(self, t_us: int) -> None:
        sender, entry = self._sender, self._entry
        if self._recovering:
            self._runs += 1 + (self._start_ns - self._free_ns) // self._bits_ns(RECESSIVE_RUN_BITS)
        self._free_ns = self._start_ns + entry[3]
        self._busy_ns += entry[3]
        self._has_queue = True  # what was destroyed is sent again
        try:
            self._judge(sender, entry, t_us)
        finally:
            self._end_us = -1
            self._go_on()

    def _judge(self, sender: Endpoint, entry: Entry, t_us: int) -> None:
        if self.disturbance.armed or self._nodes < 2 or self._rivals or sender._wire is None:
            self._complete_under_faults(sender, entry, t_us)
        else:
            self._confirm(sender, entry, t_us)
            self._deliver(entry[2], t_us, sender)
        self._is_ordinary = (
            self._nodes >= 2
            and not self.disturbance.armed
            and not any(
                e.transmit_errors or e.receive_errors or e.bus_off or e._earliest_ns > self._free_ns
                for e in self._endpoints
            )
        )

    @staticmethod
    def _unqueue(sender: Endpoint, entry: Entry) -> None:
        to_send = sender._to_send
        if to_send[0] is entry:
            heappop(to_send)
        else:
            to_send.remove(entry)
            heapify(to_send)

    def _confirm(self, sender: Endpoint, entry: Entry, t_us: int) -> None:
        self._unqueue(sender, entry)
        self._frames += 1
        if sender.transmit_errors or sender.receive_errors:
            sender.transmit_errors = max(0, sender.transmit_errors - 1)
            if sender._is_passive():
                sender._earliest_ns = self._free_ns + self._bits_ns(SUSPEND_BITS)
        if sender.on_sent is not None:
            sender.on_sent(entry[2], t_us)

    def _deliver(self, frame: Frame, t_us: int, *senders: Endpoint) -> None:
        for endpoint in self._endpoints:
            if endpoint in senders or endpoint.bus_off:
                continue
            if endpoint.receive_errors:
                # a passive receiver returns to 119..127 (ISO 11898-1, 12.1.4.2 h): the upper end
                endpoint.receive_errors = min(endpoint.receive_errors, 128) - 1
            endpoint._take(frame, t_us)

    # -- faults ------------------------------------------------------------------------------------------------------

    def _complete_under_faults(self, sender: Endpoint, entry: Entry, t_us: int) -> None:
        frame = entry[2]
        rivals = [(e, its) for e, its in self._rivals if e._wire is not None]
        self._rivals = []
        involved = [sender, *(e for e, _ in rivals)]
        twins = [(sender, entry), *((e, its) for e, its in rivals if its[2] == frame)]  # the same bits: nobody notices
        losers = [e for e, its in rivals if its[2] != frame]
        if sender._wire is None:  # unplugged in the middle
            return self._count_error([], ERROR_PROTOCOL)
        if any(not e._is_passive() for e in losers):
            return self._count_error(involved, ERROR_PROTOCOL)
        if self._nodes < 2:
            return self._count_error([sender], ERROR_ACK)
        outcome = self.disturbance.judge(frame, sender.name, t_us) if self.disturbance.armed else None
        if outcome is not None and outcome.corrupt:
            return self._count_error(involved, ERROR_PROTOCOL)
        for loser in losers:  # their passive error flags disturb nobody
            self._count_transmit_error(loser, ERROR_PROTOCOL)
        for twin, its in twins:
            self._confirm(twin, its, t_us)
        senders = [e for e, _ in twins]
        for delay_us, delivered in ((0, frame),) if outcome is None else outcome.deliveries:
            if delay_us <= 0:
                self._deliver(delivered, t_us, *senders)
            else:
                self.clock.call_at(t_us + delay_us, partial(self._deliver_late, delivered, *senders))

    def _deliver_late(self, frame: Frame, *senders: Endpoint) -> None:
        self._deliver(frame, self.clock.now_us, *senders)

    # -- fault confinement (ISO 11898-1, 12.1.4) ---------------------------------------------------------------------

    def _count_error(self, senders: list[Endpoint], kind: int) -> None:
        """Destroy the frame that just ended: error frame, counters, and its retransmission when the wire is free."""
        self._is_ordinary = False
        delimiter_ns = self._bits_ns(ERROR_DELIMITER_BITS)
        self._free_ns += delimiter_ns
        self._busy_ns += delimiter_ns
        self._error_frames += 1
        for endpoint in senders:
            self._count_transmit_error(endpoint, kind)
        for endpoint in self._endpoints:
            if endpoint not in senders and not endpoint.listen_only and not endpoint.bus_off:
                endpoint.receive_errors = min(endpoint.receive_errors + 1, 128)
        self._announce(kind | ERROR_BUS, senders[0] if senders else None)

    def _count_transmit_error(self, endpoint: Endpoint, kind: int) -> None:
        self._is_ordinary = False
        if kind != ERROR_ACK or not endpoint._is_passive():  # a node alone on its bus does not go bus-off
            endpoint.transmit_errors += 8
        if endpoint._is_passive():
            endpoint._earliest_ns = self._free_ns + self._bits_ns(SUSPEND_BITS)
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
        """Tell those who asked for error frames; bytes 6 and 7 are the endpoint's counters, as in linux/can/error.h."""
        counters = (min(endpoint.transmit_errors, 255), endpoint.receive_errors) if endpoint is not None else (0, 0)
        frame = Frame(kind, bytes((0, 0, 0, 0, 0, 0, *counters)), is_error=True)
        for listener in self._endpoints:
            if listener.error_frames:
                listener._take(frame, self.clock.now_us)

    # -- small change ------------------------------------------------------------------------------------------------

    def _bits_ns(self, n_bits: int) -> int:
        return (n_bits * 1_000_000_000 + self.nominal_bitrate // 2) // self.nominal_bitrate

    def _has_started(self) -> bool:
        return self._end_us >= 0 and self.clock.now_us * 1000 > self._start_ns
