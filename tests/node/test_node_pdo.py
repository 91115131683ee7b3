"""Process data of the amplifier node: what is applied when, what is sent when, and what is refused."""

from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from node_rig import DRIVE, EMCY, SENSE, SYNC, TURNAROUND_US, Crc8H2F, Rig, protected, sample_at

from hil.node.amplifier import NmtState
from hil.node.crc import WORDS, crc8h2f, last_byte_table
from pkxyz_ctrl.can.codec import ProcessCodec

COUNTS = st.tuples(*[st.integers(0, 32767)] * 3)
ZERO = (0, 0, 0)
CRC, COUNTER, VALUE, LATE, STEP = 0xFF10, 0xFF11, 0xFF12, 0xFF13, 0xFF14
MISSING, SHORT, LONG = 0x8250, 0x8210, 0x8220
GOOD = protected(DRIVE, (1, 2, 3), 0)


def emergencies(rig: Rig) -> list[int]:
    return [int.from_bytes(data[:2], "little") for data in rig.of(EMCY)]


def operational(**options: bool) -> Rig:
    rig = Rig(**options)
    rig.start()
    rig.forget()
    return rig


# -- CRC -------------------------------------------------------------------------------------------------------------


def test_crc_check_value() -> None:
    assert crc8h2f(b"123456789") == 0xDF  # AUTOSAR SWS CRC Library


@given(st.binary(max_size=20))
def test_crc_against_crccheck(data: bytes) -> None:
    assert crc8h2f(data) == Crc8H2F.calc(data)


@given(st.integers(0, 0x7FF), st.tuples(*[st.integers(-32768, 32767)] * 3), st.integers(0, 255))
@settings(max_examples=50, deadline=None)
def test_word_tables_against_crccheck(cob_id: int, words: tuple[int, int, int], counter: int) -> None:
    (w0, w1, w2), w3 = WORDS, last_byte_table(cob_id)
    a, b, c = words
    assert w0[a] ^ w1[b] ^ w2[c] ^ w3[counter] == protected(cob_id, words, counter)[7]


# -- timing ----------------------------------------------------------------------------------------------------------


@given(st.lists(COUNTS, min_size=1, max_size=20), st.integers(20, 2000))
@settings(max_examples=30, deadline=None)
def test_one_period_from_drive_pdo_to_comb(trajectory: list[tuple[int, int, int]], period_us: int) -> None:
    rig = operational()
    sync_us = []
    for counts in trajectory:
        sync_us.append(rig.now_us)
        rig.cycle(counts, period_us)
    sync_us.append(rig.now_us)
    rig.cycle(None, period_us)
    assert rig.plant.driven == list(zip(sync_us[1:], trajectory, strict=True))
    assert rig.plant.sampled_us == sync_us
    assert rig.times(SENSE) == [t_us + TURNAROUND_US for t_us in sync_us]
    assert rig.of(SENSE) == [protected(SENSE, sample_at(t_us), (k + 1) % 256) for k, t_us in enumerate(sync_us)]
    assert rig.sent[-1][1].can_id == SENSE


def test_the_controllers_codec_reads_the_sense_pdo() -> None:
    rig = operational()
    codec = ProcessCodec(SENSE, True)
    for k in range(600):
        t_us = rig.now_us
        rig.cycle()
        assert codec.decode(rig.sent[-1][1].data) == (*sample_at(t_us), (k + 1) % 256, True)


def test_drive_is_applied_before_the_sample_and_at_the_same_instant() -> None:
    rig = operational()
    seen: list[tuple[object, ...]] = []
    exchange = rig.plant.exchange
    rig.plant.exchange = lambda *what, sample: seen.append((*what, sample)) or exchange(*what, sample=sample)  # type: ignore
    rig.drive((7, 8, 9))
    rig.sync()
    assert seen == [(rig.now_us, (7, 8, 9), True)]


def test_the_last_of_two_drive_pdos_counts() -> None:
    rig = operational()
    rig.drive((1, 1, 1))
    rig.drive((2, 2, 2))
    rig.sync()
    assert rig.plant.driven == [(rig.now_us, (2, 2, 2))]


