"""Each condition of the node's output path by itself: what a drive PDO of another mapping has to pass, and SYNCs that
are none.
"""

import pytest
from node_rig import DRIVE, EDS, EMCY, Crc8H2F, RecordingPlant, Rig, protected

from hil.bus.clock import Lockstep
from hil.node.amplifier import AmplifierNode
from hil.node.emergency import ErrorCode

ENTRIES = [0x64110310, 0x64110210, 0x64110110, 0x20000108, 0x20000208]
"""Protected, with the combs in another order."""


def node_of(node_id: int = 10, eds: object = EDS) -> AmplifierNode:
    return AmplifierNode(
        node_id, Lockstep(), lambda frame: None, RecordingPlant(), str(eds), turnaround_us=2, fd=False, protection=True
    )


@pytest.mark.parametrize(("node_id", "allowed"), [(0, False), (1, True), (127, True), (128, False)])
def test_a_node_id(node_id: int, allowed: bool) -> None:
    if allowed:
        assert node_of(node_id).node_id == node_id
    else:
        with pytest.raises(ValueError, match="CiA 301 allows 1 to 127"):
            node_of(node_id)


class Mapped(Rig):
    """Operational with the other mapping."""

    def __init__(self) -> None:
        super().__init__()
        assert self.write(0x1401, 1, 0x80000000 | DRIVE, 4) == 0
        assert self.write(0x1601, 0, 0, 1) == 0
        for place, entry in enumerate(ENTRIES, 1):
            assert self.write(0x1601, place, entry, 4) == 0
        assert self.write(0x1601, 0, len(ENTRIES), 1) == 0
        assert self.write(0x1401, 1, DRIVE, 4) == 0
        self.start()
        self.forget()

    def drive(self, counts: tuple[int, int, int], crc: int = 0) -> None:
        a, b, c = counts
        data = protected(DRIVE, (c, b, a), self._counter)
        self.give(DRIVE, data[:7] + bytes((data[7] ^ crc,)))
        self._counter = (self._counter + 1) % 256


def test_another_mapping_is_held_to_the_same() -> None:
    rig = Mapped()
    rig.cycle((1, 2, 3))
    rig.cycle()
    assert rig.node.outputs == (1, 2, 3)
    rig.drive((4, 5, 6), crc=1)
    rig._counter -= 1
    assert rig.node.emergency.active == (ErrorCode.DRIVE_CRC,)
    rig.cycle((4, 5, 6))  # late: its SYNC has passed
    assert ErrorCode.DRIVE_LATE in rig.node.emergency.active
    for _ in range(2000):
        rig.cycle((4, 5, 6))
    assert rig.node.emergency.active == ()
    assert rig.node.outputs == (4, 5, 6)


def test_of_two_frames_of_another_mapping_the_last_counts() -> None:
    rig = Mapped()
    rig.drive((1, 2, 3))
    rig.drive((4, 5, 6))
    rig.sync()
    assert rig.node.outputs == (4, 5, 6)


def test_another_mapping_waits_for_0_v_too_and_0_v_is_never_late() -> None:
    rig = Mapped()
    rig.cycle((1, 2, 3))
    for _ in range(7):
        rig.cycle()
    assert rig.node.outputs == (0, 0, 0)
    rig.drive((0, 0, 0))  # owed, and 0 V: not refused, and the combs may be energised again
    rig.cycle((1, 2, 3))
    rig.cycle((1, 2, 3))
    rig.cycle()
    assert rig.node.outputs == (1, 2, 3)


def test_another_mapping_that_was_released_is_not_energised_by_a_voltage() -> None:
    rig = Mapped()
    rig.cycle((1, 2, 3))
    for _ in range(7):
        rig.cycle()
    rig.sync()
    rig.drive((1, 2, 3))  # late
    for _ in range(5):
        rig.cycle((1, 2, 3))  # in time, but no 0 V has come
    assert rig.node.outputs == (0, 0, 0)
    rig.cycle((0, 0, 0))
    rig.cycle((1, 2, 3))
    rig.cycle()
    assert rig.node.outputs == (1, 2, 3)


