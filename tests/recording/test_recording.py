"""Recordings: nothing lost, whatever ends the run; errors in one line; memory flat however long it takes."""

import contextlib
import errno
import os
import shutil
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hil.recording.journal import JournalReader, JournalWriter
from hil.recording.recording import COLUMNS, Recording, RecordingError, RecordingWriter, journal_of, recover
from pkxyz_ctrl.loop.row import ROW, columns

ROOT = Path(__file__).parents[2]


def random_rows(count, seed=0):
    return np.frombuffer(np.random.default_rng(seed).bytes(count * ROW.itemsize), ROW).copy()


def assert_holds(path, rows):
    recording = Recording.open(path)
    assert recording.ticks == len(rows)
    for field in ROW.names:
        # random bytes contain NaN of many kinds: compare bits
        assert recording.vector(field).tobytes() == np.ascontiguousarray(rows[field]).tobytes(), field


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.integers(0, 5000), max_size=6), st.integers(0, 2**32 - 1))
def test_every_bit_comes_back_whatever_the_blocks(tmp_path, sizes, seed):
    rows = random_rows(sum(sizes), seed)
    path = tmp_path / "recording.parquet"
    with RecordingWriter(path, {"seed": seed}) as writer:
        for begin, size in zip(np.cumsum([0, *sizes]), sizes, strict=False):
            writer.write(rows[begin : begin + size])
    assert_holds(path, rows)
    assert Recording.open(path).metadata == {"seed": seed}
    assert not journal_of(path).exists()
    blocks = list(Recording.open(path).blocks(["position_m", "tick"]))
    assert b"".join(b["position_m"].tobytes() for b in blocks) == rows["position_m"].tobytes()
    assert b"".join(b["tick"].tobytes() for b in blocks) == rows["tick"].tobytes()


def test_the_file_is_plain_parquet_with_scalar_columns_that_name_their_units(tmp_path):
    rows = random_rows(3000)
    with RecordingWriter(tmp_path / "r.parquet", {}) as writer:
        writer.write(rows)
    table = pq.read_table(tmp_path / "r.parquet")
    assert table.column_names == list(COLUMNS)
    assert {"t_us", "mode", "reference_x_m", "position_z_m", "estimate_y_m", "voltage_1_v", "sense_3_f"} <= set(COLUMNS)
    assert all(pa.types.is_primitive(t) for t in table.schema.types)
    assert table["voltage_2_v"].to_numpy().tobytes() == np.ascontiguousarray(rows["voltage_v"][:, 1]).tobytes()
    assert len(COLUMNS) == len(set(COLUMNS)) == sum(len(columns(field)) for field in ROW.names)


@pytest.mark.parametrize("ending", [KeyboardInterrupt, RuntimeError, SystemExit])
def test_an_exception_loses_nothing(tmp_path, ending):
    rows = random_rows(5001)
    with pytest.raises(ending), RecordingWriter(tmp_path / "r.parquet", {}) as writer:  # noqa: PT012
        writer.write(rows)
        raise ending
    assert_holds(tmp_path / "r.parquet", rows)


