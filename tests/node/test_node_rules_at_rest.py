"""The compiled rules of a node in pre-operational beside the node, those of its digital outputs, and its signature."""

import pytest
from node_rig import CONTROLLER, DRIVE, NMT, REQUEST, SYNC, Rig, protected
from test_node_rules import at_work, synced

from hil.node import rules
from hil.node.amplifier import NmtState
from hil.whole_ticks.node_at_work import NodeAtWork
from pkxyz_ctrl.can.driver import word_of

CONSUMER = 0x1016, 1, 0x7F_0032, 4  # the controller's heartbeat, 50 ms
HEARTBEAT_PERIOD = 0x1017, 0, 20, 2
OVERFLOW = 0x1019, 0
OUTPUT = 0x20A  # RPDO 1


def at_rest(overflow: int = 240, heard: bool = False) -> Rig:
    """A node in pre-operational, its SYNCs counted to ``overflow``, with the controller's heartbeat ``heard``."""
    rig = Rig()
    assert rig.write(*CONSUMER) == rig.write(*HEARTBEAT_PERIOD) == rig.write(*OVERFLOW, overflow, 1) == 0
    if heard:
        rig.give(CONTROLLER, b"\x05")
    rig.run(1_000)
    rig.forget()
    return rig


def of(rig: Rig) -> tuple[object, ...]:
    """All that a frame at rest may change."""
    node = rig.node
    return node.state, node._sync_expected, [alarm.due_us for alarm in node.work_alarms], rig.sent, rig.plant.driven


@pytest.mark.parametrize(
    ("before", "cob_id", "data", "taken"),
    [
        ((), SYNC, b"\x01", True),
        ((), SYNC, b"\xf0", True),
        ((), SYNC, b"\x00", False),
        ((), SYNC, b"\xf1", False),
        ((), SYNC, b"", False),
        ((), SYNC, b"\x01\x00", False),
        ((b"\x07",), SYNC, b"\x08", True),
        ((b"\x07",), SYNC, b"\x07", False),
        ((b"\x07",), SYNC, b"\x09", False),
        ((b"\xef",), SYNC, b"\xf0", True),
        ((b"\xf0",), SYNC, b"\x01", True),
        ((b"\xf0",), SYNC, b"\x02", False),
        ((), NMT, b"\x80\x0a", True),
        ((), NMT, b"\x80\x0b", True),  # to another node
        ((), NMT, b"\x80", False),
        ((), NMT, b"\x80\x0a\x00", False),
        ((), NMT, b"\x01\x0a", False),
        ((), DRIVE, protected(DRIVE, (1, 2, 3), 4), True),
        ((), OUTPUT, b"\x01", True),
        ((), REQUEST, bytes((0x40, 0x00, 0x10, 0, 0, 0, 0, 0)), False),
        ((), 0x123, b"\x80\x0a", False),
    ],
)
@pytest.mark.parametrize("heard", [False, True])
def test_what_a_rule_takes_at_rest_the_node_would_do_just_so(
    before: tuple[bytes, ...], cob_id: int, data: bytes, taken: bool, heard: bool
) -> None:
    ruled, shipped = at_rest(heard=heard), at_rest(heard=heard)
    for rig in (ruled, shipped):
        for sync in before:
            rig.give(SYNC, sync)
    assert by_rule(ruled, cob_id, data) is taken
    shipped.give(cob_id, data)
    if taken:
        assert of(ruled) == of(shipped)


def by_rule(rig: Rig, cob_id: int, data: bytes) -> bool:
    """Whether the rule takes it; if not, it has left everything as it was."""
    work = NodeAtWork(rig.node)
    assert work.take_at_rest() == NmtState.PRE_OPERATIONAL
    work.record["output_id"] = OUTPUT
    before = work.memory.tobytes()
    taken = rules.on_frame_at_rest(work.record[0], work.memory[0], cob_id, len(data), word_of(data), rig.now_us)
    assert taken or work.memory.tobytes() == before
    work.put_at_rest()
    return bool(taken)


@pytest.mark.parametrize(("data", "taken"), [(b"", True), (b"\x01", False), (b"\x00", False)])
def test_syncs_that_are_not_counted_are_empty(data: bytes, taken: bool) -> None:
    for before in ((), (b"",)):
        ruled, shipped = at_rest(overflow=0), at_rest(overflow=0)
        for rig in (ruled, shipped):
            for sync in before:
                rig.give(SYNC, sync)
        assert by_rule(ruled, SYNC, data) is taken
        shipped.give(SYNC, data)
        assert not taken or of(ruled) == of(shipped)


def test_one_sync_after_the_other_is_taken() -> None:
    for overflow, syncs in ((0, (b"", b"", b"")), (240, (b"\xef", b"\xf0", b"\x01"))):
        rig = at_rest(overflow=overflow)
        work = NodeAtWork(rig.node)
        work.take_at_rest()
        for data in syncs:
            taken = rules.on_frame_at_rest(work.record[0], work.memory[0], SYNC, len(data), word_of(data), rig.now_us)
            assert taken is True


def test_states_are_those_of_the_heartbeat() -> None:
    """A node is at work, or deaf, by the number of its state."""
    assert (rules.DEAF, rules.OPERATIONAL) == (NmtState.INITIALISING, NmtState.OPERATIONAL)


@pytest.mark.parametrize(
    ("heard", "data", "taken"),
    [
        (True, b"\x05", True),
        (True, b"\x7f", True),
        (True, b"\x80", True),
        (True, b"\x00", False),  # it has restarted
        (True, b"", False),
        (True, b"\x05\x00", False),
        (False, b"\x05", False),  # nobody waited for it: it may end a loss
    ],
)
def test_the_controllers_heartbeat_at_rest(heard: bool, data: bytes, taken: bool) -> None:
    ruled, shipped = at_rest(heard=heard), at_rest(heard=heard)
    assert by_rule(ruled, CONTROLLER, data) is taken
    shipped.give(CONTROLLER, data)
    assert not taken or of(ruled) == of(shipped)


@pytest.mark.parametrize(("length", "taken"), [(0, False), (1, True), (2, False)])
@pytest.mark.parametrize("bits", [0, 1, 0x1F, 0xFF])
def test_a_frame_with_digital_outputs_waits_for_the_sync(length: int, taken: bool, bits: int) -> None:
    work = at_work(digital=3, digital_pending=-1)
    behind = 0x7700  # of a longer frame; a rule looks at the first byte alone
    assert rules.on_digital(work.memory[0], length, behind | bits) == taken
    assert work.memory["digital_pending"][0] == (bits if taken else -1)
    assert work.memory["digital"][0] == 3
    assert synced(work)
    assert (work.memory["digital"][0], work.memory["digital_pending"][0]) == (bits if taken else 3, -1)


@pytest.mark.parametrize(("left", "after", "waits"), [(0, 0, 0), (1, 240, 1), (2, 1, 0), (9, 8, 0)])
def test_a_sync_counts_towards_the_signature_and_with_the_last_it_is_due(left: int, after: int, waits: int) -> None:
    """0: none is ever due."""
    work = at_work(signature_left=left, signature_waits=0)
    work.record["signature_every"] = 240
    assert synced(work)
    assert (work.memory["signature_left"][0], work.memory["signature_waits"][0]) == (after, waits)
