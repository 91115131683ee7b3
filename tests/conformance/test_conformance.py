"""The conformance run: our own node passes every line, and each defect shows on exactly the line that is about it."""

from datetime import UTC, datetime

import can
import pytest
from conformance_defects import DEFECTS, EverySenseLate, SelfStarting, StillPlant, WaitsOnce
from defective.frames import NoHeartbeatConsumer
from defective.objects import ForgetfulReadBack, Silent

from hil.bus.clock import Lockstep
from hil.bus.published_wires import publish
from hil.bus.wire import Wire
from hil.conformance import report
from hil.conformance.deviation import DeviationError
from hil.conformance.eds import read_eds
from hil.conformance.objects import identity_of
from hil.conformance.run import CHECKS, run_all
from hil.conformance.simulated import EDS, simulated_talker
from hil.conformance.talker import Talker
from hil.conformance.verdict import DEVIATIONS, OUR_CONTRACT, Check, CheckResult, Verdict, judge
from hil.node.amplifier import AmplifierNode
from pkxyz_ctrl.can.codec import ProcessCodec
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import ConfigError, load
from pkxyz_ctrl.io.can_port import to_frame, to_message

MADE = datetime(2026, 11, 22, 13, tzinfo=UTC)
BUS = load("buses", "fd_5k", BusConfig)
SAMPLE_CYCLES = 80


def talk_to(node_type: type[AmplifierNode], *, allow_voltage: bool = True, bus: BusConfig = BUS) -> Talker:
    return simulated_talker(
        bus, plant=StillPlant(), node_type=node_type, allow_voltage=allow_voltage, sample_cycles=SAMPLE_CYCLES
    )


def named(lines: list[CheckResult], verdict: Verdict) -> list[str]:
    return [f"{line.group}: {line.name}" for line in lines if line.verdict is verdict]


def deviating(lines: list[CheckResult]) -> list[str]:
    return [f"{line.group}: {line.name}" for line in lines if line.verdict in DEVIATIONS]


@pytest.mark.parametrize("bus_name", ["fd_5k", "classic_2k"])
def test_our_own_node_passes(bus_name: str) -> None:
    talker = talk_to(AmplifierNode, bus=load("buses", bus_name, BusConfig))
    lines = run_all(talker)
    assert deviating(lines) == []
    left_out = {"fd_5k": [], "classic_2k": ["frames: formats", "drive PDO: too long"]}[bus_name]
    assert named(lines, Verdict.NOT_TESTED) == left_out
    assert len(lines) == len(CHECKS)


def test_a_plain_cia_401_module_passes_what_applies_to_it() -> None:
    can_config = BUS.can
    assert can_config is not None
    driver = can_config.driver.model_copy(update={"protection": False})
    plain = BUS.model_copy(update={"can": can_config.model_copy(update={"driver": driver})})
    lines = run_all(talk_to(AmplifierNode, bus=plain))
    assert deviating(lines) == []
    assert set(named(lines, Verdict.NOT_TESTED)) == {
        "sense PDO: alive counter",
        "sense PDO: CRC",
        "drive PDO: wrong CRC",
        "drive PDO: wrong alive counter",
        "drive PDO: late",
        "outputs, with voltage: drive PDO missing",
        "outputs, with voltage: drive time-out",
        "outputs, with voltage: own step limit",
        "outputs, with voltage: drive by SDO",
        "signature: of what is read",
    }


@pytest.mark.parametrize("defect", DEFECTS, ids=lambda defect: defect.__name__)
def test_a_defect_shows_on_its_line_and_no_other(defect: type[AmplifierNode]) -> None:
    # Without a heartbeat consumer the voltage stays as well, which would be a second line.
    talker = talk_to(defect, allow_voltage=defect is not NoHeartbeatConsumer)
    lines = run_all(talker)
    also = ["signature: of what is read"] if defect is ForgetfulReadBack else []  # it signs what it holds
    assert deviating(lines) == [defect.__doc__, *also]
    if defect is Silent:
        assert len(named(lines, Verdict.NOT_TESTED)) == len(CHECKS) - 1


KINDS = {
    Verdict.UNSAFE: {
        "drive PDO: wrong CRC", "drive PDO: wrong alive counter", "drive PDO: late",
        "drive PDO: negative count", "outputs: heartbeat consumer", "outputs, with voltage: own step limit",
    },
    Verdict.MEASURE: {
        "outputs: after reset", "outputs, with voltage: heartbeat lost", "outputs, with voltage: leaving operational",
        "outputs, with voltage: error value",
    },
    Verdict.OTHER_CONTRACT: {
        "identity: identity", "object dictionary: configuration", "frames: formats", "sense PDO: latency",
        "sense PDO: alive counter", "sense PDO: CRC", "SYNC: SYNC counter", "drive PDO: too long",
        "outputs, with voltage: drive by SDO", "outputs, with voltage: scaling",
        "outputs, with voltage: drive PDO missing", "outputs, with voltage: drive time-out",
        "signature: of what is read",
    },
}  # fmt: skip


