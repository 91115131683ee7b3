"""What a reset, a boot and a written object make the amplifier node forget, and what it keeps.

Reset communication is for the objects from 0x1000 to 0x1FFF, reset node for all (CiA 301, 7.3.2.2.1).
"""

import pytest
from node_rig import (
    CONTROLLER,
    DRIVE,
    EDS,
    EMCY,
    HEARTBEAT,
    NODE_ID,
    PRE_OPERATIONAL,
    REPLY,
    REQUEST,
    SENSE,
    START,
    STOP,
    SYNC,
    Rig,
    assert_only_zero_energises,
    emergencies,
    operational,
    protected,
)

from hil.node.amplifier import BOOT_US, NmtState
from hil.node.object_dictionary import ObjectDictionary
from hil.node.signature import signature

RESET_NODE, RESET_COMMUNICATION = 129, 130
ZERO = (0, 0, 0)
FAULT, LOST = 0x2310, 0x8130
OUT_OF_USE = 1 << 31
WRITTEN = (
    (0x1005, 0, 0x81, 4), (0x1014, 0, OUT_OF_USE | 0x8A, 4), (0x1015, 0, 77, 2), (0x1016, 1, 126 << 16 | 30, 4),
    (0x1017, 0, 20, 2), (0x1019, 0, 10, 1), (0x1029, 1, 2, 1), (0x1400, 1, OUT_OF_USE | 0x20A, 4),
    (0x1401, 1, OUT_OF_USE | 0x30A, 4), (0x1401, 2, 254, 1), (0x1601, 0, 0, 1), (0x1601, 1, 0x64110310, 4),
    (0x1801, 1, OUT_OF_USE | 0x4000028A, 4), (0x1801, 5, 9, 2), (0x1A01, 0, 0, 1), (0x1A01, 2, 0x64010310, 4),
    (0x2010, 0, 9, 1), (0x2011, 0, 50, 2), (0x2012, 0, 7, 2), (0x6206, 1, 0x0F, 1), (0x6207, 1, 3, 1),
    (0x6443, 2, 0, 1), (0x6444, 3, 88, 4),
)  # fmt: skip
"""Index, sub-index, a value that is not the default, and its length."""


def reset(rig: Rig, command: int) -> None:
    """Reset, boot, and back to what is heard from then on."""
    rig.nmt(command)
    rig.run(10_000)
    assert rig.node.state is NmtState.PRE_OPERATIONAL
    rig.forget()


@pytest.mark.parametrize(("command", "last"), [(RESET_COMMUNICATION, 0x1FFF), (RESET_NODE, 0xFFFF)])
def test_which_objects_are_at_their_defaults_again(command: int, last: int) -> None:
    shipped, rig = ObjectDictionary.from_eds(EDS, NODE_ID), Rig()
    for index, subindex, value, length in WRITTEN:
        assert shipped[index, subindex] != value
        assert rig.write(index, subindex, value, length) == 0
    reset(rig, command)
    for index, subindex, value, _ in WRITTEN:
        assert rig.read(index, subindex) == (shipped[index, subindex] if index <= last else value), hex(index)


def test_after_a_reset_of_the_node_process_values_read_as_after_power_up() -> None:
    rig = Rig()
    rig.energise()
    rig.give(DRIVE, protected(DRIVE, (1, 2, 3), 200))
    process = [(0x1001, 0), (0x1003, 0), *((index, sub) for index in (0x2000, 0x6411) for sub in (1, 2))]
    assert all(rig.read(*key) for key in process)
    reset(rig, RESET_NODE)
    assert [rig.read(*key) for key in process] == [0] * len(process)


def test_the_sense_counter_goes_on_through_every_reset() -> None:
    """So what is sent afterwards is told from what was on its way before."""
    rig = Rig()
    seen = []
    for command in (RESET_COMMUNICATION, RESET_NODE):
        rig.energise()
        seen += [data[6] for data in rig.of(SENSE)]
        reset(rig, command)
    rig.energise()
    assert seen + [data[6] for data in rig.of(SENSE)] == [1, 2, 3, 4, 5, 6]


def test_what_was_written_holds_nobody_back_after_the_reset() -> None:
    """SYNC, drive PDO, sense PDO, emergencies: where they are by default, and at once."""
    rig = Rig()
    for index, subindex, value, length in WRITTEN:
        if index < 0x2000:
            assert rig.write(index, subindex, value, length) == 0
    reset(rig, RESET_COMMUNICATION)
    rig.energise((1, 2, 3))
    rig.node.amplifier_fault(FAULT)
    assert rig.of(SENSE)
    assert rig.of(EMCY)[0][:2] == FAULT.to_bytes(2, "little")


