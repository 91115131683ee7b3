"""The ring in shared memory: what is read is what was written, whole and in order, or it is counted as lost."""

import multiprocessing
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.operate.commands import TICK
from hil.operate.memory import StageMemory
from hil.operate.ring import Reader, Writer, bytes_for, slot_of

pytestmark = pytest.mark.at_rate

RECORD = np.dtype([("n", "<u8"), ("x", "<f8", (7,))])


def ring(slots: int) -> memoryview:
    return memoryview(bytearray(bytes_for(RECORD, slots)))


def record(n: int) -> bytes:
    return np.array([(n, [n] * 7)], RECORD).tobytes()


def number_of(data: bytes) -> int:
    return int(np.frombuffer(data, RECORD)["n"][0])


@settings(max_examples=60)
@given(st.lists(st.integers(0, 9), max_size=40), st.integers(2, 9))
def test_what_was_not_overwritten_is_read_in_order_and_the_rest_is_counted(bursts, slots):
    memory = ring(slots)
    writer, reader = Writer(memory, RECORD, slots), Reader(memory, RECORD, slots)
    seen, written = [], 0
    for burst in bursts:
        for _ in range(burst):
            written += 1
            assert writer.write(record(written)) == written
        while reader.next <= written:  # None may mean: overwritten, go on
            seen += [number_of(data) for data in iter(reader.read, None)]
    assert seen == sorted(set(seen))
    assert len(seen) + reader.lost == written
    if all(burst <= slots for burst in bursts):
        assert reader.lost == 0


@given(st.integers(0, 30), st.integers(1, 30))
def test_blocks_and_single_records_agree(count, most):
    slots = 8
    memory = ring(slots)
    writer = Writer(memory, RECORD, slots)
    one, many = Reader(memory, RECORD, slots), Reader(memory, RECORD, slots)
    single, block = [], []
    for n in range(1, count + 1):
        writer.write(record(n))
        if n % 5 == 0:
            single += [number_of(data) for data in iter(one.read, None)]
            while len(rows := many.read_block(most)):
                block += rows["n"].tolist()
    assert single == block == list(range(1, count // 5 * 5 + 1))


def test_records_with_padding_come_through_in_blocks(tmp_path):
    """An array's copy leaves padding out, and the CRC is over all bytes of a slot."""
    memory = StageMemory(tmp_path / "memory", kept_ticks=500)
    writer, reader = memory.writer("ticks"), memory.reader("ticks")
    tick = np.zeros(1, TICK)
    for n in range(300):
        tick["row"]["tick"] = n
        writer.write(tick.view(np.uint8).data)
        if n % 10 == 9:
            assert reader.read_block(1000)["row"]["tick"].tolist() == list(range(n - 9, n + 1))


def test_a_torn_record_is_not_read_whichever_byte_is_torn():
    """Each byte of a slot that is not what its writer put there: its number, its record, its CRC."""
    slots, layout = 4, slot_of(RECORD)
    for at in range(layout.itemsize):
        memory = ring(slots)
        reader = Reader(memory, RECORD, slots)
        Writer(memory, RECORD, slots).write(record(1))
        memory[64 + at] ^= 0x5A
        padding = at >= layout.fields["crc"][1] + 4
        assert (reader.read() is None) != padding, at
        assert len(Reader(memory, RECORD, slots, from_start=True).read_block(1)) == padding


def test_a_record_of_an_earlier_round_is_not_taken_for_a_new_one():
    memory = ring(2)
    writer = Writer(memory, RECORD, 2)
    reader = Reader(memory, RECORD, 2)
    for n in (1, 2, 3):
        writer.write(record(n))
    slot = memory[64 : 64 + slot_of(RECORD).itemsize]  # holds 3
    old = bytearray(slot)
    old[0:8] = (1).to_bytes(8, "little")
    crc_at = slot_of(RECORD).fields["crc"][1]
    old[crc_at : crc_at + 4] = zlib.crc32(old[:crc_at]).to_bytes(4, "little")
    slot[:] = old
    reader.next = 3
    assert reader.read() is None


def test_what_nobody_wants_is_left_out_and_does_not_count_as_lost():
    memory = ring(8)
    writer, reader = Writer(memory, RECORD, 8), Reader(memory, RECORD, 8)
    for n in range(1, 14):
        writer.write(record(n))
        if n in (3, 12):
            reader.skip()
    assert reader.read_block(9)["n"].tolist() == [13]
    assert reader.lost == 0


def test_the_newest_and_those_before_it():
    memory = ring(8)
    writer, reader = Writer(memory, RECORD, 8), Reader(memory, RECORD, 8)
    assert reader.latest() is None
    for n in range(1, 21):
        writer.write(record(n))
    newest = reader.latest()
    assert newest is not None
    assert newest["n"].tolist() == [20]
    assert reader.before(20, 3)["n"].tolist() == [18, 19, 20]
    assert reader.before(20, 100)["n"].tolist() == list(range(14, 21))
    assert reader.next == 1


def test_a_writer_that_comes_again_goes_on():
    memory = ring(4)
    Writer(memory, RECORD, 4).write(record(1))
    reader = Reader(memory, RECORD, 4, from_start=True)
    Writer(memory, RECORD, 4).write(record(2))
    assert [number_of(data) for data in iter(reader.read, None)] == [1, 2]


def _write_many(path: Path, count: int) -> None:
    writer = StageMemory(path).writer("commands")
    size = writer._record_bytes
    for n in range(1, count + 1):
        writer.write(n.to_bytes(8, "little") * (size // 8))


def test_two_processes_race_and_nothing_torn_comes_through(tmp_path):
    """Each word of a record is its number: a mixture of two would show."""
    memory = StageMemory(tmp_path / "memory", kept_ticks=8)
    reader = memory.reader("commands", from_start=True)
    count = 30_000
    process = multiprocessing.get_context("spawn").Process(target=_write_many, args=(memory.path, count))
    process.start()
    seen = 0
    try:
        while reader.next <= count and (process.is_alive() or reader.newest >= reader.next):
            if (data := reader.read()) is not None:
                words = np.frombuffer(data, "<u8")
                assert (words == reader.next - 1).all()
                seen += 1
    finally:
        process.join(30)
    assert process.exitcode == 0
    assert seen + reader.lost == count
    assert seen > 100


def test_memory_is_nobody_elses_and_not_made_over_a_link(tmp_path):
    path = tmp_path / "memory"
    memory = StageMemory(path, kept_ticks=8)
    assert path.stat().st_mode & 0o777 == 0o600
    memory.stop(17)
    assert int(StageMemory(path).head["stop"][0]) == 17
    (tmp_path / "link").symlink_to(path)
    with pytest.raises(OSError, match="link"):
        StageMemory(tmp_path / "link")
    memory.remove()
    memory.remove()
    assert not path.exists()