@pytest.mark.parametrize("defect", DEFECTS, ids=lambda defect: defect.__name__)
def test_a_deviation_is_of_its_kind(defect: type[AmplifierNode]) -> None:
    """Unsafe: a frame that must be refused is applied, or nobody notices that we are gone. To be measured: where the
    node's own word on its outputs is all there is. All others are against a clause of CiA's, which the line names.
    """
    talker = talk_to(defect)
    check = next(check for check in CHECKS if f"{check.group}: {check.name}" == defect.__doc__)
    line = judge(check, talker)
    expected = next((kind for kind, names in KINDS.items() if defect.__doc__ in names), Verdict.AGAINST_CIA)
    assert line.verdict is expected, line
    if expected is Verdict.AGAINST_CIA:
        assert line.basis.startswith("CiA")


def test_a_node_that_starts_by_itself_passes() -> None:
    assert deviating(run_all(talk_to(SelfStarting))) == []


def test_answers_that_all_come_too_late_are_no_fast_answers() -> None:
    """Each 7 ms after its SYNC, 35 periods: not dropped, and not taken for a very fast answer to a later one."""
    line = judge(next(check for check in CHECKS if check.name == "latency"), talk_to(EverySenseLate))
    assert line.verdict is Verdict.OTHER_CONTRACT
    words = line.got.replace(",", "").split()
    assert 7000 <= int(words[words.index("minimum") + 1]) <= int(words[words.index("maximum") + 1]) <= 7200


def test_an_answer_that_comes_too_late_is_not_taken_for_the_next_one() -> None:
    lines = run_all(talk_to(WaitsOnce))
    assert deviating(lines) == [WaitsOnce.__doc__]


def test_every_line_is_made_to_fail_by_some_defect() -> None:
    """Or is named here with the reason why it cannot fail alone."""
    with_a_defect = {defect.__doc__ for defect in DEFECTS}
    alone = {f"{check.group}: {check.name}" for check in CHECKS} - with_a_defect
    assert alone == {
        "SDO: unknown index", "SDO: too long", "SDO: unknown command", "SDO: client's abort",  # as their neighbours
        "boot-up and NMT: states", "heartbeat: heartbeat in the loop", "heartbeat: heartbeat off",
        "sense PDO: transmission type", "sense PDO: switched off",
        "drive PDO: accepted",  # nothing that needs applied counts can pass then
    }  # fmt: skip


class Spy:
    """A port that keeps what was sent through it."""

    def __init__(self, port: object) -> None:
        self._port = port
        self.sent: list[Frame] = []

    def send(self, frame: Frame) -> object:
        self.sent.append(frame)
        return self._port.send(frame)  # type: ignore[attr-defined]

    def receive(self, deadline_us: int) -> Frame | None:
        return self._port.receive(deadline_us)  # type: ignore[attr-defined, no-any-return]

    def unsent(self) -> int:
        return self._port.unsent()  # type: ignore[attr-defined, no-any-return]


class Echo(Spy):
    """An adapter that returns what it has sent, as with ``receive_own_messages``."""

    def receive(self, deadline_us: int) -> Frame | None:
        return self.sent.pop(0) if self.sent else super().receive(deadline_us)


def test_our_own_frames_are_no_answers() -> None:
    talker = talk_to(AmplifierNode)
    talker._port = Echo(talker._port)
    assert deviating(run_all(talker)) == []


class Endless:
    """A port on a flooded bus: each read costs 10 us and brings somebody else's frame."""

    def __init__(self, talker: Talker) -> None:
        self._clock, self.reads = talker._clock, 0

    def send(self, frame: Frame) -> object:
        return None

    def receive(self, deadline_us: int) -> Frame | None:
        self.reads += 1
        assert self.reads < 100_000
        self._clock.spend(10)
        return Frame(0x123, b"")

    def unsent(self) -> int:
        return 0


def test_on_a_flooded_bus_listening_ends() -> None:
    talker = talk_to(AmplifierNode)
    talker._port = Endless(talker)
    begin_us = talker.now_us
    talker.run(5000)
    assert 5000 <= talker.now_us - begin_us <= 6000
    assert talker.first(talker.sense_id, 5000) is None


def test_a_tester_that_is_late_itself_blames_nobody() -> None:
    """Made again, three times in all; a check that is about no times is believed at once, and so is one that passes."""
    talker, made = talk_to(AmplifierNode), []

    def late_until(attempt: int, is_timed: bool = True) -> CheckResult:
        made.clear()

        def perform(talker: Talker) -> str:
            made.append(1)
            talker.late_us = 30_000 if len(made) <= attempt else 0
            raise DeviationError("EMCY 0x8130")

        return judge(Check("g", "n", "e", OUR_CONTRACT, perform, is_timed), talker)

    assert (late_until(0).verdict, len(made)) == (Verdict.OTHER_CONTRACT, 1)
    assert (late_until(2).verdict, len(made)) == (Verdict.OTHER_CONTRACT, 3)
    line = late_until(3)
    assert (line.verdict, len(made)) == (Verdict.NOT_TESTED, 3)
    assert "30.0 ms late" in line.got
    assert (late_until(3, is_timed=False).verdict, len(made)) == (Verdict.OTHER_CONTRACT, 1)


