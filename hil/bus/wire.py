"""The medium: one CAN or CAN FD bus in lockstep, with arbitration, exact frame times and ISO 11898-1's error states.

Conventions. Time on the wire is counted in ns, so rounding never accumulates; what endpoints see happens at the first
whole microsecond at or after it. A frame is delivered to all others and confirmed to its sender at the end of its
EOF; its interframe space then still keeps the wire. Frames compete if they are queued no later than the microsecond
in which the start of frame lies.
"""

from collections.abc import Callable
from functools import partial
from heapq import heappush
from typing import NamedTuple

from hil.bus.arbitration import Entry, arbitration_key, dominance, unqueue
from hil.bus.clock import Lockstep
from hil.bus.disturbance import Disturbance, FaultTap
from hil.bus.endpoint import Endpoint, Kind, Listener
from hil.bus.fault_confinement import ERROR_ACK, ERROR_PROTOCOL, FaultConfinement
from hil.bus.frame_time import FrameFormatError, bits_ns, duration_ns_kernel, frame_duration_ns, to_end_ns
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.compiled.direct_call import direct

ERROR_DELIMITER_BITS = 8  # the error flags themselves, 6 + 1 bits, lie where the frame's EOF would have been
_REMEMBERED = 1024  # identifiers, and durations of each
_UNSEEN: Kind = (-1, 0, {})

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
        self._error_delimiter_ns = bits_ns(ERROR_DELIMITER_BITS, nominal_bitrate)
        self._to_end_ns = to_end_ns(nominal_bitrate)
        self._confinement = FaultConfinement(clock, nominal_bitrate, self._idle_ns)
        self.endpoints: tuple[Endpoint, ...] = ()
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
        self._is_ordinary = False  # at least two nodes, and no error counted anywhere: a frame takes the short way
        self._has_queue = False  # somebody may have a frame to send besides the one on its way
        self._is_calm = False  # ordinary, idle and nothing queued: a frame that is sent has no rival
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
        if any(other.name == name for other in self.endpoints):
            raise ValueError(f"an endpoint named {name!r} is attached already")
        endpoint = Endpoint(
            self, name, on_frame, queue_limit, on_full, on_sent, listen_only, error_frames, auto_recover
        )
        self.endpoints = (*self.endpoints, endpoint)
        self.introduce()
        return endpoint

    def introduce(self) -> None:
        """Tell every endpoint who is to get its frames."""
        self._confinement.endpoints = self.endpoints
        for endpoint in self.endpoints:
            others = [e for e in self.endpoints if e is not endpoint]
            endpoint._listeners = tuple(e for e in others if e.on_frame is not None)
            endpoint._queues = tuple((e._received, e.queue_limit, e) for e in others if e.on_frame is None)

    def detach(self, endpoint: Endpoint) -> None:
        """Unplug ``endpoint``; a frame of its that is on its way is cut off."""
        self._is_ordinary = self._is_calm = False
        self._confinement.forget(endpoint)
        self.endpoints = tuple(e for e in self.endpoints if e is not endpoint)
        self.introduce()
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

    def is_calm(self, tap: FaultTap | None = None) -> bool:
        """Whether it is idle, nothing queued, nobody error-passive, and no error ahead but what ``tap`` makes."""
        if self._end_us >= 0 or self._rivals or any(e._to_send for e in self.endpoints):
            return False
        all_of_us, free_ns = self._confinement, self._free_ns
        return self.disturbance.is_only(tap) and not all_of_us.is_alone() and all_of_us.may_everybody_send(free_ns)

    @property
    def carried(self) -> tuple[int, int, int]:
        """End of the latest interframe space and time taken in ns, and frames; for who carries some in its place."""
        return self._free_ns, self._busy_ns, self._frames

    @carried.setter
    def carried(self, carried: tuple[int, int, int]) -> None:
        self._free_ns, self._busy_ns, self._frames = carried

    # -- queues ------------------------------------------------------------------------------------------------------

    def way_in(self, sender: Endpoint) -> Callable[[Frame], bool]:
        """What ``Endpoint.send`` is: a function that holds its endpoint; another call would be felt in every tick."""
        kinds, to_send = sender._kinds, sender._to_send

        def send(frame: Frame) -> bool:
            if self._is_calm and sender._medium is self:
                # The short way, for speed: a frame of a kind that was sent before, with nothing else on its way.
                can_id, data, flags = frame
                known_flags, key, known_ns = kinds.get(can_id, _UNSEEN)
                if flags == known_flags:
                    duration_ns = (known_ns and known_ns.get(data)) or self._duration_ns(can_id, data, flags)
                    if duration_ns > 0:
                        self._is_calm = False
                        self._sender = sender
                        self._entry = entry = key, 0, frame, duration_ns
                        to_send.append(entry)
                        start_ns = self.clock.now_us * 1000
                        if start_ns < self._free_ns:
                            start_ns = self._free_ns
                        self._start_ns = start_ns
                        self._end_us = end_us = (start_ns + duration_ns + self._to_end_ns) // 1000
                        self._call_at(end_us, self._completion)
                        return True
            return self._queue(sender, frame)

        return send

    def _queue(self, sender: Endpoint, frame: Frame) -> bool:
        if sender._medium is not self or sender.listen_only:
            raise RuntimeError(f"endpoint {sender.name!r} is {'listen-only' if sender._medium else 'detached'}")
        is_passive = sender.is_passive
        duration_ns = frame_duration_ns(frame, *self._bitrates, is_passive)
        if frame.is_fd and self.data_bitrate is None:
            raise FrameFormatError("a CAN FD frame on a classic wire (no data bit rate)")
        if sender.bus_off or len(sender._to_send) >= sender.queue_limit:
            sender.send_drops += 1
            return False
        key = arbitration_key(frame)
        if not is_passive:
            self._remember(sender._kinds, frame, key, duration_ns)
        self._has_queue = True
        self._order = order = self._order + 1
        heappush(sender._to_send, (key, order, frame, duration_ns))
        if not self._has_started():
            self._arbitrate()
        return True

    @staticmethod
    def _remember(kinds: dict[int, Kind], frame: Frame, key: int, duration_ns: int) -> None:
        can_id, data, flags = frame
        if can_id not in kinds and len(kinds) >= _REMEMBERED:
            return
        kind = kinds.get(can_id, _UNSEEN)
        if kind[0] != flags:
            kind = kinds[can_id] = flags, key, {}
        if len(data) < 3 and len(kind[2]) < _REMEMBERED:  # SYNC and heartbeats recur; process data hardly ever does
            kind[2][data] = duration_ns

    def flush(self, endpoint: Endpoint) -> None:
        """Discard what ``endpoint`` has queued, but not the frame on the wire."""
        kept = [e for e in endpoint._to_send if self._has_started() and e is self._entry]
        endpoint.send_drops += len(endpoint._to_send) - len(kept)
        endpoint._to_send[:] = kept
        if self._end_us >= 0 and not self._has_started() and self._sender is endpoint:
            self._arbitrate()

    def recover(self, endpoint: Endpoint) -> None:
        """Bring ``endpoint`` back from bus-off."""
        self._confinement.begin_recovery(endpoint)

    # -- transmission ------------------------------------------------------------------------------------------------

    def _arbitrate(self) -> None:
        """Choose the frame that starts next. May be called again until that frame's start is past."""
        ready_ns = self.clock.now_us * 1000
        if ready_ns < self._free_ns:
            ready_ns = self._free_ns
        sender, entry, tie, suspended = None, None, False, 0
        for endpoint in self.endpoints:
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
        ready = [e for e in self.endpoints if e._to_send]
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
            unqueue(sender._to_send, entry)
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
        if any(e._to_send for e in self.endpoints):
            self._arbitrate()
        else:
            self._has_queue = False
            self._is_calm = self._is_ordinary

    def _look_closely(self) -> None:
        """The next frame takes the long way, and whether the one behind it has to is seen there."""
        self._is_ordinary = False

    def _complete_out_of_the_ordinary(self, t_us: int) -> None:
        sender, entry = self._sender, self._entry
        self._confinement.count_runs(self._start_ns - self._free_ns)
        self._free_ns = self._start_ns + entry[3]
        self._busy_ns += entry[3]
        self._has_queue = True  # what was destroyed is sent again
        try:
            self._judge(sender, entry, t_us)
        finally:
            self._end_us = -1
            self._go_on()

    def _judge(self, sender: Endpoint, entry: Entry, t_us: int) -> None:
        if self.disturbance.armed or self._confinement.is_alone() or self._rivals or sender._medium is None:
            self._complete_under_faults(sender, entry, t_us)
        else:
            self._confirm(sender, entry, t_us)
            self._deliver(entry[2], t_us, sender)
        self._is_ordinary = (
            not self.disturbance.armed
            and not self._confinement.is_alone()
            and self._confinement.is_everybody_well(self._free_ns)
        )

    def _confirm(self, sender: Endpoint, entry: Entry, t_us: int) -> None:
        unqueue(sender._to_send, entry)
        self._frames += 1
        self._confinement.sent(sender, self._free_ns)
        if sender.on_sent is not None:
            sender.on_sent(entry[2], t_us)

    def _deliver(self, frame: Frame, t_us: int, *senders: Endpoint) -> None:
        for endpoint in self.endpoints:
            if endpoint not in senders and not endpoint.bus_off:
                self._confinement.received(endpoint)
                endpoint._take(frame, t_us)

    # -- faults ------------------------------------------------------------------------------------------------------

    def _complete_under_faults(self, sender: Endpoint, entry: Entry, t_us: int) -> None:
        frame = entry[2]
        rivals = [(e, its) for e, its in self._rivals if e._medium is not None]
        self._rivals = []
        involved = [sender, *(e for e, _ in rivals)]
        twins = [(sender, entry), *((e, its) for e, its in rivals if its[2] == frame)]  # the same bits: nobody notices
        losers = [e for e, its in rivals if its[2] != frame]
        if sender._medium is None:  # unplugged in the middle
            return self._destroy([], ERROR_PROTOCOL)
        if any(not e.is_passive for e in losers):
            return self._destroy(involved, ERROR_PROTOCOL)
        if self._confinement.is_alone():
            return self._destroy([sender], ERROR_ACK)
        outcome = self.disturbance.judge(frame, sender.name, t_us) if self.disturbance.armed else None
        if outcome is not None and outcome.corrupt:
            return self._destroy(involved, ERROR_PROTOCOL)
        for loser in losers:  # their passive error flags disturb nobody
            self._confinement.failed(loser, ERROR_PROTOCOL, self._free_ns)
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

    def _destroy(self, senders: list[Endpoint], kind: int) -> None:
        """The frame that just ended is followed by an error frame, and sent again when the wire is free."""
        self._free_ns += self._error_delimiter_ns
        self._busy_ns += self._error_delimiter_ns
        self._error_frames += 1
        self._confinement.destroyed(senders, kind, self._free_ns)

    # -- the time ----------------------------------------------------------------------------------------------------

    def _has_started(self) -> bool:
        return self._end_us >= 0 and self.clock.now_us * 1000 > self._start_ns

    def _idle_ns(self) -> tuple[int, int]:
        """From when to when the wire has been idle so far: until a transmission starts, or until now."""
        now_ns = self.clock.now_us * 1000
        return self._free_ns, min(now_ns, self._start_ns) if self._end_us >= 0 else now_ns
