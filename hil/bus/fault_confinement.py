"""Fault confinement (ISO 11898-1, 12.1.4): what an error counts for whom, who falls silent, and who comes back."""

from collections.abc import Callable
from functools import partial

from hil.bus.clock import Lockstep
from hil.bus.endpoint import Endpoint
from hil.bus.frame_time import bits_ns
from pkxyz_ctrl.can.frame import Frame

SUSPEND_BITS = 8  # an error-passive sender waits so long after its own frame
RECOVERY_RUNS = 128  # of 11 recessive bits each
RECESSIVE_RUN_BITS = 11  # also what ends every frame and error frame: delimiter or ACK delimiter and EOF, and 3 bits

# classes of an error frame, as in linux/can/error.h
ERROR_ACK, ERROR_PROTOCOL, ERROR_BUS_OFF, ERROR_BUS, ERROR_RESTARTED = 0x020, 0x008, 0x040, 0x080, 0x100


class FaultConfinement:
    """The error counters of all controllers on a wire of ``nominal_bitrate`` bit/s.

    ``idle_ns`` tells from when to when the wire has been idle so far, in ns; the second may lie before the first.
    """

    def __init__(self, clock: Lockstep, nominal_bitrate: int, idle_ns: Callable[[], tuple[int, int]]) -> None:
        self.endpoints: tuple[Endpoint, ...] = ()
        self._clock = clock
        self._idle_ns = idle_ns
        self._suspend_ns = bits_ns(SUSPEND_BITS, nominal_bitrate)
        self._run_ns = bits_ns(RECESSIVE_RUN_BITS, nominal_bitrate)
        self._recovering: dict[Endpoint, int] = {}  # and the run of 11 recessive bits at which each is back
        self._runs = 0  # counted while an endpoint recovers

    @property
    def nodes(self) -> int:
        """How many acknowledge a frame, its sender included."""
        return sum(not (e.listen_only or e.bus_off) for e in self.endpoints)

    def is_everybody_well(self, free_ns: int) -> bool:
        """True if no error is counted anywhere, and nobody has to wait once the wire is free at ``free_ns``."""
        return not any(
            e.transmit_errors or e.receive_errors or e.bus_off or e._earliest_ns > free_ns for e in self.endpoints
        )

    def may_everybody_send(self, free_ns: int) -> bool:
        """True if nobody is error-passive or bus-off, or has to wait once the wire is free at ``free_ns``."""
        return not any(e.is_passive or e.bus_off or e._earliest_ns > free_ns for e in self.endpoints)

    def is_alone(self) -> bool:
        """True if there is nobody who could acknowledge the frame of another."""
        return self.nodes < 2

    def forget(self, endpoint: Endpoint) -> None:
        """It has been unplugged."""
        self._recovering.pop(endpoint, None)

    # -- counters ----------------------------------------------------------------------------------------------------

    def destroyed(self, senders: list[Endpoint], kind: int, free_ns: int) -> None:
        """A frame ended in an error frame, after which the wire is free at ``free_ns``: everybody counts it."""
        for endpoint in senders:
            self.failed(endpoint, kind, free_ns)
        for endpoint in self.endpoints:
            if endpoint not in senders and not endpoint.listen_only and not endpoint.bus_off:
                endpoint.receive_errors = min(endpoint.receive_errors + 1, 128)
        self._announce(kind | ERROR_BUS, senders[0] if senders else None)

    def failed(self, sender: Endpoint, kind: int, free_ns: int) -> None:
        """What ``sender`` sent was in error."""
        if kind != ERROR_ACK or not sender.is_passive:  # a node alone on its bus does not go bus-off
            sender.transmit_errors += 8
        if sender.is_passive:
            sender._earliest_ns = free_ns + self._suspend_ns
        if sender.transmit_errors < 256:
            return
        sender.bus_off = True
        sender.send_drops += len(sender._to_send)
        sender._to_send.clear()  # what has waited so long would come as a surprise
        self._announce(ERROR_BUS_OFF, sender)
        if sender.auto_recover:
            self.begin_recovery(sender)

    def sent(self, sender: Endpoint, free_ns: int) -> None:
        """A frame of ``sender`` went through, and the wire is free at ``free_ns``."""
        if sender.transmit_errors or sender.receive_errors:
            sender.transmit_errors = max(0, sender.transmit_errors - 1)
            if sender.is_passive:
                sender._earliest_ns = free_ns + self._suspend_ns

    @staticmethod
    def received(receiver: Endpoint) -> None:
        """A frame of another went through."""
        if receiver.receive_errors:
            # a passive receiver returns to 119..127 (ISO 11898-1, 12.1.4.2 h): the upper end
            receiver.receive_errors = min(receiver.receive_errors, 128) - 1

    # -- recovery from bus-off ---------------------------------------------------------------------------------------

    def begin_recovery(self, endpoint: Endpoint) -> None:
        """Bring back ``endpoint`` after 128 runs of 11 recessive bits from now."""
        if endpoint not in self._recovering:
            self._recovering[endpoint] = self._recessive_runs() + RECOVERY_RUNS
            self._await_recovery(endpoint)

    def count_runs(self, idle_ns: int) -> None:
        """A frame has ended, destroyed or not, before which the wire was idle for ``idle_ns``."""
        if self._recovering:
            self._runs += 1 + idle_ns // self._run_ns

    def _recessive_runs(self) -> int:
        """Runs of 11 recessive bits so far: one ends every frame, the others are the idle time."""
        idle_from_ns, idle_until_ns = self._idle_ns()
        return self._runs + max(0, idle_until_ns - idle_from_ns) // self._run_ns

    def _await_recovery(self, endpoint: Endpoint) -> None:
        if endpoint not in self._recovering:
            return
        missing = self._recovering[endpoint] - self._recessive_runs()
        if missing > 0:  # as early as it can be: while the wire is busy the runs come more slowly
            idle_from_ns, _ = self._idle_ns()
            ready_ns = max(self._clock.now_us * 1000, idle_from_ns) + missing * self._run_ns
            self._clock.call_at(-(-ready_ns // 1000), partial(self._await_recovery, endpoint))
            return
        del self._recovering[endpoint]
        endpoint.bus_off = False
        endpoint.transmit_errors = endpoint.receive_errors = 0
        self._announce(ERROR_RESTARTED, endpoint)

    # -- who hears of it ---------------------------------------------------------------------------------------------

    def _announce(self, kind: int, endpoint: Endpoint | None) -> None:
        """Tell those who asked for error frames; bytes 6 and 7 are the endpoint's counters, as in linux/can/error.h."""
        counters = (min(endpoint.transmit_errors, 255), endpoint.receive_errors) if endpoint is not None else (0, 0)
        frame = Frame(kind, bytes((0, 0, 0, 0, 0, 0, *counters)), is_error=True)
        for listener in self.endpoints:
            if listener.error_frames:
                listener._take(frame, self._clock.now_us)