@pytest.mark.parametrize("counts", [(-1, 0, 0), (0, -1, 0), (0, 0, -1)])
@pytest.mark.parametrize("rig_type", [Rig, Mapped])
def test_each_comb_is_held_to_its_range(rig_type: type[Rig], counts: tuple[int, int, int]) -> None:
    rig = rig_type()
    rig.start()
    rig.drive(counts)
    assert rig.node.emergency.active == (ErrorCode.DRIVE_VALUE,)


@pytest.mark.parametrize("counts", [(9, 0, 0), (0, 9, 0), (0, 0, 9)])
def test_one_comb_alone_is_a_voltage(counts: tuple[int, int, int]) -> None:
    """Limited in its step, released by a SYNC out of step, and refused where 0 V is due."""
    rig = Rig()
    assert rig.write(0x2011, 0, 8, 2) == 0
    rig.start()
    rig.cycle((0, 0, 0))
    rig.cycle(counts)
    rig.cycle()
    assert rig.node.outputs == (0, 0, 0)
    assert ErrorCode.DRIVE_STEP in rig.node.emergency.active


@pytest.mark.parametrize("rig_type", [Rig, Mapped])
@pytest.mark.parametrize("counts", [(9, 0, 0), (0, 9, 0), (0, 0, 9)])
def test_one_comb_alone_is_late_and_not_the_0_v_that_is_due(rig_type: type[Rig], counts: tuple[int, int, int]) -> None:
    rig = rig_type()
    rig.start()
    rig.cycle((0, 0, 0))
    rig.cycle()
    rig.sync()
    rig.drive(counts)  # late
    rig.sync()
    assert rig.node.outputs == (0, 0, 0)
    rig.cycle((1, 1, 1))  # late, too
    rig.cycle((1, 1, 1))
    rig.cycle()
    assert rig.node.outputs == (1, 1, 1)
    for _ in range(7):
        rig.cycle()  # released
    rig.drive(counts)  # late, and only 0 V may come
    rig.cycle(counts)
    rig.cycle()
    assert rig.node.outputs == (0, 0, 0)


@pytest.mark.parametrize("rig_type", [Rig, Mapped])
def test_the_largest_count_of_the_eds_passes(rig_type: type[Rig]) -> None:
    rig = rig_type()
    rig.start()
    rig.drive((32767, 32767, 32767))
    assert rig.node._drive.pending == (32767, 32767, 32767)


@pytest.mark.parametrize("rig_type", [Rig, Mapped])
def test_counter_and_crc_of_the_last_frame_are_read_back(rig_type: type[Rig]) -> None:
    rig = rig_type()
    assert (rig.read(0x2000, 1), rig.read(0x2000, 2)) == (0, 0)
    rig.start()
    rig._counter = 7
    data = protected(DRIVE, (1, 2, 3) if rig_type is Rig else (3, 2, 1), 7)
    rig.drive((1, 2, 3))
    assert (rig.read(0x2000, 1), rig.read(0x2000, 2)) == (7, data[7])


def test_what_was_pending_when_it_left_operational_is_forgotten() -> None:
    rig = Rig()
    rig.start()
    rig.cycle((0, 0, 0))
    rig.drive((1, 1, 1))
    rig.nmt(0x80)
    rig.start()
    rig.sync()
    assert rig.node.outputs == (0, 0, 0)
    assert rig.node._drive.pending is None


def test_a_refused_frame_excuses_one_sync_and_not_the_next() -> None:
    rig = Rig()
    rig.start()
    rig.cycle((1, 1, 1))
    rig.sync()
    rig.give(DRIVE, protected(DRIVE, (2, 2, 2), 9))  # its counter has jumped
    rig.sync()
    rig.sync()
    rig.forget()
    rig.give(DRIVE, protected(DRIVE, (3, 3, 3), 10))
    assert rig.node._drive.pending is None  # late for the second of them


