"""The frame log: every tool that claims to read candump logs reads it, and it is whole whenever it is looked at."""

import subprocess
import sys
from pathlib import Path

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.bus.clock import Lockstep
from hil.bus.frame_log import BLOCK_FRAMES, FrameLog
from hil.bus.frame_time import FD_LENGTHS
from hil.bus.sim_bus import to_frame
from hil.bus.wire import Wire
from pkxyz_ctrl.can.frame import Frame

data_of_any_length = st.sampled_from(FD_LENGTHS).flatmap(lambda n: st.binary(min_size=n, max_size=n))
frames = st.one_of(
    st.tuples(st.integers(0, 2047), st.binary(max_size=8)).map(lambda f: Frame(*f)),
    st.tuples(st.integers(0, 2**29 - 1), st.binary(max_size=8)).map(lambda f: Frame(*f, is_extended=True)),
    st.tuples(st.integers(0, 2047), data_of_any_length, st.booleans()).map(lambda f: Frame(f[0], f[1], True, f[2])),
    st.tuples(st.integers(0, 2047), st.integers(0, 8)).map(lambda f: Frame(f[0], bytes(f[1]), is_remote=True)),
)


@given(rows=st.lists(st.tuples(st.integers(0, 10**10), frames), max_size=30))
@settings(max_examples=60)
def test_python_can_reads_back_every_frame(tmp_path_factory: pytest.TempPathFactory, rows: list) -> None:
    path = tmp_path_factory.mktemp("log") / "frames.log"
    with FrameLog(path, "sim0") as log:
        for t_us, frame in rows:
            log.record(frame, t_us)
    messages = list(can.LogReader(path))
    assert [to_frame(m) for m in messages] == [frame for _, frame in rows]
    assert [round(m.timestamp * 1e6) for m in messages] == [t_us for t_us, _ in rows]
    assert log.frames == len(rows)


def test_literal_lines(tmp_path: Path) -> None:
    with FrameLog(tmp_path / "x.log", "sim0") as log:
        log.record(Frame(0x28A, bytes.fromhex("00ff7fabcd")), 1_000_200)
        log.record(Frame(0x30A, b"\xde\xad", True, True), 3)
        log.record(Frame(0x7F, b"", True), 61_000_004)
        log.record(Frame(0x1ABCDEF, b"", is_extended=True), 5)
        log.record(Frame(0x123, b"", is_remote=True), 6)
        log.record(Frame(0x040, bytes((0, 0, 0, 0, 0, 0, 255, 3)), is_error=True), 7)
    assert (tmp_path / "x.log").read_text().splitlines() == [
        "(1.000200) sim0 28A#00FF7FABCD",
        "(0.000003) sim0 30A##1DEAD",
        "(61.000004) sim0 07F##0",
        "(0.000005) sim0 01ABCDEF#",
        "(0.000006) sim0 123#R",
        "(0.000007) sim0 200000C0#000000000000FF03",
    ]


def test_it_logs_the_wire_with_error_frames_and_is_no_node(tmp_path: Path) -> None:
    clock = Lockstep()
    wire = Wire(clock, 1_000_000, 5_000_000)
    a, _ = wire.attach("a"), wire.attach("b")
    with FrameLog(tmp_path / "frames.log", "sim0") as log:
        log.attach(wire)
        wire.disturbance.corrupt_next()
        a.send(Frame(0x30A, bytes(8), True, True))
        clock.run_until(1000)
    a.send(Frame(0x30A, bytes(8), True, True))
    clock.run_until(2000)  # after the log was closed
    messages = list(can.CanutilsLogReader(tmp_path / "frames.log"))
    assert [m.is_error_frame for m in messages] == [True, False]
    assert (messages[1].arbitration_id, messages[1].is_fd, messages[1].bitrate_switch) == (0x30A, True, True)


def test_full_blocks_are_on_disk_at_once_and_in_whole_lines(tmp_path: Path) -> None:
    path = tmp_path / "frames.log"
    log = FrameLog(path, "sim0")
    for k in range(BLOCK_FRAMES * 2 + 5):
        log.record(Frame(0x123, k.to_bytes(4, "big")), k)
    text = path.read_text()  # as another process would find it, if this one were killed now
    assert text.endswith("\n")
    assert len(text.splitlines()) == BLOCK_FRAMES * 2
    log.close()
    log.close()
    assert len(path.read_text().splitlines()) == BLOCK_FRAMES * 2 + 5


def test_an_error_in_the_run_leaves_what_was_recorded(tmp_path: Path) -> None:
    def run() -> None:
        with FrameLog(tmp_path / "frames.log", "sim0") as log:
            log.record(Frame(1, b"\x01"), 1)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run()
    assert (tmp_path / "frames.log").read_text() == "(0.000001) sim0 001#01\n"


def test_cantools_on_the_command_line_decodes_it(tmp_path: Path) -> None:
    dbc = tmp_path / "drive.dbc"
    dbc.write_text('VERSION ""\nBU_: A\nBO_ 778 Drive: 2 A\n SG_ volt : 0|16@1- (0.5,0) [-200|200] "V" A\n')
    with FrameLog(tmp_path / "frames.log", "sim0") as log:
        log.record(Frame(778, (260).to_bytes(2, "little")), 12)
        log.record(Frame(778, (-3).to_bytes(2, "little", signed=True), True, True), 13)
    command = [sys.executable, "-m", "cantools", "decode", "--single-line", str(dbc)]
    done = subprocess.run(
        command, input=(tmp_path / "frames.log").read_text(), capture_output=True, text=True, timeout=600, check=True
    )
    assert "Drive(volt: 130.0 V)" in done.stdout
    assert "Drive(volt: -1.5 V)" in done.stdout
