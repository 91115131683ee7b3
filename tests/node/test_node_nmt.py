"""NMT and boot-up of the amplifier node: what it does and answers in which state."""

from collections.abc import Callable

import pytest
from node_rig import (
    CONTROLLER,
    DRIVE,
    EMCY,
    HEARTBEAT,
    NODE_ID,
    PRE_OPERATIONAL,
    REPLY,
    REQUEST,
    SENSE,
    START,
    STOP,
    Rig,
    in_state,
    protected,
)

from hil.node.amplifier import BOOT_US, NmtState
from pkxyz_ctrl.can.frame import Frame

RESET_NODE, RESET_COMMUNICATION = 129, 130
INITIALISING = NmtState.INITIALISING


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
