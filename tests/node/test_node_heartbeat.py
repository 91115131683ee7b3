"""Heartbeats of the amplifier node, both ways: its own, and what it does when the controller's stays away."""

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from node_rig import CONTROLLER, EMCY, HEARTBEAT, SENSE, START, Rig, assert_only_zero_energises, master

from hil.node.amplifier import BOOT_US, NmtState
from pkxyz_ctrl.can.frame import Frame

PRE, OPERATIONAL, STOPPED = NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL, NmtState.STOPPED


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
@settings(max_examples=40)
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
@settings(max_examples=30)
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


def test_the_alarms_of_its_work_are_those_that_a_quiet_cycle_puts_off() -> None:
    """Drive PDO, its own heartbeat, the controller's: whoever does the cycle in the node's place moves all three."""
    rig = watched()
    assert rig.write(0x1017, 0, 1, 2) == 0
    rig.energise()
    rig.give(CONTROLLER, b"\x05")
    before = [alarm.due_us or 0 for alarm in rig.node.work_alarms]
    for _ in range(10):
        rig.cycle((100, 200, 300))
    rig.give(CONTROLLER, b"\x05")
    after = [alarm.due_us or 0 for alarm in rig.node.work_alarms]
    assert [b - a >= 1_000 for a, b in zip(before, after, strict=True)] == [True, True, True]
