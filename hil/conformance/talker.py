"""The other end of the conversation: one master on the bus, with everything that it heard, and when."""

from collections.abc import Callable

from hil.conformance import sdo_client
from hil.conformance.deviation import UndecidedError
from hil.conformance.eds import Variable
from hil.conformance.sdo_client import SdoResult
from pkxyz_ctrl.can import cob_id
from pkxyz_ctrl.can.cob_id import NmtCommand
from pkxyz_ctrl.can.codec import Counts, ProcessCodec
from pkxyz_ctrl.can.driver_config import OUR_TIMEOUT_MAX_MS
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.can.startup import configuration_steps
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.loop.runtime import Clock, Port

_LATE_US = 500  # less is not worth to be called late; at slow rates, a quarter of a period
_READ_ON = 64  # frames that wait already, when the time is over
_LATE_ANSWERS, _LATE_ANSWERS_US = 10, 1_000_000  # times the time-out, so long or once more: not taken for the next
SETTLE_US = 5_000  # for a node to take note of a command; also longer than the usual EMCY inhibit time
ZERO: Counts = (0, 0, 0)
SAMPLE_CYCLES = 500  # of which distributions are made: p99 is then the fifth from the top


class Talker:
    """Talks to one node over any ``Port``; time is ``clock``'s.

    ``heard`` keeps every frame with the time at which it was received. With ``beating`` our heartbeat goes out in time
    while anything else is waited for. Nothing here drives a count other than 0 unless a check asks for it, and checks
    ask only with ``allow_voltage``.
    """

    def __init__(
        self,
        clock: Clock,
        port: Port,
        bus: BusConfig,
        variables: tuple[Variable, ...],
        *,
        allow_voltage: bool,
        stamp_us: Callable[[], int] | None = None,
        sample_cycles: int = SAMPLE_CYCLES,
    ) -> None:
        """``stamp_us``: when the frame received last arrived, where the port knows it better than the clock does."""
        if bus.can is None:
            raise ConfigError(
                f"bus {bus.name!r} has no [can]: there is no amplifier to talk to; take fd_5k or classic_2k"
            )
        self._clock = clock
        self._port = port
        self._stamp_us = stamp_us or (lambda: clock.now_us)
        self.sample_cycles = sample_cycles
        self.bus = bus
        self.can = bus.can
        self.driver = bus.can.driver
        self.variables = variables
        self.allow_voltage = allow_voltage
        node = self.driver.node_id
        self.node_id = node
        self.heartbeat_id = cob_id.HEARTBEAT_BASE + node
        self.emergency_id = cob_id.EMCY_BASE + node
        self.sense_id = cob_id.sense(node, self.driver.sense_pdo)
        self.drive_id = cob_id.drive(node, self.driver.drive_pdo)
        self.sense_parameter = 0x1800 + self.driver.sense_pdo - 1
        self.drive_parameter = 0x1400 + self.driver.drive_pdo - 1
        self.sync_overflow = cob_id.SYNC_COUNTER_OVERFLOW
        """Of the node's SYNC counter; 0: its SYNC has none."""
        self.drive_codec = ProcessCodec(self.drive_id, self.driver.protection)
        self.sense_codec = ProcessCodec(self.sense_id, self.driver.protection)
        self.heard: list[tuple[int, Frame]] = []
        self.beating = False
        self.drive_counter = 0
        self._sync_counter = 0
        self.late_us = 0
        self.last_beat_us = 0
        self._beat_us = 0

    # -- frames ------------------------------------------------------------------------------------------------------

    @property
    def now_us(self) -> int:
        return self._clock.now_us

    @property
    def was_late(self) -> bool:
        """Whether this side kept its own times badly since ``late_us`` was set to 0."""
        return self.late_us > max(_LATE_US, self.bus.period_us // 4)

    def send(self, can_id: int, data: bytes, *, extended: bool = False, fd: bool | None = None) -> None:
        """One frame in the format of the bus, or classic with ``fd=False``."""
        is_fd = self.driver.fd if fd is None else fd
        self._port.send(Frame(can_id, data, is_fd, is_fd, False, extended, False))

    def run(self, duration_us: int) -> None:
        """Listen for ``duration_us``."""
        self._listen(self.now_us + duration_us, None)

    def first(self, can_id: int, within_us: int) -> tuple[int, Frame] | None:
        """Listen until a frame ``can_id`` comes."""
        return self._listen(self.now_us + within_us, can_id)

    def since(self, mark: int, can_id: int) -> list[tuple[int, bytes]]:
        """What was heard under ``can_id`` after ``heard`` had ``mark`` entries."""
        return [(t_us, frame.data) for t_us, frame in self.heard[mark:] if _is_base(frame) and frame.can_id == can_id]

    def mark(self) -> int:
        """The present end of ``heard``."""
        return len(self.heard)

    def _listen(self, deadline_us: int, wanted: int | None) -> tuple[int, Frame] | None:
        read_on = _READ_ON
        while True:
            self._beat_if_due()
            until_us = min(deadline_us, self._beat_us) if self.beating else deadline_us
            frame = self._port.receive(until_us)
            if frame is not None:
                entry = (self._stamp_us(), frame)
                self.heard.append(entry)
                if frame.can_id == wanted and _is_base(frame):
                    return entry
                read_on -= self.now_us > deadline_us  # on a flooded bus there is always one more
            if (frame is None and self.now_us >= deadline_us) or read_on == 0:
                self.late_us = max(self.late_us, self.now_us - deadline_us)
                return None

    def _beat_if_due(self) -> None:
        if self.beating and self.now_us >= self._beat_us:
            self.late_us = max(self.late_us, self.now_us - self._beat_us)
            self.last_beat_us = self.now_us
            self._beat_us = self.last_beat_us + 1000 * self.driver.controller_heartbeat_period_ms
            self.send(cob_id.HEARTBEAT_BASE + self.driver.controller_node_id, b"\x05")

    # -- services ----------------------------------------------------------------------------------------------------

    def exchange(self, request: bytes) -> bytes | None:
        """One SDO request and its reply; None if none came within the configured time.

        A reply that is about another object is an earlier one's, and passed over; so is one that comes too late.
        """
        self.send(cob_id.SDO_REQUEST_BASE + self.node_id, request)
        replies, timeout_us = cob_id.SDO_RESPONSE_BASE + self.node_id, self.driver.sdo_timeout_us
        end_us = self.now_us + timeout_us
        while (reply := self.first(replies, max(0, end_us - self.now_us))) is not None:
            if len(reply[1].data) != 8:
                return None
            if sdo_client.is_answer(request, reply[1].data):
                return reply[1].data
        self.first(replies, max(timeout_us, min(_LATE_ANSWERS * timeout_us, _LATE_ANSWERS_US)))
        return None

    def read(self, index: int, subindex: int) -> SdoResult:
        return sdo_client.read(self.exchange, index, subindex)

    def write(self, index: int, subindex: int, value: int, length: int) -> SdoResult:
        return self.write_bytes(index, subindex, (value % (1 << 8 * length)).to_bytes(length, "little"))

    def write_bytes(self, index: int, subindex: int, data: bytes) -> SdoResult:
        return sdo_client.write(self.exchange, index, subindex, data)

    def nmt(self, command: NmtCommand, node_id: int | None = None) -> None:
        """Send and let it take effect."""
        self.send(cob_id.NMT, bytes((command, self.node_id if node_id is None else node_id)))
        self.run(SETTLE_US)

    def reset(self, command: NmtCommand = NmtCommand.RESET_NODE) -> tuple[int, Frame] | None:
        """Begin anew: the boot-up message, None if there was none (a node without one is given time all the same)."""
        self.beating = False
        self.drive_counter = self._sync_counter = 0
        self.send(cob_id.NMT, bytes((command, self.node_id)))
        boot = self.first(self.heartbeat_id, self.driver.boot_timeout_us)
        self.run(SETTLE_US)
        self.nmt(
            NmtCommand.PRE_OPERATIONAL
        )  # a node may start by itself (CiA 302-2, object 1F80h), and hold what is safe fixed
        return boot

    def operational(self) -> None:
        """From reset to operational as our driver does it. What it could not write, the line on configuration tells."""
        self.reset()
        unhurried = self.driver.model_copy(update={"drive_timeout_ms": OUR_TIMEOUT_MAX_MS})  # SDO reads come in between
        for step in configuration_steps(unhurried):
            if step.write and step.value is not None:
                self.write(step.index, step.subindex, step.value, step.size)
        overflow = self.read(0x1019, 0)
        self.sync_overflow = overflow.unsigned if overflow.ok else 0
        self.beating = True
        self._beat_us = self.now_us
        self.run(SETTLE_US)
        self.nmt(NmtCommand.START)

    # -- process data ------------------------------------------------------------------------------------------------

    def sync(self, data: bytes | None = None) -> int:
        """Send SYNC, its counter one on unless ``data`` is given; the time just before."""
        begin_us = self.now_us  # not after: a process that is held up there would find the answer before the question
        counted = b""
        if self.sync_overflow:
            self._sync_counter = self._sync_counter % self.sync_overflow + 1
            counted = bytes((self._sync_counter,))
        self.send(cob_id.SYNC, counted if data is None else data)
        return begin_us

    def next_drive(self, counts: Counts = ZERO) -> bytes:
        """The next drive PDO in sequence."""
        self.drive_counter = (self.drive_counter + 1) & 0xFF
        return self.drive_codec.encode(counts, self.drive_counter)

    def cycle(self, drive: bytes | None = None) -> int:
        """One period: SYNC, sense PDO, ``drive`` (nothing if None); the time of the SYNC."""
        begin_us = self.sync()
        self._listen(begin_us + self.can.sense_deadline_us + self.can.compute_us, None)
        if drive is not None:
            self.send(self.drive_id, drive)
        self._listen(begin_us + self.bus.period_us, None)
        return begin_us

    def cycles(self, count: int, counts: Counts = ZERO) -> None:
        """So many periods with valid drive PDOs."""
        for _ in range(count):
            self.cycle(self.next_drive(counts))

    def emergencies(self, mark: int) -> list[int]:
        """Codes of the EMCY frames after ``mark``, those that end an error (0) included."""
        return [int.from_bytes(data[:2], "little") for _, data in self.since(mark, self.emergency_id) if len(data) == 8]

    def outputs(self) -> Counts:
        """0x6411 as the node tells it. Raises UndecidedError if it does not."""
        outcomes = [self.read(0x6411, channel) for channel in self.driver.drive_channels]
        if silent := next((result for result in outcomes if not result.ok), None):
            raise UndecidedError(f"0x6411 cannot be read ({silent.text}): hold a voltmeter to the terminals")
        a, b, c = (result.unsigned for result in outcomes)
        return a, b, c


def _is_base(frame: Frame) -> bool:
    return not (frame.is_remote or frame.is_extended or frame.is_error)
