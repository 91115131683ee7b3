"""NMT, boot-up, heartbeats both ways and emergencies of the amplifier node."""

from collections.abc import Callable
from itertools import pairwise

import canopen
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from node_rig import CONTROLLER, DRIVE, EMCY, HEARTBEAT, NODE_ID, REPLY, REQUEST, SENSE, Rig, master, protected

from hil.node.amplifier import BOOT_US, NmtState
from pkxyz_ctrl.can.frame import Frame

START, STOP, PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130
INITIALISING = NmtState.INITIALISING
COMMAND_OF = {NmtState.STOPPED: STOP, NmtState.OPERATIONAL: START, NmtState.PRE_OPERATIONAL: PRE_OPERATIONAL}


def in_state(state: NmtState, **options: bool) -> Rig:
    rig = Rig(booted=state is not INITIALISING, **options)
    if state is not INITIALISING:
        rig.nmt(COMMAND_OF[state])
    assert rig.node.state is state
    rig.forget()
    return rig


@pytest.mark.parametrize("fd", [False, True])
def test_boot_up_message(fd: bool) -> None:
    rig = Rig(fd=fd, booted=False)
    rig.run(BOOT_US - 1)
    assert (rig.sent, rig.node.state) == ([], INITIALISING)
    rig.run(1)
    assert rig.sent == [(BOOT_US, Frame(0x70A, b"\x00", fd, fd))]
    assert rig.node.state is NmtState.PRE_OPERATIONAL
    rig.run(1_000_000)
    assert len(rig.sent) == 1


def test_power_on_puts_the_combs_at_zero() -> None:
    assert Rig(booted=False).plant.driven[-1] == (0, (0, 0, 0))


@pytest.mark.parametrize("node_id", [0, NODE_ID, NODE_ID + 1, 255])
@pytest.mark.parametrize("state", NmtState)
@pytest.mark.parametrize(
    ("command", "target"),
    [
        (START, NmtState.OPERATIONAL),
        (STOP, NmtState.STOPPED),
        (PRE_OPERATIONAL, NmtState.PRE_OPERATIONAL),
        (RESET_NODE, INITIALISING),
        (RESET_COMMUNICATION, INITIALISING),
        *((command, None) for command in (0, 3, 80, 96, 127, 131, 255)),
    ],
)
def test_every_command_in_every_state(state: NmtState, command: int, target: NmtState | None, node_id: int) -> None:
    rig = in_state(state)
    rig.nmt(command, node_id)
    heeded = target is not None and node_id in (0, NODE_ID) and state is not INITIALISING
    assert rig.node.state is (target if heeded else state)
    rig.run(BOOT_US)
    booted = heeded and target is INITIALISING
    assert rig.of(HEARTBEAT) == ([b"\0"] if booted or state is INITIALISING else [])


@pytest.mark.parametrize("data", [b"", b"\x01", b"\x01\x0a\x00"])
def test_nmt_commands_of_another_length_are_none(data: bytes) -> None:
    rig = in_state(NmtState.PRE_OPERATIONAL)
    rig.give(0x000, data)
    assert rig.node.state is NmtState.PRE_OPERATIONAL


def _sdo(rig: Rig) -> bool:
    rig.give(REQUEST, bytes.fromhex("4000100000000000"))
    return bool(rig.of(REPLY))


def _sense_pdo(rig: Rig) -> bool:
    rig.sync()
    rig.run(100)
    return bool(rig.of(SENSE))


def _drive_pdo(rig: Rig) -> bool:
    rig.drive((5, 6, 7))
    rig.sync()
    return (rig.now_us, (5, 6, 7)) in rig.plant.driven


def _heartbeat_heard(rig: Rig) -> bool:
    rig.node.od.install(0x1016, 1, 127 << 16 | 30)
    rig.node._configure(0x1016)
    rig.give(CONTROLLER, b"\x05")
    rig.run(30_000)
    return 0x8130 in rig.node.emergency.active


def _heartbeat_sent(rig: Rig) -> bool:
    state = rig.node.state
    rig.node.od[0x1017, 0] = 1
    rig.node._configure(0x1017)
    return rig.of(HEARTBEAT) == [bytes((state,))]


def _emergency(rig: Rig) -> bool:
    rig.node.amplifier_fault(0x2310)
    return bool(rig.of(EMCY))


PRE, OPERATIONAL, STOPPED = NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL, NmtState.STOPPED