@pytest.mark.parametrize("command", [RESET_COMMUNICATION, RESET_NODE])
def test_a_mapping_of_before_is_not_what_a_drive_frame_is_read_by(command: int) -> None:
    """Combs in another order would take each other's voltage."""
    rig = Rig()
    entries = (0x64110310, 0x64110210, 0x64110110, 0x20000108, 0x20000208)
    assert rig.write(0x1401, 1, OUT_OF_USE | DRIVE, 4) == rig.write(0x1601, 0, 0, 1) == 0
    for place, entry in enumerate(entries, 1):
        assert rig.write(0x1601, place, entry, 4) == 0
    assert rig.write(0x1601, 0, len(entries), 1) == rig.write(0x1401, 1, DRIVE, 4) == 0
    rig.start()
    rig.cycle((3, 2, 1))
    rig.sync()
    assert rig.node.outputs == (1, 2, 3)
    reset(rig, command)
    rig.energise((3, 2, 1))


@pytest.mark.parametrize("command", [RESET_COMMUNICATION, RESET_NODE])
def test_the_combs_step_limit_and_time_out_are_those_that_are_read(command: int) -> None:
    rig = Rig()
    assert rig.write(0x2011, 0, 50, 2) == rig.write(0x2012, 0, 3, 2) == 0
    reset(rig, command)
    is_kept = command == RESET_COMMUNICATION
    rig.start()
    rig.cycle((100, 0, 0))
    rig.sync()
    assert rig.node.outputs == (ZERO if is_kept else (100, 0, 0))
    rig.cycle(ZERO)
    rig.cycle((50, 0, 0))
    rig.sync()
    applied_us = rig.now_us
    rig.run(30_000)
    assert rig.plant.driven[-1] == (applied_us + (3_000 if is_kept else 20_000), ZERO)


@pytest.mark.parametrize("command", [RESET_COMMUNICATION, RESET_NODE])
def test_error_values_are_taken_at_the_reset_and_0_v_at_power_up(command: int) -> None:
    """Mode 1 takes the error value, mode 0 keeps what is there (CiA 401); a node that is new has 0 V on all."""
    rig = Rig()
    assert rig.write(0x6444, 1, 77, 4) == rig.write(0x6443, 3, 0, 1) == 0
    rig.energise((100, 200, 300))
    rig.nmt(command)
    assert rig.node.outputs == (ZERO if command == RESET_NODE else (77, 0, 300))
    assert rig.plant.driven[-1] == (rig.now_us, rig.node.outputs)
    rig.run(10_000)
    assert [rig.read(0x6411, comb) for comb in (1, 2, 3)] == list(rig.node.outputs)


@pytest.mark.parametrize("command", [RESET_COMMUNICATION, RESET_NODE])
def test_digital_outputs_go_to_their_error_value_and_0_at_power_up(command: int) -> None:
    rig = Rig()
    assert rig.write(0x6206, 1, 0x0F, 1) == rig.write(0x6207, 1, 3, 1) == 0
    rig.start()
    assert rig.write(0x6200, 1, 0xF4, 1) == 0
    rig.give(0x20A, b"\xff")  # waits for a SYNC that comes in another life
    reset(rig, command)
    bits = 0 if command == RESET_NODE else 0xF3
    assert (rig.node.digital.bits, rig.read(0x6200, 1)) == (bits, bits)
    rig.start()
    rig.sync()
    assert rig.node.digital.bits == bits


def test_a_fault_outlives_a_reset_of_the_communication_and_holds_the_combs() -> None:
    """It is the amplifier's, not the bus's: said again after the boot, and ended only by being cleared."""
    rig = Rig()
    rig.energise()
    rig.node.amplifier_fault(FAULT)
    rig.node.amplifier_fault(0x4210)
    rig.node.clear_amplifier_fault(0x4210)
    rig.nmt(RESET_COMMUNICATION)
    rig.forget()
    rig.run(10_000)
    assert [emergencies(rig), rig.read(0x1001, 0), rig.read(0x1003, 0), rig.read(0x1003, 1)] == [[FAULT], 3, 1, FAULT]
    rig.start()
    for counts in (ZERO, (1, 2, 3), (1, 2, 3)):
        rig.cycle(counts)
    assert rig.node.outputs == ZERO
    rig.node.clear_amplifier_fault(FAULT)
    assert_only_zero_energises(rig, (1, 2, 3))


