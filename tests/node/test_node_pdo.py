"""Process data of the amplifier node: what is applied when, what is sent when, and what is refused."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from node_rig import DRIVE, EMCY, SENSE, TURNAROUND_US, Crc8H2F, Rig, emergencies, operational, protected, sample_at

from hil.node.amplifier import NmtState
from hil.node.crc import WORDS, crc8h2f, last_byte_table
from pkxyz_ctrl.can.codec import ProcessCodec

COUNTS = st.tuples(*[st.integers(0, 32767)] * 3)
ZERO = (0, 0, 0)
CRC, COUNTER, VALUE, LATE = 0xFF10, 0xFF11, 0xFF12, 0xFF13
SHORT, LONG = 0x8210, 0x8220
GOOD = protected(DRIVE, (1, 2, 3), 0)


# -- CRC -------------------------------------------------------------------------------------------------------------


def test_crc_check_value() -> None:
    assert crc8h2f(b"123456789") == 0xDF  # AUTOSAR SWS CRC Library


@given(st.binary(max_size=20))
def test_crc_against_crccheck(data: bytes) -> None:
    assert crc8h2f(data) == Crc8H2F.calc(data)


@given(st.integers(0, 0x7FF), st.tuples(*[st.integers(-32768, 32767)] * 3), st.integers(0, 255))
@settings(max_examples=50)
def test_word_tables_against_crccheck(cob_id: int, words: tuple[int, int, int], counter: int) -> None:
    (w0, w1, w2), w3 = WORDS, last_byte_table(cob_id)
    a, b, c = words
    assert w0[a] ^ w1[b] ^ w2[c] ^ w3[counter] == protected(cob_id, words, counter)[7]


# -- timing ----------------------------------------------------------------------------------------------------------


@given(st.lists(COUNTS, min_size=1, max_size=20), st.integers(20, 2000))
@settings(max_examples=30)
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
