"""What the node does beside its combs: digital outputs, its signature, and what a change of state forgets."""

import pytest
from node_rig import DRIVE, EMCY, SYNC, Rig, emergencies, operational, protected

from hil.node.amplifier import NmtState
from hil.node.signature import signature

SIGNATURE, OUTPUT = 0x38A, 0x20A
SYNC_DATA = 0x8240


def signing(every: int) -> Rig:
    """A node in pre-operational that is to send its signature at every so many SYNCs."""
    rig = Rig()
    for subindex, value, length in ((1, 0xC000_0000 | SIGNATURE, 4), (2, every, 1), (1, 0x4000_0000 | SIGNATURE, 4)):
        assert rig.write(0x1802, subindex, value, length) == 0
    return rig


def signed_at(rig: Rig, cycles: int) -> list[int]:
    """The cycles in which the signature came."""
    found = []
    for cycle in range(1, cycles + 1):
        rig.forget()
        rig.cycle((0, 0, 0))
        if rig.of(SIGNATURE):
            assert rig.of(SIGNATURE) == [signature(rig.node.od).to_bytes(2, "little")]
            found.append(cycle)
    return found


def test_the_signature_comes_at_every_so_many_syncs_counted_from_the_start() -> None:
    rig = signing(3)
    rig.start()
    assert signed_at(rig, 10) == [3, 6, 9]
    rig.nmt(128)
    rig.start()
    assert signed_at(rig, 4) == [3]


def test_the_signature_that_is_read_is_that_of_what_it_holds_now() -> None:
    rig = Rig()
    before = rig.read(0x2020, 1)
    assert before == signature(rig.node.od)
    rig.write(0x2011, 0, 77, 2)
    assert rig.read(0x2020, 1) == signature(rig.node.od) != before


def test_outputs_are_written_by_sdo_while_operational_and_not_before() -> None:
    rig = Rig()
    rig.write(0x6200, 1, 5, 1)
    assert rig.node.digital.bits == 0
    rig.start()
    assert rig.write(0x6200, 1, 6, 1) == 0
    assert rig.node.digital.bits == 6


def with_outputs() -> Rig:
    """At work, its RPDO 1 in use, 5 at the terminals."""
    rig = Rig()
    for cob_id in (0x8000_0000 | OUTPUT, OUTPUT):
        assert rig.write(0x1400, 1, cob_id, 4) == 0
    rig.start()
    rig.give(OUTPUT, b"\5")
    assert rig.node.digital.bits == 0
    rig.sync()
    assert rig.node.digital.bits == 5
    return rig


def test_outputs_that_came_are_put_out_at_the_sync_while_operational() -> None:
    rig = with_outputs()
    rig.nmt(128)
    assert rig.node.digital.bits == 0, "their error value"
    rig.give(OUTPUT, b"\7")
    rig.start()
    rig.sync()
    assert rig.node.digital.bits == 0


def test_a_fault_takes_the_outputs_to_their_error_value() -> None:
    rig = with_outputs()
    rig.node.amplifier_fault(0x2310)
    assert rig.node.digital.bits == 0


def test_outside_of_operational_no_drive_frame_is_missed() -> None:
    rig = Rig()
    rig.energise()
    rig.nmt(128)
    rig.forget()
    rig.run(100_000)
    assert emergencies(rig) == []


def test_a_reset_forgets_what_was_wrong_with_a_drive_frame() -> None:
    rig = operational()
    rig.give(DRIVE, bytes(8))
    assert emergencies(rig) != []
    rig.nmt(129)
    rig.run(10_000)
    rig.forget()
    rig.start()
    rig.give(DRIVE, bytes(8))
    assert emergencies(rig) != [], "it is a new one"


def test_the_history_of_errors_is_cleared_by_writing_0() -> None:
    rig = operational()
    rig.give(SYNC, b"\1\2\3")
    assert rig.read(0x1003, 0) == 1
    assert rig.write(0x1003, 0, 0, 1) == 0
    assert rig.read(0x1003, 0) == 0


@pytest.mark.parametrize(("kind", "waits"), [(1, True), (240, True), (254, False), (255, False)])
def test_up_to_240_a_drive_frame_waits_for_the_sync(kind: int, waits: bool) -> None:
    rig = Rig()
    assert rig.write(0x1401, 2, kind, 1) == 0
    rig.start()
    rig.forget()
    rig.give(DRIVE, protected(DRIVE, (5, 6, 7), 0))
    assert rig.node.outputs == ((0, 0, 0) if waits else (5, 6, 7))
    assert rig.plant.sampled_us == []
    rig.sync()
    assert rig.node.outputs == (5, 6, 7)


def test_only_a_sync_samples() -> None:
    """What puts the outputs elsewhere doesn't."""
    rig = Rig()
    rig.energise()
    rig.forget()
    rig.nmt(128)
    rig.node.amplifier_fault(0x2310)
    assert rig.plant.driven
    assert rig.plant.sampled_us == []


def test_after_a_change_of_state_the_counter_of_syncs_may_be_any() -> None:
    rig = operational()
    rig.give(SYNC, b"\x07")
    rig.nmt(128)
    rig.start()
    rig.give(SYNC, b"\x17")
    assert emergencies(rig) == []
    rig.give(SYNC, b"\x27")
    assert emergencies(rig) != []


def test_an_error_of_the_sync_ends_with_good_ones() -> None:
    rig = operational()
    rig.give(SYNC, b"\1\2\3")
    assert rig.node.emergency.active
    for _ in range(20_000):
        rig.cycle((0, 0, 0))
        if not rig.node.emergency.active:
            break
    assert not rig.node.emergency.active
    assert rig.of(EMCY)[-1][:2] == b"\0\0"


def test_while_it_boots_it_misses_nobody_and_remembers_no_error() -> None:
    rig = Rig()
    rig.write(0x1016, 1, 0x7F_0001, 4)  # our heartbeat, 1 ms: shorter than the reset takes
    rig.start()
    rig.give(0x77F, b"\5")
    rig.give(SYNC, b"\1\2\3")
    rig.forget()
    rig.nmt(129)
    rig.run(10_000)
    assert emergencies(rig) == []
    assert rig.node.state is NmtState.PRE_OPERATIONAL
    rig.start()
    rig.give(SYNC, b"\1\2\3")
    assert emergencies(rig) != [], "it is a new one"