# -- what is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (b"", SHORT),
        (GOOD[:7], SHORT),
        (GOOD[:6], SHORT),
        (GOOD + b"\0", LONG),
        (GOOD + bytes(56), LONG),
        (bytes(8), CRC),
        (b"\xff" * 8, CRC),
        (protected(SENSE, (1, 2, 3), 0), CRC),
        (protected(DRIVE, (-1, 2, 3), 0), VALUE),
        (protected(DRIVE, (1, 2, -32768), 0), VALUE),
    ],
)
def test_a_bad_drive_pdo_is_not_applied_and_is_reported_once(data: bytes, code: int) -> None:
    rig = operational()
    for _ in range(50):
        rig.give(DRIVE, data)
        rig.run(100)
        rig.sync()
        rig.run(100)
    assert rig.plant.driven == []
    assert emergencies(rig)[0] == code
    assert set(emergencies(rig)) <= {code, COUNTER, 0x8250}  # repeated, its counter is wrong, and none is applied
    assert len(rig.of(EMCY)) <= 3
    assert rig.node.state is NmtState.OPERATIONAL


def test_every_single_bit_error_is_refused() -> None:
    rig = Rig()
    for bit in range(64):
        rig.nmt(130)
        rig.run(10_000)
        rig.start()
        rig.forget()
        rig.give(DRIVE, (int.from_bytes(GOOD, "little") ^ 1 << bit).to_bytes(8, "little"))
        rig.sync()
        assert (rig.plant.driven, emergencies(rig)) == ([], [CRC])


def test_limit_of_the_values() -> None:
    rig = operational()
    rig.drive((32767, 0, 32767))
    rig.sync()
    assert rig.node.outputs == (32767, 0, 32767)
    low = Rig()
    low.node.od.entry(0x6411, 1).high = 1000
    low.nmt(129)
    low.run(10_000)
    low.start()
    low.drive((1001, 0, 0))
    low.sync()
    assert (low.node.outputs, emergencies(low)) == (ZERO, [VALUE])


@pytest.mark.parametrize("first", [0, 1, 254, 255])
def test_alive_counter(first: int) -> None:
    rig = Rig()
    for step in range(256):
        rig.nmt(130)
        rig.run(10_000)
        rig.start()
        rig.forget()
        rig.give(DRIVE, protected(DRIVE, (1, 1, 1), first))
        rig.sync()
        assert rig.node.outputs == (1, 1, 1), "the first may carry any"
        second = (first + step) % 256
        rig.give(DRIVE, protected(DRIVE, (2, 2, 2), second))
        rig.sync()
        assert rig.node.outputs == ((2, 2, 2) if step == 1 else (1, 1, 1))
        assert emergencies(rig) == ([] if step == 1 else [COUNTER])
        rig.give(DRIVE, protected(DRIVE, (3, 3, 3), (second + 1) % 256))
        rig.sync()
        assert rig.node.outputs == (3, 3, 3), "in step again"


@pytest.mark.parametrize("syncs", [1, 2, 3])
def test_a_frame_that_came_after_its_sync_is_refused_and_those_behind_it_are_taken(syncs: int) -> None:
    rig = operational()
    rig.cycle((1, 1, 1))
    for _ in range(syncs):
        rig.sync()  # the first applies (1, 1, 1), the others find nothing
        rig.run(200)
    rig.sync()
    rig.drive((2, 2, 2))
    rig.sync()
    assert (rig.node.outputs, emergencies(rig)) == ((1, 1, 1), [LATE])
    rig.drive((3, 3, 3))
    rig.sync()
    assert (rig.node.outputs, emergencies(rig)) == ((3, 3, 3), [LATE])


def test_0_v_is_never_too_late() -> None:
    rig = operational()
    rig.cycle((1, 1, 1))
    rig.cycle()
    rig.cycle(ZERO)
    rig.sync()
    assert (rig.node.outputs, emergencies(rig)) == (ZERO, [LATE])


@pytest.mark.parametrize("refused", ["counter", "value", "crc"])
def test_a_frame_that_was_refused_in_its_time_makes_the_next_one_no_later(refused: str) -> None:
    rig = operational()
    rig.cycle((1, 1, 1))
    wrong = {
        "counter": protected(DRIVE, (2, 2, 2), 5),
        "value": protected(DRIVE, (-1, 2, 2), 1),
        "crc": bytes(8),
    }[refused]
    rig.sync()
    rig.give(DRIVE, wrong)
    rig.sync()  # finds nothing to apply
    following = {"counter": 6, "value": 2, "crc": 2}[refused]
    rig.give(DRIVE, protected(DRIVE, (3, 3, 3), following))
    assert LATE not in emergencies(rig)
    rig.sync()
    taken = refused != "crc"  # whose counter nobody could read: the next one has jumped
    assert rig.node.outputs == ((3, 3, 3) if taken else (1, 1, 1))


