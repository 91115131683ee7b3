"""What CANopenNode and lely-core said to us and heard from us, played again (CONTRIBUTING.md says how to record it)."""

from itertools import pairwise

import pytest
from node_rig import EDS, RecordingPlant
from recording import NMT, REPLY, REQUEST, FollowedNode, RecordedNode, RecordedPort, frames_of

from hil.bus.clock import Lockstep
from hil.conformance import network, objects, outputs, process
from hil.conformance.deviation import DeviationError
from hil.conformance.eds import read_eds
from hil.conformance.run import conformance
from hil.conformance.talker import Talker
from hil.conformance.verdict import Verdict
from hil.node.amplifier import AmplifierNode
from pkxyz_ctrl.can.driver import AmplifierDriver
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.driver_rules import DriverState
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import load

CHANGED = (b"\x01\x64", b"\x00\x10")
"""Of our node: 0x6401 is live, and its device type has gained digital outputs since."""
SINCE = {0x1400, 0x1600, 0x1802, 0x1A02, 0x2020, 0x6200, 0x6206, 0x6207}
"""Objects that the EDS has got since then: digital outputs, and the signature."""
SLOW = DriverConfig(  # as in the guest
    fd=False,
    protection=False,
    controller_heartbeat_timeout_ms=1000,
    node_heartbeat_timeout_ms=2500,
    drive_timeout_ms=600,
    boot_timeout_us=20_000_000,
    start_timeout_us=5_000_000,
    sdo_timeout_us=5_000_000,
)
FROM_THE_NODE = frozenset({0x08A, 0x28A, 0x70A})
OF_LELY = {
    "SYNC: SYNC length": (Verdict.AGAINST_CIA, "SYNC with no data: taken for a SYNC"),
    "SYNC: SYNC counter": (Verdict.OTHER_CONTRACT, "SYNC with 00: taken for a SYNC"),
    "drive PDO: too short": (Verdict.UNSAFE, "2 bytes: applied, 0x6411 (328, 328, 492)"),
    "drive PDO: too long": (Verdict.OTHER_CONTRACT, "8 bytes: applied"),
    "EMCY: register and end": (Verdict.AGAINST_CIA, "no EMCY 0x0000"),
    "outputs, with voltage: leaving operational": (Verdict.MEASURE, "after stop 0x6411 reads (164, 328, 492)"),
    "outputs, with voltage: error value": (Verdict.MEASURE, "error modes and values say (328, 328, 0)"),
    "outputs, with voltage: applied at SYNC": (Verdict.PASS, "applied at the SYNC, not before"),
}
"""Beyond objects, SDO and NMT, in the order of the recording."""


@pytest.mark.parametrize("name", ["canopennode_amplifier.log", "lely_amplifier.log"])
def test_an_amplifier_by_our_eds_is_started_and_tried(name):
    driver, node, t_us = AmplifierDriver(SLOW), RecordedNode(name, FROM_THE_NODE), 0
    waiting = list(driver.start(t_us))
    states = []
    while driver.state not in (DriverState.OPERATIONAL, DriverState.FAILED) and t_us < 20_000_000:
        for frame in waiting:
            node.receive(frame, t_us)
        t_us += 1000
        waiting = [reply for frame in node.due(t_us) for reply in driver.receive(frame, t_us)]
        waiting += driver.poll(t_us)
        if driver.state not in states:
            states.append(driver.state)
    assert (driver.state, driver.failure) == (DriverState.OPERATIONAL, "")
    assert DriverState.TRYING in states
    assert driver.node_events == 0
    assert any(line.startswith("no 0x1029") or line.startswith("protection = false") for line in driver.lost)


@pytest.mark.parametrize("name", ["canopenlinux_master.log", "lely_master.log"])
def test_a_master_hears_from_our_node_what_it_heard_when_it_was_recorded(name):
    """Every SDO answer, byte for byte, and every state; but for sense counts, which are the plant's."""
    clock, heard = Lockstep(), []
    node = AmplifierNode(10, clock, heard.append, RecordingPlant(), EDS, turnaround_us=2, fd=False, protection=True)
    node.power_on()
    clock.run_until(5000)
    heard.clear()
    expected = []
    for t_us, frame in frames_of(name):
        if frame.can_id in (NMT, REQUEST):
            clock.run_until(max(clock.now_us, 5000 + t_us))
            node.on_frame(frame, clock.now_us)
        elif frame.can_id == REPLY:
            expected.append(frame.data)
    clock.run_until(clock.now_us + 100_000)
    answers = [frame.data for frame in heard if frame.can_id == REPLY]
    assert [data for data in answers if data[1:3] not in CHANGED] == [
        data for data in expected if data[1:3] not in CHANGED
    ]
    assert len(answers) == len(expected) > 8
    aborts = {int.from_bytes(data[4:], "little") for data in answers if data[0] == 0x80}
    assert {0x06020000, 0x06010002} <= aborts