@pytest.mark.parametrize("state", [PRE, OPERATIONAL, STOPPED])
@pytest.mark.parametrize(
    ("service", "where"),
    [
        (_sdo, {PRE, OPERATIONAL}),
        (_sense_pdo, {OPERATIONAL}),
        (_drive_pdo, {OPERATIONAL}),
        (_emergency, {PRE, OPERATIONAL}),
        (_heartbeat_heard, {PRE, OPERATIONAL, STOPPED}),
        (_heartbeat_sent, {PRE, OPERATIONAL, STOPPED}),
    ],
)
def test_services_by_state(service: Callable[[Rig], bool], where: set[NmtState], state: NmtState) -> None:
    """CiA 301, table 36."""
    assert service(in_state(state)) == (state in where)


@pytest.mark.parametrize("cob_id", [0x000, 0x080, DRIVE, REQUEST, CONTROLLER])
def test_nothing_is_heard_while_it_boots(cob_id: int) -> None:
    rig = in_state(INITIALISING)
    data = {0x000: b"\x01\x0a", 0x080: b"\x01", DRIVE: protected(DRIVE, (1, 2, 3), 0), CONTROLLER: b"\x05"}
    rig.give(cob_id, data.get(cob_id, bytes.fromhex("4000100000000000")))
    assert (rig.sent, rig.plant.driven, rig.node.state) == ([], [], INITIALISING)


@pytest.mark.parametrize("field", ["is_remote", "is_extended", "is_error"])
@pytest.mark.parametrize("cob_id", [0x000, 0x080, DRIVE, REQUEST])
def test_remote_extended_and_error_frames_are_ignored(cob_id: int, field: str) -> None:
    rig = in_state(OPERATIONAL)
    flags = [name == field for name in ("is_remote", "is_extended", "is_error")]
    rig.node.on_frame(Frame(cob_id, b"\x02\x0a" + bytes(6), False, False, *flags), rig.now_us)
    rig.run(1000)
    assert (rig.sent, rig.plant.driven, rig.node.state) == ([], [], OPERATIONAL)
    assert rig.node.emergency.active == ()


@pytest.mark.parametrize("command", [STOP, PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION])
@pytest.mark.parametrize("after_us", [0, 1, 99])
def test_leaving_operational_takes_the_combs_to_zero_at_once(command: int, after_us: int) -> None:
    rig = Rig()
    rig.energise()
    rig.drive((400, 500, 600))  # pending: must never be applied
    rig.run(after_us)
    rig.nmt(command)
    assert rig.plant.driven[-1] == (rig.now_us, (0, 0, 0))
    rig.run(10_000)
    rig.start()
    rig.cycle()
    assert rig.plant.driven[-1][1] == (0, 0, 0)


def test_what_each_reset_brings_back() -> None:
    rig = Rig()
    assert rig.write(0x1017, 0, 50, 2) == rig.write(0x6444, 1, 77, 4) == 0
    rig.nmt(RESET_COMMUNICATION)
    rig.run(10_000)
    assert (rig.read(0x1017, 0), rig.read(0x6444, 1)) == (0, 77)
    rig.nmt(RESET_NODE)
    rig.run(10_000)
    assert (rig.read(0x1017, 0), rig.read(0x6444, 1)) == (0, 0)


def test_a_reset_during_the_turnaround_keeps_the_sense_pdo_back() -> None:
    rig = in_state(OPERATIONAL)
    rig.sync()
    rig.run(3)
    rig.nmt(PRE_OPERATIONAL)
    rig.nmt(START)
    rig.run(100)
    assert rig.of(SENSE) == []


# -- heartbeats ------------------------------------------------------------------------------------------------------


def test_heartbeat_starts_at_once_and_keeps_its_period() -> None:
    rig = Rig()
    rig.write(0x1017, 0, 20, 2)
    t_us = rig.now_us
    rig.run(50_000)
    rig.start()
    rig.run(30_000)
    assert rig.times(HEARTBEAT) == [t_us + 20_000 * k for k in range(5)]
    assert rig.of(HEARTBEAT) == [b"\x7f"] * 3 + [b"\x05"] * 2
    rig.write(0x1017, 0, 0, 2)
    rig.forget()
    rig.run(100_000)
    assert rig.sent == []


