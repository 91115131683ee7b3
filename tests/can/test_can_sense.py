"""Sense PDOs that age: what is believed, what is flagged, over lost, late, repeated and damaged frames."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pkxyz_ctrl.can.codec import ProcessCodec
from pkxyz_ctrl.can.sense_input import (
    SENSE_COUNTER,
    SENSE_CRC,
    SENSE_DUPLICATE,
    SENSE_LENGTH,
    SENSE_MISSING,
    SenseInput,
)
from pkxyz_ctrl.safety.monitors import SenseStatus

CODEC = ProcessCodec(0x28A, protected=True)


def frame(sample: int) -> bytes:
    """The node's PDO of sample number ``sample``: the value tells which one it is."""
    return CODEC.encode((sample, -sample, 7), sample & 0xFF)


def tick(sense: SenseInput, *payloads: bytes) -> tuple[int, int]:
    """One SYNC, what arrives after it, and what the controller gets: (first count, status)."""
    sense.on_sync()
    for payload in payloads:
        sense.receive(payload)
    first, second, third, status = sense.take()
    assert (second, third) in ((-first, 7), (0, 0))
    return first, status


@pytest.fixture
def running() -> SenseInput:
    sense = SenseInput(CODEC)
    assert tick(sense, frame(100)) == (100, 0)
    return sense


def test_what_is_flagged_is_what_the_monitors_know():
    names = ("MISSING", "COUNTER", "CRC", "LENGTH", "DUPLICATE")
    flags = (SENSE_MISSING, SENSE_COUNTER, SENSE_CRC, SENSE_LENGTH, SENSE_DUPLICATE)
    assert flags == tuple(SenseStatus[name] for name in names)


def test_nothing_received_is_missing_and_zero():
    assert tick(SenseInput(CODEC)) == (0, SENSE_MISSING)


def test_a_thousand_good_ticks_have_status_zero(running):
    for sample in range(101, 1101):
        assert tick(running, frame(sample)) == (sample, 0)


def test_values_age(running):
    assert running.fresh
    assert tick(running) == (100, SENSE_MISSING)
    assert not running.fresh


def test_a_late_frame_is_counted_as_the_sync_that_it_belongs_to(running):
    """254 SYNCs behind it a counter still tells: its predecessor is no frame of today's."""
    running.on_sync()
    assert tick(running, frame(101)) == (100, SENSE_MISSING | SENSE_COUNTER)
    for _ in range(252):
        running.on_sync()
    assert tick(running, frame(100)) == (100, SENSE_MISSING | SENSE_COUNTER)


def test_a_node_that_starts_anew_has_said_nothing_yet(running):
    running.reset()
    assert tick(running) == (0, SENSE_MISSING)


def test_after_a_loss_the_next_frame_is_used_and_flagged(running):
    assert tick(running) == (100, SENSE_MISSING)
    assert tick(running, frame(102)) == (102, SENSE_COUNTER)
    assert tick(running, frame(103)) == (103, 0)


def test_a_late_frame_is_flagged_and_not_used_and_this_ticks_own_is(running):
    assert tick(running) == (100, SENSE_MISSING)
    running.on_sync()
    running.receive(frame(101))
    assert not running.fresh  # so that the loop goes on waiting for the sample of this SYNC
    running.receive(frame(102))
    assert running.fresh
    assert running.take()[::3] == (102, SENSE_COUNTER)
    assert tick(running, frame(103)) == (103, 0)


@pytest.mark.parametrize("late", [1, 2, 7])
def test_frames_that_are_always_late_are_never_this_ticks(running, late):
    """Every frame ``late`` ticks behind its SYNC, from now on: a shift of the whole loop if they were used."""
    for k in range(400):
        arriving = [frame(101 + k - late)] if k >= late else []
        value, status = tick(running, *arriving)
        assert (value, status & SENSE_MISSING) == (100, SENSE_MISSING)
        assert status == SENSE_MISSING | (SENSE_COUNTER if arriving else 0)
    caught_up = [frame(501 - late + n) for n in range(late + 1)]  # the backlog and this tick's own, in one tick
    assert tick(running, *caught_up) == (501, SENSE_COUNTER)
    assert tick(running, frame(502)) == (502, 0)