def test_a_frame_that_is_late_may_have_any_counter() -> None:
    rig = Rig()
    rig._counter = 255
    rig.start()
    rig.cycle((1, 1, 1))
    rig.cycle()
    rig.cycle()
    rig.drive((1, 1, 1))  # its counter is 0
    assert rig.of(EMCY)[-1][:2] == ErrorCode.DRIVE_LATE.to_bytes(2, "little")
    assert rig.read(0x2000, 1) == 0


def test_without_a_limit_in_its_eds_no_voltage_passes(tmp_path) -> None:  # type: ignore[no-untyped-def]
    text = EDS.read_text(encoding="utf-8")
    begin = text.index("[6411sub1]")
    end = text.index("[6411sub2]")
    sub = "\n".join(line for line in text[begin:end].splitlines() if not line.startswith("HighLimit"))
    (tmp_path / "free.eds").write_text(text[:begin] + sub + "\n" + text[end:], encoding="utf-8")
    node = node_of(eds=tmp_path / "free.eds")
    assert node._drive._limit == 0


def test_events_apply_what_passes_and_nothing_else() -> None:
    rig = Rig()
    assert rig.write(0x1401, 2, 255, 1) == rig.write(0x2011, 0, 10, 2) == 0
    rig.start()
    rig.forget()
    rig.drive((5, 0, 0))
    assert rig.node.outputs == (5, 0, 0)
    rig.give(DRIVE, bytes(8))  # a wrong CRC
    assert rig.node.outputs == (5, 0, 0)
    rig.drive((16, 0, 0))  # a step too far
    assert rig.node.outputs == (0, 0, 0)


def test_syncs_before_operational_are_counted_too() -> None:
    rig = Rig()
    rig.sync()
    rig.sync()
    rig.give(0x080, b"")  # none
    rig.give(0x080, b"\xf1")
    rig._sync = 7
    rig.sync()  # out of step
    assert rig.plant.sampled_us == []
    assert ErrorCode.SYNC_DATA in rig.node.emergency.active


@pytest.mark.parametrize(("applied", "pending", "released"), [
    ((0, 0, 0), None, False), ((0, 0, 0), (0, 0, 0), False), ((0, 0, 0), (1, 0, 0), True), ((2, 0, 0), (0, 0, 0), True),
])  # fmt: skip
def test_a_sync_out_of_step_releases_what_is_driven_or_was_to_be(
    applied: tuple[int, int, int], pending: tuple[int, int, int] | None, released: bool
) -> None:
    rig = Rig()
    rig.start()
    rig.cycle(applied)
    rig.sync()
    if pending is not None:
        rig.drive(pending)
    rig._sync += 3
    rig.sync()
    assert rig.node.outputs == (0, 0, 0)
    assert rig.node._drive._is_zero_due == released


@pytest.mark.parametrize("is_protected", [True, False])
def test_an_sdo_write_drives_only_a_plain_module_that_is_operational_and_well(is_protected: bool) -> None:
    rig = Rig(protection=is_protected)
    assert rig.write(0x6411, 1, 5, 2) == 0x08000021
    rig.start()
    assert (rig.write(0x6411, 1, 5, 2) == 0) == (not is_protected)
    rig.node.amplifier_fault(0x2310)
    assert rig.write(0x6411, 1, 5, 2) == 0x08000021


def test_sense_counts_are_read_in_every_state() -> None:
    rig = Rig()
    rig.read(0x6401, 1)
    assert len(rig.plant.sampled_us) == 1  # nobody else samples
    rig.start()
    rig.sync()
    sampled = list(rig.plant.sampled_us)
    rig.read(0x6401, 1)
    assert rig.plant.sampled_us == sampled


def test_the_crc_of_the_test_is_that_of_the_contract() -> None:
    assert Crc8H2F.calc(b"123456789") == 0xDF