def test_a_killed_program_loses_only_the_batch_in_hand(tmp_path):
    path = tmp_path / "r.parquet"
    program = f"""
        import os, signal, sys
        sys.path[:0] = [{str(ROOT)!r}, *{[str(ROOT / "tests" / room) for room in ("rigs", "recording")]!r}]
        from hil.recording.recording import RecordingWriter
        from test_recording import random_rows
        writer = RecordingWriter({str(path)!r}, {{"seed": 7}})
        writer.write(random_rows(10_000))
        os.kill(os.getpid(), signal.SIGKILL)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], check=False)
    assert done.returncode == -signal.SIGKILL
    assert not path.exists()
    kept = Recording.open(path)
    assert kept.metadata == {"seed": 7}
    assert not kept.whole
    assert 10_000 - 2048 < kept.ticks <= 10_000
    assert_holds(path, random_rows(10_000)[: kept.ticks])
    recover(path)
    assert pq.read_table(path).num_rows == kept.ticks
    assert not Recording.open(path).whole  # Parquet by now, and still cut off
    assert_holds(path, random_rows(10_000)[: kept.ticks])


def test_only_a_recording_that_was_closed_is_whole(tmp_path):
    for ending, whole in ((None, True), (RuntimeError, False)):
        with contextlib.suppress(RuntimeError), RecordingWriter(tmp_path / "r.parquet", {}) as writer:
            writer.write(random_rows(3000))
            assert not Recording.open(tmp_path / "r.parquet").whole
            if ending is not None:
                raise ending
        assert Recording.open(tmp_path / "r.parquet").whole is whole


def test_a_tail_that_is_missing_is_seen_in_whole_parquet_too(tmp_path):
    """Somebody wrote it anew without its last row group: every page is sound, the count of ticks is not."""
    with RecordingWriter(tmp_path / "r.parquet", {}) as writer:
        writer.write(random_rows(20_000))
    table = pq.read_table(tmp_path / "r.parquet")
    pq.write_table(table[:16_384], tmp_path / "cut.parquet")
    assert Recording.open(tmp_path / "r.parquet").whole
    assert not Recording.open(tmp_path / "cut.parquet").whole


@pytest.mark.parametrize("column", ["voltage_2_v", "position_x_m", "tick", "mode"])
def test_one_bit_of_a_page_is_noticed(tmp_path, column):
    """The checksums of the pages: without them a flipped bit is a plausible number."""
    path = tmp_path / "r.parquet"
    with RecordingWriter(path, {}) as writer:
        writer.write(random_rows(3000))
    chunk = pq.ParquetFile(path).metadata.row_group(0).column(COLUMNS.index(column))
    content = bytearray(path.read_bytes())
    content[chunk.data_page_offset + chunk.total_compressed_size // 2] ^= 1
    path.write_bytes(content)
    recording = Recording.open(path)
    field = next(field for field in ROW.names if column in columns(field))
    for read in (lambda: recording[column], lambda: list(recording.blocks([field]))):
        with pytest.raises(RecordingError, match=r"r\.parquet: is damaged: .*(checksum|CRC)"):
            read()


def test_a_journal_counts_the_rows_that_the_system_has(tmp_path):
    writer = JournalWriter(tmp_path / "r.journal", {"seed": 1})
    assert writer.ticks == 0
    for count in (1, 2, 700):
        before = writer.ticks
        writer.append(random_rows(count))
        assert writer.ticks == before + count
    writer.close()
    with pytest.raises(ValueError, match="closed"):
        writer.append(random_rows(1))
    reader = JournalReader(tmp_path / "r.journal")
    assert (reader.ticks, reader.metadata) == (703, {"seed": 1})
    assert reader.rows(1, 3).tobytes() == random_rows(2).tobytes()
    assert len(reader.rows(700, 9_999)) == 3
    assert reader.mapped().tobytes() == reader.rows(0, reader.ticks).tobytes()


def test_each_row_is_the_systems_as_soon_as_it_was_handed_over(tmp_path):
    """Nothing waits in the program, which may end at any moment; and no row is counted that it still has."""
    path = tmp_path / "r.journal"
    writer = JournalWriter(path, {})
    head_bytes = path.stat().st_size
    assert head_bytes > 0
    for count in range(1, 4):
        writer.append(random_rows(1))
        assert path.stat().st_size == head_bytes + count * ROW.itemsize
        assert JournalReader(path).ticks == writer.ticks == count


def test_metadata_that_no_other_program_reads_is_refused_before_a_row_is_written(tmp_path):
    """NaN is none of JSON's numbers."""
    with pytest.raises(ValueError, match="JSON compliant"):
        JournalWriter(tmp_path / "r.journal", {"speed_m_per_s": float("nan")})


@pytest.fixture(scope="module")
def whole_journal(tmp_path_factory):
    path = tmp_path_factory.mktemp("journal") / "r.parquet"
    writer = RecordingWriter(path, {})
    writer.write(random_rows(3 * 2048))
    return journal_of(path).read_bytes()


def test_a_journal_of_other_rows_is_refused_in_words(tmp_path, whole_journal):
    """Rows lie in it as they lay in memory: read by a version whose rows have another layout they would be noise."""
    path = tmp_path / "r.parquet"
    name = next(name for name in ROW.names).encode()
    journal_of(path).write_bytes(whole_journal.replace(b"'" + name + b"'", b"'" + b"x" * len(name) + b"'"))
    for read in (Recording.open, recover):
        with pytest.raises(RecordingError, match="another version"):
            read(path)
    assert journal_of(path).is_file()


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.floats(0, 1) | st.floats(0, 1e-3))
def test_a_journal_cut_anywhere_gives_the_rows_before_the_cut_or_one_clear_error(tmp_path, whole_journal, share):
    path = tmp_path / "r.parquet"
    path.unlink(missing_ok=True)
    cut = int(share * len(whole_journal))
    journal_of(path).write_bytes(whole_journal[:cut])
    head = whole_journal.index(b"\n") + 1
    if cut < head:
        with pytest.raises(RecordingError, match="not a readable recording"):
            Recording.open(path)
        return
    recording = Recording.open(path)
    assert recording.ticks == (cut - head) // ROW.itemsize
    assert not recording.whole
    assert_holds(path, random_rows(3 * 2048)[: recording.ticks])


def test_a_full_disk_is_one_clear_error_and_the_journal_stays_as_it_is(tmp_path):
    path = tmp_path / "r.parquet"
    journal_of(path).symlink_to("/dev/full")
    # the schema alone does not fit, so that already opening may fail
    with pytest.raises(RecordingError, match=os.strerror(errno.ENOSPC).lower()):  # noqa: SIM117
        with RecordingWriter(path, {}) as writer:
            writer.write(random_rows(4096))
    assert not path.exists()