def test_frame_after_take_is_reported_with_the_next_tick_and_its_value_is_not_used(running):
    assert tick(running) == (100, SENSE_MISSING)
    running.receive(frame(101))
    running.receive(b"")
    assert tick(running) == (101, SENSE_MISSING | SENSE_LENGTH)


@pytest.mark.parametrize("back", [*range(0, 40), 254])
def test_an_old_frame_played_again_is_never_used(running, back):
    replayed = CODEC.encode((1, -1, 7), (100 - back) & 0xFF)
    assert tick(running, replayed) == (100, SENSE_MISSING | SENSE_COUNTER)
    assert tick(running, frame(102)) == (102, SENSE_COUNTER)


def test_a_counter_from_the_future_is_not_used(running):
    assert tick(running, CODEC.encode((1, -1, 7), 102)) == (100, SENSE_MISSING | SENSE_COUNTER)


@pytest.mark.parametrize("counter", [101, 102, 103, 100])
def test_repeated_or_odd_second_frame_keeps_the_first_value(running, counter):
    assert tick(running, frame(101), CODEC.encode((55, -55, 7), counter)) == (101, SENSE_DUPLICATE)
    assert tick(running, frame(102)) == (102, 0)


@pytest.mark.parametrize("bit", range(64))
def test_damaged_frame_is_not_used(running, bit):
    damaged = (int.from_bytes(frame(101), "little") ^ 1 << bit).to_bytes(8, "little")
    assert tick(running, damaged) == (100, SENSE_MISSING | SENSE_CRC)
    assert tick(running, damaged, frame(102)) == (102, SENSE_CRC | SENSE_COUNTER)


@pytest.mark.parametrize("length", [0, 1, 5, 6, 7, 9, 12, 64])
def test_wrong_length_is_not_used(running, length):
    assert tick(running, bytes(length)) == (100, SENSE_MISSING | SENSE_LENGTH)


@pytest.mark.parametrize(("silent", "taken"), [(252, False), (253, False), (254, True), (255, True), (1000, True)])
def test_after_255_syncs_any_counter_is_taken(running, silent, taken):
    for _ in range(silent):
        assert tick(running) == (100, SENSE_MISSING)
    same_counter = CODEC.encode((9, -9, 7), 100)
    assert tick(running, same_counter) == ((9, SENSE_COUNTER) if taken else (100, SENSE_MISSING | SENSE_COUNTER))


def test_a_node_that_starts_anew_may_start_at_any_counter(running):
    running.reset()
    assert tick(running, CODEC.encode((5, -5, 7), 200)) == (5, 0)


def test_plain_pdo_knows_length_and_age_only():
    plain = ProcessCodec(0x28A, protected=False)
    sense = SenseInput(plain)
    assert tick(sense, plain.encode((1, -1, 7), 0)) == (1, 0)
    assert tick(sense, plain.encode((2, -2, 7), 0), plain.encode((3, -3, 7), 0)) == (3, SENSE_DUPLICATE)
    assert tick(sense, frame(4)) == (3, SENSE_MISSING | SENSE_LENGTH)
    assert tick(sense) == (3, SENSE_MISSING)


@given(st.lists(st.sampled_from(["good", "lost", "damaged", "short", "replayed"]), max_size=60))
def test_whatever_happens_the_value_is_this_ticks_sample_or_missing_is_set(events):
    sense = SenseInput(CODEC)
    tick(sense, frame(1000))
    for sample, event in enumerate(events, 1001):
        good = frame(sample)
        arriving = {
            "good": [good],
            "lost": [],
            "damaged": [good[:3] + bytes((good[3] ^ 0x10,)) + good[4:]],
            "short": [good[:7]],
            "replayed": [frame(sample - 70)],
        }[event]
        value, status = tick(sense, *arriving)
        assert (status & SENSE_MISSING == 0) == (event == "good")
        assert value == sample or status & SENSE_MISSING
        assert status != 0 or event == "good"
