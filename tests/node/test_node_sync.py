"""SYNC, transmission types and mappings of the amplifier node."""

import pytest
from node_rig import (
    DRIVE,
    EMCY,
    SENSE,
    SYNC,
    TURNAROUND_US,
    Crc8H2F,
    Rig,
    emergencies,
    operational,
    protected,
    sample_at,
)

from pkxyz_ctrl.can.codec import ProcessCodec

ZERO = (0, 0, 0)
COUNTER, VALUE = 0xFF11, 0xFF12
SHORT, LONG = 0x8210, 0x8220
GOOD = protected(DRIVE, (1, 2, 3), 0)


# -- SYNC ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("data", [b"", b"\x00", b"\xf1", b"\xff", b"\x01\x02", bytes(8)])
def test_a_sync_that_is_none_is_not_one(data: bytes) -> None:
    rig = operational()
    rig.drive((1, 2, 3))
    rig.give(SYNC, data)
    rig.run(100)
    assert (rig.plant.driven, rig.of(SENSE), emergencies(rig)) == ([], [], [0x8240])
    assert rig.of(EMCY)[0][3:] == (bytes((len(data),)) + data[:1]).ljust(5, b"\0")
    rig.sync()
    assert rig.node.outputs == (1, 2, 3)


@pytest.mark.parametrize("jump", [0, 2, 100])
def test_a_sync_out_of_step_is_sampled_at_but_takes_the_combs_to_0_v(jump: int) -> None:
    """A SYNC was missed, or another sends one: what waits was not meant for this one."""
    rig = operational()
    rig.cycle((1, 2, 3))  # to be applied at the second SYNC
    rig.give(SYNC, bytes((1 + jump,)))
    rig.run(100)
    assert (rig.node.outputs, len(rig.of(SENSE)), emergencies(rig)) == (ZERO, 2, [0x8240])
    rig = operational()
    rig.cycle((1, 2, 3))
    rig.cycle((1, 2, 4))
    assert rig.node.outputs == (1, 2, 3)
    rig.give(SYNC, bytes((2 + jump,)))
    rig.run(100)
    assert (rig.node.outputs, len(rig.of(SENSE)), emergencies(rig)) == (ZERO, 3, [0x8240])
    rig._sync = 2 + jump
    rig.cycle((1, 2, 3))
    rig.cycle(ZERO)
    assert rig.node.outputs == ZERO  # nothing before 0 V
    rig.cycle((1, 2, 3))
    rig.sync()
    assert rig.node.outputs == (1, 2, 3)


@pytest.mark.parametrize("last", [2, 10, 240])
def test_sync_counter_wraps_where_configured(last: int) -> None:
    rig = Rig()
    assert rig.write(0x1019, 0, last, 1) == 0
    rig.start()
    for k in range(3 * last):
        rig.give(SYNC, bytes((k % last + 1,)))
        rig.run(100)
    assert (len(rig.of(SENSE)), emergencies(rig)) == (3 * last, [0x8250])  # no drive PDO came
    rig.give(SYNC, bytes((last + 1,)))
    rig.run(2000)
    assert emergencies(rig) == [0x8250, 0x8240]


def test_sync_without_counter_and_with_another_identifier() -> None:
    rig = Rig()
    assert rig.write(0x1019, 0, 0, 1) == rig.write(0x1005, 0, 0x90, 4) == 0
    rig.start()
    rig.forget()
    rig.drive((1, 2, 3))
    rig.give(0x80, b"")
    assert rig.plant.driven == []
    rig.give(0x90, b"")
    rig.run(100)
    assert (rig.node.outputs, len(rig.of(SENSE)), rig.of(EMCY)) == ((1, 2, 3), 1, [])
    rig.give(0x90, b"\x01")
    assert emergencies(rig) == [0x8240]


# -- transmission types and mappings -----------------------------------------------------------------------------------


@pytest.mark.parametrize("every", [1, 2, 3, 7, 240])
def test_sense_every_nth_sync(every: int) -> None:
    rig = Rig()
    assert rig.write(0x1801, 2, every, 1) == 0
    rig.start()
    rig.forget()
    t_us = rig.now_us
    for _ in range(500):
        rig.cycle()
    assert rig.times(SENSE) == [t_us + 200 * k + TURNAROUND_US for k in range(every - 1, 500, every)]


def test_sense_on_change_only() -> None:
    rig = Rig()
    rig.write(0x1801, 2, 0, 1)
    rig.start()
    rig.forget()
    values = [(1, 1, 1)] * 3 + [(1, 1, 2)] * 2 + [(1, 1, 1)]
    remaining = iter(values)
    rig.plant.sample = lambda: next(remaining)  # type: ignore[method-assign]
    for _ in values:
        rig.cycle()
    assert [ProcessCodec(SENSE, True).decode(data)[:3] for data in rig.of(SENSE)] == [(1, 1, 1), (1, 1, 2), (1, 1, 1)]