def test_errors_end_after_a_quiet_while() -> None:
    rig = operational()
    rig.cycle((1, 1, 1))
    rig.give(DRIVE, bytes(8))
    t_us = rig.now_us
    while rig.now_us < t_us + 150_000:
        rig.cycle((1, 1, 1))
    assert emergencies(rig) == [CRC, 0]
    assert 100_000 <= rig.times(EMCY)[1] - t_us <= 100_400
    assert rig.node.od[0x1001, 0] == 0


@pytest.mark.parametrize("syncs", [0, 1, 5, 255])
def test_combs_are_released_when_no_drive_pdo_comes(syncs: int) -> None:
    rig = Rig()
    rig.write(0x2010, 0, syncs, 1)
    rig.write(0x2012, 0, 1000, 2)  # the time-out that does not need SYNC
    rig.start()
    rig.forget()
    rig.cycle((4, 5, 6))
    applied_us = rig.now_us
    for _ in range(600):
        rig.cycle()
    if syncs == 0:
        assert rig.plant.driven == [(applied_us, (4, 5, 6))]
        return
    assert rig.plant.driven == [(applied_us, (4, 5, 6)), (applied_us + 200 * syncs, ZERO)]
    assert emergencies(rig) == [MISSING]
    for _ in range(3):  # what was queued while the bus was blocked
        rig.cycle((7, 7, 7))
        rig.sync()
        assert rig.node.outputs == ZERO
    rig.cycle(ZERO)
    rig.cycle((7, 7, 7))
    rig.sync()
    assert rig.node.outputs == (7, 7, 7)


@pytest.mark.parametrize(
    ("step_max", "change", "applied"), [(9, 9, True), (9, -9, True), (9, 10, False), (9, -10, False)]
)
@pytest.mark.parametrize("comb", [0, 1, 2])
def test_a_step_at_a_sync_is_limited_whatever_the_frame_says(
    step_max: int, change: int, applied: bool, comb: int
) -> None:
    rig = Rig()
    rig.write(0x2011, 0, step_max, 2)
    rig.start()
    rig.forget()
    held = [9, 9, 9]
    rig.cycle((9, 9, 9))
    rig.cycle((9 + 9, 9 + 9, 9 + 9))
    rig.cycle((18, 18, 18))
    rig.forget()
    held = [18, 18, 18]
    held[comb] += change
    a, b, c = held
    rig.cycle((a, b, c))
    rig.sync()
    rig.run(2000)
    assert rig.node.outputs == ((a, b, c) if applied else ZERO)
    assert emergencies(rig) == ([] if applied else [STEP])
    if not applied:
        assert rig.of(EMCY)[0][3] == 1 << comb
        rig.cycle((1, 1, 1))
        rig.sync()
        assert rig.node.outputs == ZERO  # nothing before 0 V
    else:
        rig.cycle(ZERO)
        rig.sync()
        assert rig.node.outputs == ZERO  # which is no step too far from anywhere


@pytest.mark.parametrize("timeout_ms", [1, 20, 1000])
def test_combs_are_released_in_time_when_no_sync_comes(timeout_ms: int) -> None:
    """Drive frames, even with 0 V, act at a SYNC: where none comes, the node has a time of its own."""
    rig = Rig()
    rig.write(0x2012, 0, timeout_ms, 2)
    rig.start()
    rig.forget()
    rig.cycle((4, 5, 6))
    applied_us = rig.now_us
    rig.sync()
    while rig.now_us < applied_us + 1000 * timeout_ms + 500:
        rig.drive(ZERO)
        rig.run(100)
    assert rig.plant.driven == [(applied_us, (4, 5, 6)), (applied_us + 1000 * timeout_ms, ZERO)]
    assert emergencies(rig) == [MISSING]


def released_by_silence(rig: Rig) -> None:
    for _ in range(7):
        rig.cycle()


def released_by_a_step(rig: Rig) -> None:
    rig.cycle((5000, 5, 5))
    rig.cycle((5, 5, 5))


def released_by_a_missed_sync(rig: Rig) -> None:
    rig._sync += 1
    rig.cycle((5, 5, 5))


def released_by_a_sync_that_was_missed_while_nothing_waited(rig: Rig) -> None:
    rig.cycle()
    rig._sync += 1
    rig.cycle()


def released_by_time(rig: Rig) -> None:
    rig.run(21_000)