def test_a_fault_ends_with_a_reset_of_the_node() -> None:
    rig = Rig()
    rig.node.amplifier_fault(FAULT)
    reset(rig, RESET_NODE)
    rig.energise((1, 2, 3))  # which owes no 0 V either
    rig.node.clear_amplifier_fault(FAULT)
    assert emergencies(rig) == []


@pytest.mark.parametrize("command", [RESET_COMMUNICATION, RESET_NODE])
def test_the_watch_over_the_controller_and_what_came_of_it_end(command: int) -> None:
    """0x1016 is 0 again: nobody's heartbeat is waited for, so nobody's absence holds the combs."""
    rig = Rig()
    assert rig.write(0x1016, 1, 127 << 16 | 5, 4) == 0
    rig.energise()
    rig.give(CONTROLLER, b"\x05")
    rig.run(5_000)
    assert rig.node.emergency.active[-1] == LOST
    reset(rig, command)
    assert (rig.node.emergency.active, rig.read(0x1003, 0)) == ((), 0)
    rig.give(CONTROLLER, b"\x05")
    rig.run(10_000)
    rig.give(CONTROLLER, b"\x00")
    rig.energise((1, 2, 3))
    assert emergencies(rig) == []


def test_emergencies_that_waited_are_not_sent_by_the_node_that_boots() -> None:
    rig = Rig()
    rig.nmt(STOP)
    rig.node.amplifier_fault(FAULT)
    rig.node.clear_amplifier_fault(FAULT)
    rig.nmt(RESET_NODE)
    rig.run(100_000)
    assert emergencies(rig) == []


@pytest.mark.parametrize("command", [RESET_COMMUNICATION, RESET_NODE])
def test_an_inhibit_time_of_before_keeps_no_emergency_back(command: int) -> None:
    """Up to 6.5 s it would be, with the object at its default again."""
    rig = Rig()
    assert rig.write(0x1015, 0, 65535, 2) == 0
    rig.node.amplifier_fault(FAULT)
    rig.node.clear_amplifier_fault(FAULT)
    reset(rig, command)
    rig.node.amplifier_fault(FAULT)
    assert emergencies(rig) == [FAULT]


@pytest.mark.parametrize("command", [RESET_COMMUNICATION, RESET_NODE])
def test_no_heartbeat_goes_but_the_boot_up_message(command: int) -> None:
    rig = Rig()
    assert rig.write(0x1017, 0, 1, 2) == 0  # shorter than the boot
    rig.nmt(command)
    rig.forget()
    rig.run(50_000)
    assert [(frame.can_id, frame.data) for _, frame in rig.sent] == [(HEARTBEAT, b"\0")]


def test_factory_settings_hold_from_the_boot_on() -> None:
    """Of both heartbeats, as a reset brings them back: nobody has to write them."""
    rig = Rig()
    rig.node.od.install(0x1016, 1, 127 << 16 | 5)
    rig.node.od.install(0x1017, 0, 20)
    rig.nmt(RESET_NODE)
    booted_us = rig.now_us + BOOT_US
    rig.run(50_000)
    assert rig.times(HEARTBEAT) == [booted_us, booted_us + 20_000, booted_us + 40_000]
    rig.give(CONTROLLER, b"\x05")
    rig.run(5_000)
    assert emergencies(rig) == [LOST]


def test_switched_on_again_while_it_boots_it_boots_once_and_later() -> None:
    rig = Rig(booted=False)
    rig.run(BOOT_US - 1)
    rig.node.power_on()
    rig.run(BOOT_US - 1)
    assert rig.sent == []
    rig.run(50_000)
    assert rig.times(HEARTBEAT) == [2 * BOOT_US - 1]


@pytest.mark.parametrize("request_of", ["6000000000000000", "7000000000000000"])
def test_a_transfer_that_was_begun_cannot_be_gone_on_with(request_of: str) -> None:
    """Segments of an upload, either toggle: the server knows of none."""
    rig = Rig()
    assert rig.ask(bytes.fromhex("4008100000000000"))[0] == 0x41
    reset(rig, RESET_COMMUNICATION)
    rig.give(REQUEST, bytes.fromhex(request_of))
    reply = rig.of(REPLY)[0]
    assert (reply[0], reply[4:]) == (0x80, 0x05040001.to_bytes(4, "little"))


@pytest.mark.parametrize("command", [RESET_COMMUNICATION, RESET_NODE])
def test_sync_is_where_it_was_and_may_begin_anywhere(command: int) -> None:
    rig = Rig()
    assert rig.write(0x1019, 0, 10, 1) == rig.write(0x1005, 0, 0x81, 4) == 0
    rig.start()
    rig.give(0x81, b"\x09")
    reset(rig, command)
    rig.start()
    rig.give(0x81, b"\x0a")
    assert rig.plant.sampled_us == []
    for counter in (b"\xef", b"\xf0", b"\x01"):  # up to 240 again
        rig.give(SYNC, counter)
    assert (len(rig.plant.sampled_us), emergencies(rig)) == (3, [])