@given(period_us=st.integers(150, 3000), producer_ms=st.integers(1, 12))
@settings(max_examples=40, deadline=None)
def test_heartbeat_rides_behind_the_sense_pdo_and_is_never_late(period_us: int, producer_ms: int) -> None:
    rig = Rig()
    rig.start()
    for _ in range(5):
        rig.cycle(period_us=period_us)
    rig.write(0x1017, 0, producer_ms, 2)
    rig.cycle(period_us=period_us)
    rig.forget()
    for _ in range(2 + 40_000 // period_us):
        rig.cycle(period_us=period_us)
    beats = rig.times(HEARTBEAT)
    assert all(b - a <= 1000 * producer_ms for a, b in pairwise(beats))
    assert len(beats) >= 40 // producer_ms
    if period_us <= 1000 * producer_ms:
        assert set(beats) <= set(rig.times(SENSE))
        assert min(b - a for a, b in pairwise(beats)) >= 1000 * producer_ms - period_us
        order = [frame.can_id for t_us, frame in rig.sent if t_us == beats[0]]
        assert order == [SENSE, HEARTBEAT]


def test_canopen_sees_the_states() -> None:
    rig = Rig()
    network, node = master(rig)
    node.sdo[0x1017].raw = 10
    for state in ("OPERATIONAL", "STOPPED", "PRE-OPERATIONAL"):
        node.nmt.state = state
        node.nmt._state = 0
        network.run(11_000)
        assert node.nmt.state == state
    booted: list[int] = []
    node.nmt.add_heartbeat_callback(booted.append)
    node.nmt.state = "RESET"
    network.run(BOOT_US)
    assert booted == [0]
    assert node.nmt.state == "PRE-OPERATIONAL"


CONSUMER_MS = 30


def watched(behaviour: int = 0) -> Rig:
    rig = Rig()
    assert rig.write(0x1016, 1, 127 << 16 | CONSUMER_MS, 4) == 0
    assert rig.write(0x1029, 1, behaviour, 1) == 0
    assert rig.write(0x2012, 0, 65535, 2) == 0  # the time-out of the drive PDO, which would be first
    return rig


def test_consumer_starts_with_the_first_heartbeat() -> None:
    rig = watched()
    rig.energise()
    rig.run(900_000)
    assert rig.node.outputs == (100, 200, 300)


def assert_only_zero_energises(rig: Rig, counts: tuple[int, int, int]) -> None:
    """Combs that the node has released by itself get a voltage again only after a frame with 0 V."""
    rig.cycle(counts)
    rig.sync()
    assert rig.node.outputs == (0, 0, 0)
    rig.cycle((0, 0, 0))
    rig.cycle(counts)
    rig.sync()
    assert rig.node.outputs == counts


@pytest.mark.parametrize(("behaviour", "state"), [(0, PRE), (1, OPERATIONAL), (2, STOPPED)])
def test_controller_lost(behaviour: int, state: NmtState) -> None:
    rig = watched(behaviour)
    rig.energise()
    rig.give(CONTROLLER, b"\x05")
    t_us = rig.now_us
    rig.forget()
    rig.run(1000 * CONSUMER_MS - 1)
    assert (rig.sent, rig.plant.driven, rig.node.outputs) == ([], [], (100, 200, 300))
    rig.run(1)
    assert set(rig.plant.driven) == {(t_us + 1000 * CONSUMER_MS, (0, 0, 0))}
    assert rig.sent == [(rig.now_us, Frame(EMCY, bytes.fromhex("3081110000000000")))]
    assert rig.node.state is state
    rig.start()
    rig.cycle((1, 2, 3))
    rig.sync()
    assert rig.node.outputs == (0, 0, 0), "held until the controller is heard again"
    rig.give(CONTROLLER, b"\x05")
    rig.nmt(START)
    rig.run(2000)  # the inhibit time
    assert rig.of(EMCY) == [bytes.fromhex("3081110000000000"), bytes(8)]
    assert_only_zero_energises(rig, (1, 2, 3))


@given(gaps_us=st.lists(st.integers(1, 1000 * CONSUMER_MS - 1), min_size=1, max_size=20))
@settings(max_examples=30, deadline=None)
def test_consumer_counts_from_the_last_heartbeat(gaps_us: list[int]) -> None:
    rig = watched()
    rig.energise()
    rig.give(CONTROLLER, b"\x05")
    for gap_us in gaps_us:
        rig.run(gap_us)
        rig.give(CONTROLLER, b"\x05")
    last_us = rig.now_us
    rig.forget()
    rig.run(2_000 * CONSUMER_MS)
    assert rig.plant.driven[0] == (last_us + 1000 * CONSUMER_MS, (0, 0, 0))


def test_restart_of_the_controller_is_a_loss() -> None:
    rig = watched()
    rig.give(CONTROLLER, b"\x00")
    assert rig.node.emergency.active == ()  # not watched yet
    rig.energise()
    rig.give(CONTROLLER, b"\x05")
    rig.give(CONTROLLER, b"\x00")
    assert rig.node.state is PRE
    assert rig.plant.driven[-1] == (rig.now_us, (0, 0, 0))


def test_rewriting_the_consumer_time_ends_the_watch() -> None:
    rig = watched()
    rig.give(CONTROLLER, b"\x05")
    assert rig.write(0x1016, 1, 127 << 16 | 10, 4) == 0
    rig.energise()
    rig.run(1_000_000)
    assert rig.node.outputs == (100, 200, 300)
    rig.give(CONTROLLER, b"\x05")
    rig.run(10_000)
    assert rig.node.outputs == (0, 0, 0)


# -- emergencies -----------------------------------------------------------------------------------------------------


def test_amplifier_fault_holds_the_combs_until_it_is_cleared() -> None:
    rig = Rig()
    rig.energise()
    rig.run(37)
    rig.node.amplifier_fault(0x2310)
    assert rig.plant.driven[-1] == (rig.now_us, (0, 0, 0))
    for _ in range(3):
        rig.cycle((9, 9, 9))
    assert rig.node.outputs == (0, 0, 0)
    assert rig.node.state is OPERATIONAL
    rig.node.clear_amplifier_fault(0x2310)
    assert_only_zero_energises(rig, (9, 9, 9))


def test_reset_communication_keeps_an_amplifier_fault_and_reset_node_does_not() -> None:
    rig = Rig()
    rig.node.amplifier_fault(0x4210)
    rig.nmt(RESET_COMMUNICATION)
    rig.run(10_000)
    assert rig.node.emergency.active == (0x4210,)
    assert rig.read(0x1001, 0) == 0x09
    rig.nmt(RESET_NODE)
    rig.run(10_000)
    assert not rig.node.emergency.active
    assert rig.read(0x1001, 0) == rig.read(0x1003, 0) == 0


def test_canopen_reads_the_emergencies() -> None:
    rig = Rig()
    network, node = master(rig)
    for code in (0x2310, 0x3210, 0x4210):
        rig.node.amplifier_fault(code)
    network.run(10_000)
    rig.node.clear_amplifier_fault(0x3210)
    network.run(10_000)
    assert [(e.code, e.register) for e in node.emcy.log] == [(0x2310, 3), (0x3210, 7), (0x4210, 15), (0, 11)]
    assert node.emcy.log[-1].data[:2] == (0x4210).to_bytes(2, "little")
    assert node.sdo[0x1003][0].raw == 3
    assert [node.sdo[0x1003][i].raw for i in (1, 2, 3)] == [0x4210, 0x3210, 0x2310]
    with pytest.raises(canopen.SdoAbortedError, match="08000024"):
        node.sdo[0x1003][4].raw  # noqa: B018
    node.sdo[0x1003][0].raw = 0
    assert node.sdo[0x1003][0].raw == 0
    with pytest.raises(canopen.SdoAbortedError, match="08000024"):
        node.sdo[0x1003][1].raw  # noqa: B018


def test_history_keeps_the_newest_eight() -> None:
    rig = Rig()
    for code in range(0x2301, 0x230B):
        rig.node.amplifier_fault(code)
    assert [rig.node.od[0x1003, i] for i in range(9)] == [8, *range(0x230A, 0x2302, -1)]


def test_inhibit_time_spaces_the_emergencies() -> None:
    rig = Rig()
    rig.write(0x1015, 0, 25, 2)
    t_us = rig.now_us
    for code in (0x2310, 0x3210, 0x4210):
        rig.node.amplifier_fault(code)
    rig.run(20_000)
    assert rig.times(EMCY) == [t_us, t_us + 2500, t_us + 5000]


def test_emergencies_wait_while_stopped_and_can_be_switched_off() -> None:
    rig = in_state(STOPPED)
    rig.node.amplifier_fault(0x2310)
    rig.run(10_000)
    assert rig.sent == []
    rig.nmt(PRE_OPERATIONAL)
    assert rig.of(EMCY) == [bytes.fromhex("1023030000000000")]
    rig.write(0x1014, 0, 0x8000008A, 4)
    rig.run(10_000)
    rig.forget()
    rig.node.amplifier_fault(0x3210)
    rig.run(10_000)
    assert rig.sent == []
    assert rig.read(0x1001, 0) == 7
