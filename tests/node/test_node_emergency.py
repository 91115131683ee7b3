"""Emergencies of the amplifier node: what they hold, how they are spaced, and what remembers them."""

import canopen
import pytest
from node_rig import (
    DRIVE,
    EMCY,
    PRE_OPERATIONAL,
    Rig,
    assert_only_zero_energises,
    in_state,
    master,
    protected,
)

from hil.node.amplifier import NmtState

RESET_NODE, RESET_COMMUNICATION = 129, 130
OPERATIONAL, STOPPED = NmtState.OPERATIONAL, NmtState.STOPPED


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


@pytest.mark.parametrize("mapped", [False, True])
@pytest.mark.parametrize(
    ("data", "info"),
    [
        (protected(DRIVE, (1, 2, 3), 6)[:7], bytes((7, 8))),
        (protected(DRIVE, (1, 2, 3), 6) + b"\0", bytes((9, 8))),
        (protected(DRIVE, (1, 2, 0x1234), 6)[:7] + b"\x55", bytes((0, 0x34, 0x12, 6, 0x55))),
        (protected(DRIVE, (1, 2, 3), 9), bytes((5, 9))),
        (protected(DRIVE, (-1, 32767, 3), 6), bytes((1,))),
        (protected(DRIVE, (32767, -1, -32768), 6), bytes((6,))),
        (protected(DRIVE, (1, 2, 3), 6), bytes((6,))),
    ],
)
def test_an_emergency_says_what_was_wrong(mapped: bool, data: bytes, info: bytes) -> None:
    """Length and the one expected; the frame's end; last counter and this one; the combs, a bit each; the counter."""
    rig = Rig()
    if mapped:  # by the general way, which any other mapping takes
        rig.node._drive.receive = rig.node._drive._receive_mapped
    rig.start()
    rig.give(DRIVE, protected(DRIVE, (0, 0, 0), 5))
    rig.sync()
    rig.sync()  # for which nothing came: the next frame is late, if nothing else is wrong with it
    rig.run(10_000)
    rig.forget()
    rig.give(DRIVE, data)
    rig.run(1000)
    assert [frame[3:] for frame in rig.of(EMCY)] == [info.ljust(5, b"\0")]


def test_an_emergency_of_a_late_frame_says_its_counter_0_too() -> None:
    rig = Rig()
    rig.start()
    rig.give(DRIVE, protected(DRIVE, (0, 0, 0), 255))
    rig.sync()
    rig.sync()
    rig.forget()
    rig.give(DRIVE, protected(DRIVE, (1, 2, 3), 0))
    rig.run(10_000)
    assert [frame[3:] for frame in rig.of(EMCY)] == [bytes(5)]