@pytest.mark.parametrize(
    "commands", [(RESET_COMMUNICATION,), (RESET_NODE,), (PRE_OPERATIONAL,), (STOP,), (STOP, PRE_OPERATIONAL)]
)
def test_the_drive_counter_is_forgotten_by_whatever_ends_the_work(commands: tuple[int, ...]) -> None:
    """Whoever starts the node anew need not know where another left off."""
    rig = Rig()
    rig.energise()
    rig.cycle()  # a frame is owed, too
    for command in commands:
        rig.nmt(command)
        rig.run(10_000)
    rig.forget()
    rig.nmt(START)
    rig._counter = (rig._counter + 100) % 256
    rig.drive((1, 2, 3))
    rig.sync()
    rig.run(2_000)
    assert (rig.node.outputs, emergencies(rig)) == ((1, 2, 3), [])


@pytest.mark.parametrize(
    ("command", "is_owed"),
    [(RESET_NODE, False), (RESET_COMMUNICATION, False), (STOP, True), (PRE_OPERATIONAL, True)],
)
def test_0_v_that_is_owed_is_forgotten_by_a_reset_alone(command: int, is_owed: bool) -> None:
    """Were it enough to stop and start the node, frames that are queued somewhere would energise the combs."""
    rig = Rig()
    rig.energise()
    for _ in range(8):
        rig.cycle()
    assert rig.node.outputs == ZERO
    rig.nmt(command)
    rig.run(10_000)
    rig.start()
    rig.cycle((1, 2, 3))
    rig.sync()
    assert rig.node.outputs == (ZERO if is_owed else (1, 2, 3))


def test_the_signature_is_the_shipped_one_again_and_counted_from_the_start() -> None:
    rig = Rig()
    shipped = rig.read(0x2020, 1)
    cob_id = 0x4000038A
    assert rig.write(0x1802, 2, 3, 1) == rig.write(0x1802, 1, cob_id, 4) == rig.write(0x2010, 0, 9, 1) == 0
    rig.start()
    rig.cycle(ZERO)
    rig.cycle(ZERO)
    assert rig.read(0x2020, 1) == signature(rig.node.od) != shipped
    reset(rig, RESET_NODE)
    assert rig.read(0x2020, 1) == shipped
    rig.start()
    for _ in range(3):
        rig.cycle(ZERO)
    assert rig.of(cob_id & 0x7FF) == []  # out of use by default
    rig.nmt(PRE_OPERATIONAL)
    assert rig.write(0x1802, 2, 3, 1) == rig.write(0x1802, 1, cob_id, 4) == 0
    rig.start()
    for counted in (0, 0, 1):
        rig.cycle(ZERO)
        assert len(rig.of(cob_id & 0x7FF)) == counted


def test_a_written_drive_parameter_forgets_the_counter_and_one_that_is_refused_does_not() -> None:
    """While it works the node refuses 0x1401, and goes on as if nothing had been asked."""
    rig = operational()
    rig.cycle((1, 2, 3))
    assert rig.write(0x1401, 2, 254, 1) == 0x08000022
    rig.give(DRIVE, protected(DRIVE, (4, 5, 6), 77))
    rig.run(1)
    assert emergencies(rig) == [0xFF11]
    rig.nmt(PRE_OPERATIONAL)
    assert rig.write(0x1401, 2, 1, 1) == 0
    rig.start()
    rig.give(DRIVE, protected(DRIVE, (4, 5, 6), 200))
    rig.sync()
    assert rig.node.outputs == (4, 5, 6)


def test_a_written_overflow_of_sync_makes_any_counter_the_first_one() -> None:
    rig = Rig()
    rig.give(SYNC, b"\x01")
    assert rig.write(0x1019, 0, 20, 1) == 0
    rig.give(SYNC, b"\x09")
    assert emergencies(rig) == []
    rig.give(SYNC, b"\x09")
    assert emergencies(rig) == [0x8240]


def test_a_frame_that_waited_for_its_response_time_is_not_sent_by_the_node_that_boots() -> None:
    rig = operational()
    rig.sync()
    rig.nmt(RESET_COMMUNICATION)
    rig.run(BOOT_US)
    rig.start()
    rig.run(10_000)
    assert rig.of(SENSE) == []