@pytest.mark.parametrize(
    "release",
    [
        released_by_silence, released_by_a_step, released_by_a_missed_sync,
        released_by_a_sync_that_was_missed_while_nothing_waited, released_by_time,
    ],
)  # fmt: skip
def test_what_the_node_has_released_is_energised_by_nothing_but_0_v_first(release: Callable[[Rig], None]) -> None:
    """A second frame in sequence is no longer late, and would be taken: one with 0 V is owed."""
    rig = Rig()
    rig.write(0x2011, 0, 100, 2)
    rig.energise((5, 5, 5))
    release(rig)
    assert rig.node.outputs == ZERO
    for _ in range(5):
        rig.cycle((5, 5, 5))
        assert rig.node.outputs == ZERO
    rig.forget()
    rig.cycle(ZERO)
    rig.cycle((5, 5, 5))
    rig.sync()
    assert rig.node.outputs == (5, 5, 5)
    assert LATE not in emergencies(rig)  # what was refused for want of 0 V makes the next one no later


@pytest.mark.parametrize("again", [(128, 1), (129, 1)])
def test_a_new_start_owes_nothing_and_takes_any_counter(again: tuple[int, int]) -> None:
    rig = Rig()
    rig.energise((5, 5, 5))
    for _ in range(3):
        rig.cycle()  # SYNCs without a frame: the next one would be late
    released_by_silence(rig)  # and 0 V would be due
    rig.nmt(again[0])
    rig.run(10_000)
    if again[0] == 128:
        rig.drive(ZERO)  # not heard, and so no counter to follow
    rig._counter = (rig._counter + 77) % 256
    rig.forget()
    rig.start()
    if again[0] == 128:
        rig.cycle(ZERO)
    rig.cycle((6, 6, 6))
    rig.sync()
    rig.run(2000)
    assert rig.node.outputs == (6, 6, 6)
    assert emergencies(rig) in ([], [0])  # at most the end of what was before


def test_a_frame_that_was_refused_for_want_of_0_v_makes_the_next_one_no_later() -> None:
    rig = Rig()
    rig.write(0x2011, 0, 100, 2)
    rig.energise((5, 5, 5))
    released_by_a_step(rig)
    for _ in range(3):
        rig.cycle((5, 5, 5))
    rig.cycle(ZERO)
    rig.run(2000)
    assert emergencies(rig) == [STEP]


def test_a_frame_before_the_first_sync_of_a_new_start_is_not_late_for_one_of_before() -> None:
    rig = Rig()
    rig.energise((5, 5, 5))
    rig.cycle()
    rig.cycle()  # a SYNC without a frame
    rig.nmt(128)
    rig.start()
    rig.forget()
    rig.drive((6, 6, 6))
    rig.sync()
    rig.run(2000)
    assert (rig.node.outputs, emergencies(rig)) == ((6, 6, 6), [])


def test_that_none_arrives_is_said_at_zero_volts_too_and_nothing_else_comes_of_it() -> None:
    """Or a controller that commands 0 V would never hear that its drive PDOs do not arrive."""
    rig = operational()
    for cycle in range(1, 50):
        rig.cycle()
        assert bool(rig.of(EMCY)) == (cycle >= rig.node.od[0x2010, 0])
    assert (rig.plant.driven, emergencies(rig)) == ([], [0x8250])
    rig.drive((5, 5, 5))  # no combs were released, so no 0 V is asked for first; it is the first, so it is not late
    rig.sync()
    assert rig.node.outputs == (5, 5, 5)


def test_at_zero_volts_the_time_without_a_drive_pdo_is_watched_once_one_has_come() -> None:
    rig = operational()
    limit_us = 1000 * rig.node.od[0x2012, 0]
    rig.run(3 * limit_us)
    assert rig.of(EMCY) == []
    rig.drive(ZERO)
    rig.sync()
    rig.run(limit_us - 1000)
    assert rig.of(EMCY) == []
    rig.run(2000)
    assert emergencies(rig) == [0x8250]
    rig.forget()
    rig.cycle(ZERO)
    rig.cycle(ZERO)
    rig.nmt(128)
    rig.run(200_000)
    assert 0x8250 not in emergencies(rig)  # outside operational nobody sends any


def test_error_mode_and_value_of_each_comb() -> None:
    rig = Rig()
    assert rig.write(0x6443, 2, 0, 1) == rig.write(0x6444, 3, 55, 4) == 0
    rig.energise((100, 200, 300))
    rig.nmt(128)
    assert rig.plant.driven[-1] == (rig.now_us, (0, 200, 55))
    assert [rig.read(0x6411, i) for i in (1, 2, 3)] == [0, 200, 55]


# -- SYNC ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("data", [b"", b"\x00", b"\xf1", b"\xff", b"\x01\x02", bytes(8)])
def test_a_sync_that_is_none_is_not_one(data: bytes) -> None:
    rig = operational()
    rig.drive((1, 2, 3))
    rig.give(SYNC, data)
    rig.run(100)
    assert (rig.plant.driven, rig.of(SENSE), emergencies(rig)) == ([], [], [0x8240])
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