def test_sync_start_value() -> None:
    rig = Rig()
    assert rig.write(0x1801, 1, 0xC000028A, 4) == rig.write(0x1801, 6, 5, 1) == rig.write(0x1801, 2, 2, 1) == 0
    assert rig.write(0x1801, 1, 0x4000028A, 4) == 0
    rig.start()
    rig.forget()
    t_us = rig.now_us
    for _ in range(9):
        rig.cycle()
    assert rig.times(SENSE) == [t_us + 200 * k + TURNAROUND_US for k in (4, 6, 8)]


@pytest.mark.parametrize("kind", [254, 255])
def test_event_driven_pdos(kind: int) -> None:
    rig = Rig()
    assert rig.write(0x1401, 2, kind, 1) == rig.write(0x1801, 2, kind, 1) == rig.write(0x1801, 5, 3, 2) == 0
    rig.start()
    rig.forget()
    t_us = rig.now_us
    rig.run(50)
    rig.drive((3, 2, 1))
    assert rig.plant.driven == [(t_us + 50, (3, 2, 1))]
    rig.run(9_950)
    assert rig.times(SENSE) == [t_us + 3000 * k for k in (1, 2, 3)]
    rig.nmt(2)
    rig.run(10_000)
    assert len(rig.times(SENSE)) == 3


def remap(rig: Rig, communication: int, cob_id: int, entries: list[int]) -> None:
    assert rig.write(communication, 1, 0x80000000 | cob_id, 4) == 0
    assert rig.write(communication + 0x200, 0, 0, 1) == 0
    for subindex, entry in enumerate(entries, 1):
        assert rig.write(communication + 0x200, subindex, entry, 4) == 0
    assert rig.write(communication + 0x200, 0, len(entries), 1) == 0
    assert rig.write(communication, 1, cob_id, 4) == 0


def test_another_mapping_and_identifier() -> None:
    rig = Rig()
    remap(rig, 0x1401, 0x201, [0x64110310, 0x20000108, 0x64110110, 0x20000208])
    remap(rig, 0x1801, 0x40000181, [0x10010008, 0x64010210, 0x20010108, 0x20010208])
    rig.start()
    rig.forget()

    def drive(third: int, first: int, counter: int) -> bytes:
        payload = third.to_bytes(2, "little") + bytes((counter,)) + first.to_bytes(2, "little")
        return payload + bytes((Crc8H2F.calc(b"\x01\x02" + payload),))

    rig.give(0x201, drive(33, 11, 5))
    t_us = rig.now_us
    rig.cycle()
    assert rig.plant.driven == [(t_us, (11, 0, 33))]
    rig.give(0x201, drive(34, 12, 5))
    rig.give(DRIVE, GOOD)
    rig.sync()
    assert (rig.node.outputs, emergencies(rig)) == ((11, 0, 33), [COUNTER])
    sense = rig.of(0x181)[0]
    assert sense[:4] == b"\0" + sample_at(t_us)[1].to_bytes(2, "little", signed=True) + b"\x01"
    assert sense[4] == Crc8H2F.calc(b"\x81\x01" + sense[:4])
    rig.give(0x201, drive(0x8000, 12, 6))
    rig.give(0x201, drive(1, 12, 7)[:5])
    assert emergencies(rig)[0] == COUNTER
    assert set(rig.node.emergency.active) == {COUNTER, VALUE, SHORT}


def test_a_plain_module_without_protection() -> None:
    rig = operational(protection=False)
    t_us = rig.now_us
    rig.give(DRIVE, bytes.fromhex("010002000300"))
    rig.cycle()
    assert rig.plant.driven == [(t_us, (1, 2, 3))]
    assert rig.of(SENSE)[0] == protected(SENSE, sample_at(t_us), 0)[:6]
    rig.give(DRIVE, bytes.fromhex("0100020003ff"))
    rig.give(DRIVE, GOOD)
    assert rig.node.emergency.active == (VALUE, LONG)
    assert rig.write(0x6411, 2, 9, 2) == 0
    assert rig.plant.driven[-1] == (rig.now_us, (1, 9, 3))
    rig.nmt(128)
    assert rig.write(0x6411, 2, 9, 2) == 0x08000021


def test_a_pdo_out_of_use_is_deaf_and_dumb() -> None:
    rig = Rig()
    assert rig.write(0x1401, 1, 0x8000030A, 4) == rig.write(0x1801, 1, 0xC000028A, 4) == 0
    rig.start()
    rig.forget()
    rig.cycle((1, 2, 3))
    rig.cycle((1, 2, 3))
    assert (rig.plant.driven, rig.sent) == ([], [])
    rig.nmt(128)
    assert rig.write(0x1801, 1, 0x4000028A, 4) == 0
    rig.start()
    rig.cycle()
    assert len(rig.of(SENSE)) == 1
