"""The conformance run: our own node passes every line, and each defect shows on exactly the line that is about it."""

import can
import pytest
from conformance_defects import DEFECTS, NoHeartbeatConsumer, Silent, StillPlant

from hil.bus.clock import Lockstep
from hil.bus.published_wires import publish
from hil.bus.wire import Wire
from hil.conformance import report
from hil.conformance.eds import read_eds
from hil.conformance.run import CHECKS, run_all
from hil.conformance.simulated import EDS, simulated_talker
from hil.conformance.talker import Talker
from hil.conformance.verdict import Line, Verdict
from hil.node.amplifier import AmplifierNode
from pkxyz_ctrl.can.codec import ProcessCodec
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import ConfigError, load
from pkxyz_ctrl.io.can_port import to_frame, to_message

BUS = load("buses", "fd_5k", BusConfig)
SAMPLE_CYCLES = 80


def talk_to(node_type: type[AmplifierNode], *, allow_voltage: bool = True, bus: BusConfig = BUS) -> Talker:
    return simulated_talker(
        bus, plant=StillPlant(), node_type=node_type, allow_voltage=allow_voltage, sample_cycles=SAMPLE_CYCLES
    )


def named(lines: list[Line], verdict: Verdict) -> list[str]:
    return [f"{line.group}: {line.name}" for line in lines if line.verdict is verdict]


@pytest.mark.parametrize("bus_name", ["fd_5k", "classic_2k"])
def test_our_own_node_passes(bus_name: str) -> None:
    talker = talk_to(AmplifierNode, bus=load("buses", bus_name, BusConfig))
    lines = run_all(talker)
    assert named(lines, Verdict.FAIL) == []
    left_out = {"fd_5k": [], "classic_2k": ["frames: formats", "drive PDO: too long"]}[bus_name]
    assert named(lines, Verdict.NOT_TESTED) == left_out
    assert len(lines) == len(CHECKS)


def test_a_plain_cia_401_module_passes_what_applies_to_it() -> None:
    can_config = BUS.can
    assert can_config is not None
    driver = can_config.driver.model_copy(update={"protection": False})
    plain = BUS.model_copy(update={"can": can_config.model_copy(update={"driver": driver})})
    lines = run_all(talk_to(AmplifierNode, bus=plain))
    assert named(lines, Verdict.FAIL) == []
    assert set(named(lines, Verdict.NOT_TESTED)) == {
        "sense PDO: alive counter",
        "sense PDO: CRC",
        "drive PDO: wrong CRC",
        "drive PDO: wrong alive counter",
        "drive PDO: late",
        "outputs, with voltage: drive PDO missing",
        "outputs, with voltage: drive by SDO",
    }


@pytest.mark.parametrize("defect", DEFECTS, ids=lambda defect: defect.__name__)
def test_a_defect_shows_on_its_line_and_no_other(defect: type[AmplifierNode]) -> None:
    # Without a heartbeat consumer the voltage stays as well, which would be a second line.
    talker = talk_to(defect, allow_voltage=defect is not NoHeartbeatConsumer)
    lines = run_all(talker)
    assert named(lines, Verdict.FAIL) == [defect.__doc__]
    if defect is Silent:
        assert len(named(lines, Verdict.NOT_TESTED)) == len(CHECKS) - 1


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


def test_without_permission_no_frame_asks_for_a_voltage() -> None:
    """Neither a drive PDO, however wrong, nor an SDO write to outputs or error values."""
    talker = talk_to(AmplifierNode, allow_voltage=False)
    spy = Spy(talker._port)
    talker._port = spy
    lines = run_all(talker)
    assert named(lines, Verdict.FAIL) == []
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
    """SYNC 33 or 34 us, turn-around 2 us, sense PDO about 48 us: nothing is faster, or in between."""
    line = next(line for line in run_all(talk_to(AmplifierNode)) if line.name == "latency")
    words = line.got.replace(",", "").split()
    low, high = int(words[words.index("minimum") + 1]), int(words[words.index("maximum") + 1])
    assert 75 <= low <= high <= 95


def test_two_runs_say_the_same() -> None:
    assert run_all(talk_to(AmplifierNode)) == run_all(talk_to(AmplifierNode))


def test_the_report_holds_every_line() -> None:
    talker = talk_to(AmplifierNode, allow_voltage=False)
    lines = run_all(talker)
    data = report.as_json(talker, "comb_amplifier.eds", lines)
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


def test_the_doc_lists_the_lines_that_are_made() -> None:
    text = (EDS.parents[1] / "docs" / "do" / "conformance.md").read_text(encoding="utf-8")
    listed = [line for line in text.partition("## Lines")[2].partition("\n## ")[0].splitlines() if line[:2] == "| "][1:]
    assert listed == [f"| {check.group} | {check.name} | {check.expected} |" for check in CHECKS]