def test_a_disk_that_fills_up_during_the_run_keeps_what_fits(tmp_path):
    path = tmp_path / "r.parquet"
    program = f"""
        import resource, signal, sys
        sys.path[:0] = [{str(ROOT)!r}, *{[str(ROOT / "tests" / room) for room in ("rigs", "recording")]!r}]
        from hil.recording.recording import RecordingError, RecordingWriter
        from test_recording import random_rows
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (3_000_000, 3_000_000))
        try:
            with RecordingWriter({str(path)!r}, {{}}) as writer:
                for _ in range(10):
                    writer.write(random_rows(2048))
        except RecordingError as error:
            print(error)
        writer = RecordingWriter({str(tmp_path / "again.parquet")!r}, {{}})
        for _ in range(10):
            try:
                writer.write(random_rows(1500))
            except RecordingError as error:
                print("again", error)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)], check=True, capture_output=True, text=True, timeout=60
    )  # fmt: skip
    first, *again = done.stdout.splitlines()
    assert len(set(again)) == 1 < len(again)  # the same at each further batch
    assert again[0].startswith("again")
    assert not first.startswith("again")
    assert "cannot go on recording: file too large" in done.stdout
    recording = Recording.open(path)
    head = journal_of(path).read_bytes().index(b"\n") + 1
    assert recording.ticks == (3_000_000 - head) // ROW.itemsize  # every row that fits
    assert f"the first {recording.ticks} ticks are kept" in done.stdout
    assert recording["tick"].tobytes() == np.tile(random_rows(2048)["tick"], 4)[: recording.ticks].tobytes()


def test_what_cannot_be_written_or_read_says_so(tmp_path):
    with pytest.raises(RecordingError, match="no such file or directory"):
        RecordingWriter(tmp_path / "nowhere" / "r.parquet", {})
    with pytest.raises(RecordingError, match="no such recording"):
        Recording.open(tmp_path / "none.parquet")
    (tmp_path / "text.parquet").write_text("not Parquet at all, though long enough to look at")
    with pytest.raises(RecordingError, match=r"text\.parquet: is not a readable recording"):
        Recording.open(tmp_path / "text.parquet")
    pq.write_table(pa.table({"a": [1]}), tmp_path / "foreign.parquet")
    with pytest.raises(RecordingError, match="not a recording of this program"):
        Recording.open(tmp_path / "foreign.parquet")
    with RecordingWriter(tmp_path / "r.parquet", {}) as writer:
        writer.write(random_rows(3000))
    with pytest.raises(RecordingError, match="has no column 'position_m'; it has: t_us"):
        Recording.open(tmp_path / "r.parquet")["position_m"]
    with pytest.raises(RecordingError, match="closed"):
        writer.write(random_rows(1))
    shutil.copy(tmp_path / "r.parquet", tmp_path / "cut.parquet")
    os.truncate(tmp_path / "cut.parquet", 100_000)
    with pytest.raises(RecordingError, match="not a readable recording"):
        Recording.open(tmp_path / "cut.parquet")


def peak_mb(path, ticks):
    """Peak memory in MB of a program that records ``ticks`` ticks and closes the recording."""
    program = f"""
        import sys
        sys.path[:0] = [{str(ROOT)!r}, *{[str(ROOT / "tests" / room) for room in ("rigs", "recording")]!r}]
        from hil.recording.recording import RecordingWriter
        from test_recording import random_rows
        block = random_rows(4096)
        with RecordingWriter({str(path)!r}, {{}}) as writer:
            for _ in range({ticks} // 4096):
                writer.write(block)
        status = dict(line.split(":", 1) for line in open("/proc/self/status"))
        print(int(status["VmHWM"].split()[0]) / 1024)  # of this program alone; ru_maxrss also knows its parent's
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)], check=True, capture_output=True, text=True
    )  # fmt: skip
    return float(done.stdout)


def test_memory_does_not_grow_with_the_length_of_the_run(tmp_path):
    short, long = peak_mb(tmp_path / "a.parquet", 50_000), peak_mb(tmp_path / "b.parquet", 250_000)
    rows_mb = 200_000 * ROW.itemsize / 2**20
    assert long - short < 0.4 * rows_mb
    assert long < 500


@pytest.mark.slow
def test_ten_minutes_at_5_khz_stay_below_500_mb(tmp_path):
    path = tmp_path / "long.parquet"
    assert peak_mb(path, 3_000_000) < 500
    assert Recording.open(path).ticks > 2_990_000


def test_a_recording_is_written_and_read_without_pandas(tmp_path):
    """Where it is installed, pyarrow would load it to ask after series, and that takes longer than a run."""
    code = "import sys\nfrom hil.cli import main\ntry: main()\nfinally: print('pandas' in sys.modules, file=sys.stderr)"
    words = ["sil", "steps", "--lane", "fast", "--out", str(tmp_path / "run"), "--json"]
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr.splitlines()[-1] == "False"