def test_lateness_is_that_of_waits_and_of_our_heartbeats() -> None:
    talker = talk_to(AmplifierNode)
    talker.operational()
    talker.cycles(10)
    assert talker.late_us == 0
    talker._clock.spend(45_000)  # held up; our heartbeat is due every 20 ms
    talker.run(100)
    assert talker.late_us >= 25_000
    assert talker.was_late


def test_without_permission_no_frame_asks_for_a_voltage() -> None:
    """Neither a drive PDO, however wrong, nor an SDO write to outputs or error values."""
    talker = talk_to(AmplifierNode, allow_voltage=False)
    spy = Spy(talker._port)
    talker._port = spy
    lines = run_all(talker)
    assert deviating(lines) == []
    drives = [frame.data for frame in spy.sent if frame.can_id == 0x30A]
    assert len(drives) > SAMPLE_CYCLES
    assert all(not any(data[:6]) for data in drives)
    writes = [f.data for f in spy.sent if f.can_id == 0x60A and f.data[0] >> 5 == 1 and not f.is_extended]
    to_outputs = [data for data in writes if int.from_bytes(data[1:3], "little") in (0x6411, 0x6444) and data[3]]
    assert to_outputs
    assert all(not any(data[4:]) for data in to_outputs)


def test_with_permission_no_more_than_some_volts() -> None:
    talker = talk_to(AmplifierNode)
    spy = Spy(talker._port)
    talker._port = spy
    run_all(talker)
    codec = ProcessCodec(0x30A, True)
    counts = [codec.decode(frame.data)[:3] for frame in spy.sent if frame.can_id == 0x30A and len(frame.data) == 8]
    assert max(max(each) for each in counts) == 819  # 5 V
    assert min(min(each) for each in counts) == -1  # what must be refused
    assert talker.outputs() == (0, 0, 0)


class PythonCanPort:
    """The same over python-can's own interface class."""

    def __init__(self, bus: can.BusABC, clock: Lockstep) -> None:
        self._bus = bus
        self._clock = clock

    def send(self, frame: Frame) -> object:
        self._bus.send(to_message(frame))
        return None

    def receive(self, deadline_us: int) -> Frame | None:
        message = self._bus.recv(max(0, deadline_us - self._clock.now_us) * 1e-6)
        return None if message is None else to_frame(message)

    def unsent(self) -> int:
        return 0


def test_over_a_python_can_bus_the_lines_are_the_same() -> None:
    clock = Lockstep()
    wire = Wire(clock, 1_000_000, 5_000_000)
    publish(wire, "conformance")
    amplifier = wire.attach("amplifier")
    node = AmplifierNode(10, clock, amplifier.send, StillPlant(), EDS, turnaround_us=2, fd=True, protection=True)
    amplifier.on_frame = node.on_frame
    node.power_on()
    with can.Bus(interface="pkxyz-sim", channel="conformance", fd=True) as bus:
        talker = Talker(
            clock, PythonCanPort(bus, clock), BUS, read_eds(EDS, 10),
            allow_voltage=True, sample_cycles=SAMPLE_CYCLES,
        )  # fmt: skip
        lines = run_all(talker)
    direct = run_all(talk_to(AmplifierNode))
    assert [(line.name, line.verdict) for line in lines] == [(line.name, line.verdict) for line in direct]


def test_latency_is_that_of_the_wire() -> None:
    """SYNC 33 or 34 us, response time 2 us, sense PDO about 48 us: nothing is faster, or in between."""
    line = next(line for line in run_all(talk_to(AmplifierNode)) if line.name == "latency")
    words = line.got.replace(",", "").split()
    low, high = int(words[words.index("minimum") + 1]), int(words[words.index("maximum") + 1])
    assert 75 <= low <= high <= 95


def test_two_runs_say_the_same() -> None:
    assert run_all(talk_to(AmplifierNode)) == run_all(talk_to(AmplifierNode))


def test_the_report_holds_every_line() -> None:
    talker = talk_to(AmplifierNode, allow_voltage=False)
    lines = run_all(talker)
    data = report.as_json(talker, "comb_amplifier.eds", lines, identity_of(talker), MADE)
    text = report.as_markdown(data)
    assert data["ok"]
    assert not data["complete"]
    assert "know why" in report.conclusion(data)
    assert text.count("| PASS |") == data["passed"]
    assert text.count("| NOT TESTED |") == data["not_tested"] == len(CHECKS) - data["passed"]
    for check in CHECKS:
        assert f"| {check.name} |" in text
        assert check.expected in text


def test_another_eds_or_none() -> None:
    with pytest.raises(ConfigError, match="--eds"):
        read_eds(EDS.parent / "no.eds", 10)
    with pytest.raises(ConfigError, match="EDS"):
        read_eds(EDS.parent / "buses" / "fd_5k.toml", 10)
    with pytest.raises(ConfigError, match="no amplifier"):
        simulated_talker(load("buses", "local_20k", BusConfig))