def test_what_the_check_says_of_canopennode():
    """Objects, SDO and resets: it refuses all that CiA 301 wants refused but values beyond their range, and a reset of
    communication leaves its objects as they are.
    """
    shipped, clock = load("buses", "socketcan_classic", BusConfig), Lockstep()
    bus = shipped.model_copy(update={"can": shipped.can.model_copy(update={"driver": SLOW})})
    port = RecordedPort(RecordedNode("canopennode_check.log", FROM_THE_NODE), clock)
    of_then = tuple(variable for variable in read_eds(EDS, 10) if variable.index not in SINCE)
    talker = Talker(clock, port, bus, of_then, allow_voltage=True)
    checks = (objects.ANSWERS, *objects.CHECKS, *network.CHECKS[:2])
    lines = {f"{line.group}: {line.name}": line for line in conformance(talker, checks)}
    assert len(lines) == 19
    deviating = {name: line.got for name, line in lines.items() if line.verdict is not Verdict.PASS}
    assert list(deviating) == ["SDO: out of range", "boot-up and NMT: communication reset"]
    assert "0x1029:01 = 3: accepted" in deviating["SDO: out of range"]
    assert deviating["boot-up and NMT: communication reset"] == "0x1017:00 64 00, default 00 00"


def test_what_the_check_says_of_lely():
    """Objects, SDO and NMT are right. A SYNC of a wrong length is told (0x8240) and obeyed all the same, and of a PDO
    that is too short the front is put out before it is told (0x8210): its sources say so. Error values are left to the
    application, which this one has not.
    """
    shipped, clock = load("buses", "socketcan_classic", BusConfig), Lockstep()
    driver = SLOW.model_copy(update={"digital_outputs": True})
    can = shipped.can.model_copy(update={"driver": driver, "sense_deadline_us": 8000, "heartbeat_deadline_us": 9900})
    bus = shipped.model_copy(update={"period_us": 10_000, "can": can})
    node = FollowedNode("lely_check.log", FROM_THE_NODE | {REPLY})
    talker = Talker(clock, RecordedPort(node, clock), bus, read_eds(EDS, 10), allow_voltage=True)
    others = tuple(check for check in (*process.CHECKS, *outputs.CHECKS) if f"{check.group}: {check.name}" in OF_LELY)
    checks = (objects.ANSWERS, *objects.CHECKS, *network.CHECKS[:5], *others)
    lines = {f"{line.group}: {line.name}": line for line in conformance(talker, checks)}
    assert node.misses == 0
    assert list(lines)[-len(OF_LELY) :] == list(OF_LELY)
    assert len(lines) == 22 + len(OF_LELY)
    for name, line in lines.items():
        verdict, words = OF_LELY.get(name, (Verdict.PASS, ""))
        assert line.verdict is verdict, line
        assert words in line.got


def test_heartbeats_of_a_system_with_coarse_timers_are_regular_and_those_that_are_slow_or_missing_are_not():
    """lely's, pre-operational, at 0x1017 = 20: 15 to 24 ms apart, and all together they are 6 % slow."""
    beats = [t_us for t_us, frame in frames_of("lely_check.log") if frame.can_id == 0x70A and frame.data == b"\x7f"]
    steady = beats[29:38]
    assert "ms apart" in network.period_told(steady)
    assert max(b - a for a, b in pairwise(steady)) > 22_000  # which was said to be too late
    for wrong in ([round(1.2 * t) for t in steady], [round(0.8 * t) for t in steady], steady[:4] + steady[6:]):
        with pytest.raises(DeviationError, match="heartbeats"):
            network.period_told(wrong)


def test_frames_are_read_as_candump_writes_them():
    first_us, first = frames_of("canopenlinux_master.log")[0]
    assert first_us == 0
    assert isinstance(first, Frame)
