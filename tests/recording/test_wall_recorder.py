"""The recorder's other process, and that a loop at rate neither grows nor loses a row."""

import dataclasses
import os
import signal
import subprocess
import sys
import time
import tracemalloc
from pathlib import Path

import can
import numpy as np
import pytest
from patience import PUNCTUALITY, patient_bus, patient_law

from hil.bus.frame_log import FrameLog
from hil.lanes.ending import Ending
from hil.lanes.lane import Lane
from hil.lanes.wall import WallRig
from hil.recording.recording import Recording, RecordingError, journal_of
from hil.recording.wall_recorder import _PIPE_BYTES, _WAITING_MAX_BYTES, WallRecorder
from hil.runs.run_folder import RunFolder, metadata_of
from hil.runs.scenario import load_scenario, resolve
from hil.studies import latency
from hil.studies.latency import measure, read_cyclictest
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Mode

pytestmark = pytest.mark.at_rate

ROOT = Path(__file__).parents[2]


@pytest.fixture
def folder(tmp_path):
    return RunFolder(tmp_path / "run")


def metadata(**changes):
    scenario = load_scenario("raster", bus="unix_2k")
    return metadata_of(scenario, Lane.WALL, resolve(scenario)) | changes


def random_rows(count, seed=1):
    rows = np.zeros(count, ROW)
    rng = np.random.default_rng(seed)
    rows["tick"] = np.arange(count)
    for name in ("estimate_m", "voltage_v"):
        rows[name] = rng.normal(size=(count, 3))
    return rows


FRAMES = (
    Frame(0x80, b"\x01", True, True),
    Frame(0x28A, bytes(range(8))),
    Frame(0x1234567, bytes(64), True, is_extended=True),
    Frame(0x7FF, b"", is_remote=True),
)


def test_rows_and_frames_arrive_as_if_written_here(folder, tmp_path):
    rows = random_rows(5000)
    recorder = WallRecorder(folder.recording, folder.frames, metadata(), "bus")
    with FrameLog(tmp_path / "here.log", "bus") as here:
        for index in range(len(rows)):
            frame = FRAMES[index % len(FRAMES)]
            recorder.frame(frame, 7 * index)
            here.record(frame, 7 * index)
            recorder.row(rows[index : index + 1].view(np.uint8).data)
    recorder.close()
    recorder.close()
    assert recorder.lost_bytes == 0
    recording = Recording.open(folder.recording)
    assert recording.ticks == len(rows)
    assert recording.whole
    for name in ("tick", "estimate_m", "voltage_v"):
        assert np.array_equal(recording.vector(name), rows[name])
    assert folder.frames.read_bytes() == (tmp_path / "here.log").read_bytes()
    assert len(list(can.LogReader(folder.frames))) == len(rows)


def test_a_writer_that_fails_says_why_and_stops_the_loop(folder):
    folder.path.joinpath("frames.log").mkdir()  # cannot be opened as a file
    recorder = WallRecorder(folder.recording, folder.frames, metadata(), "bus")
    row = random_rows(1).view(np.uint8).data

    def go_on():  # which row meets the closed pipe is not known
        for _ in range(100_000):
            recorder.row(row)

    with pytest.raises(RecordingError, match="directory"):
        go_on()
    recorder.close()


def test_rows_survive_a_kill_of_the_loop(tmp_path):
    script = (
        "import os, sys; from pathlib import Path; sys.path[:0] = ['tests/rigs', 'tests/recording']\n"
        "import numpy as np; from test_wall_recorder import *\n"
        "folder = RunFolder(Path(sys.argv[1]))\n"
        "recorder = WallRecorder(folder.recording, folder.frames, metadata(), 'bus'); rows = random_rows(300)\n"
        "for index in range(300): recorder.row(rows[index : index + 1].view(np.uint8).data)\n"
        "os.kill(os.getpid(), 9)\n"
    )
    words = [sys.executable, "-c", script, str(tmp_path / "run")]
    done = subprocess.run(
        words, cwd=ROOT, check=False, capture_output=True, env=os.environ
    )  # waits for the writer, too
    assert done.returncode == -9, done.stderr
    recording = Recording.open(tmp_path / "run" / "recording.parquet")
    assert recording["tick"].tolist() == list(range(300))
    assert not recording.whole  # nobody said that these are all


def sent(recorder, rows):
    """Hands over rows one by one, as a loop does."""
    for index in range(len(rows)):
        recorder.row(rows[index : index + 1].view(np.uint8).data)


def test_a_writer_that_is_killed_is_told_and_all_but_its_last_block_opens(folder):
    """kill -9 of the recorder: no whole recording, but a readable one, and a word about it."""
    recorder, rows = WallRecorder(folder.recording, folder.frames, metadata(), "bus"), random_rows(100_000)
    sent(recorder, rows[:500])
    while not journal_of(folder.recording).is_file() or Recording.open(folder.recording).ticks < 500:
        time.sleep(0.06)
        recorder.frame(FRAMES[0], 0)  # what waits is handed on when something comes
        sent(recorder, rows[500:501])
        rows[500:-1] = rows[501:]
    os.kill(recorder.writer_pid, signal.SIGKILL)
    with pytest.raises(RecordingError, match=r"the process that writes it was killed by signal 9; what it had written"):
        sent(recorder, rows[501:])
    recorder.close()
    recording = Recording.open(folder.recording)
    assert recording.ticks >= 500
    assert recording["tick"].tolist() == list(range(recording.ticks))
    assert not recording.whole
    assert len(list(can.LogReader(folder.frames))) > 0


def test_what_the_writer_was_too_slow_for_is_said_in_the_recording(folder):
    recorder, rows = WallRecorder(folder.recording, folder.frames, metadata(), "bus"), random_rows(45_000)
    os.kill(recorder.writer_pid, signal.SIGSTOP)
    sent(recorder, rows)  # 20 MB, which is more than may wait
    assert recorder.lost_bytes > 0
    os.kill(recorder.writer_pid, signal.SIGCONT)
    recorder.close()
    recording = Recording.open(folder.recording)
    assert 0 < recording.ticks < len(rows)
    assert np.isin(recording["tick"], rows["tick"]).all()
    assert not recording.whole


class Watched(WallRecorder):
    """Notes the memory in use, as Python has it, every 250 ticks."""

    def __init__(self, folder, metadata, channel):
        super().__init__(folder.recording, folder.frames, metadata, channel)
        self.ticks = 0
        self.in_use = np.zeros(100, np.int64)  # made before, so that noting takes no memory

    def row(self, row):
        super().row(row)
        self.ticks += 1
        if self.ticks % 250 == 0:
            self.in_use[self.ticks // 250] = tracemalloc.get_traced_memory()[0]


def test_after_warm_up_nothing_grows(tmp_path, folder):
    """Controller, port, bus, clock and recorder, for 3000 ticks under tracemalloc: a reference kept per tick would be
    8 bytes of each, 2 kB in 250 ticks.
    """
    bus = patient_bus(tmp_path / "bus.toml")
    scenario = load_scenario("raster", bus=str(bus), controller=str(patient_law(tmp_path, "youla")))
    scenario.config.__dict__["duration_s"] = 3.0
    setup = scenario.setup()
    words = [sys.executable, "-m", "hil.cli", "plant", "--bus", str(bus)]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=env) as plant:
        try:
            assert "pre-operational" in plant.stdout.readline()
            recorder = Watched(folder, metadata(), "bus")
            with Ending() as ending:
                rig = WallRig(setup, recorder, ending)
                rig.start()
                tracemalloc.start()
                try:
                    rig.run()
                finally:
                    tracemalloc.stop()
                    rig.close()
                    recorder.close()
        finally:
            plant.terminate()
    in_use = recorder.in_use[4:13]  # from tick 1000 on
    assert (in_use > 0).all()
    assert np.median(np.diff(in_use)) < 500, in_use  # what is kept each tick shows in each interval
    assert np.ptp(in_use) < 40_000, in_use  # what happens for the first time, as a missed tick does, costs once
    assert Recording.open(folder.recording).ticks == 3000


def test_latency_counts_every_tick_and_the_controller_has_really_controlled(monkeypatch):
    """Monitors that a stalled machine sets off are off: how punctual it is, is measured here and not tested."""
    real = latency._setup

    def patient(period_us, seconds):
        setup = real(period_us, seconds)
        counts = {f"{name}_count": -1 for name in PUNCTUALITY}
        monitors = setup.controller.monitors.model_copy(update=counts)
        return dataclasses.replace(setup, controller=setup.controller.model_copy(update={"monitors": monitors}))

    monkeypatch.setattr(latency, "_setup", patient)
    measured = measure(2000, 0.6, "/bin/true")
    assert measured.ticks == 300
    assert sum(measured.cycle_us) == 300
    assert sum(measured.lateness_us) >= 300
    assert measured.cyclictest_us is None
    figures = measured.figures()
    assert 1 <= figures["cycle_us"]["p50"] < 2000
    assert figures["lateness_us"]["p50"] <= figures["lateness_us"]["p99_9"] <= figures["lateness_us"]["max"]
    assert measured.mode == Mode.TRACKING
    for period_us, seconds in ((50, 1.0), (200, 0.0), (200, 61.0)):
        with pytest.raises(ConfigError, match="is not in"):
            measure(period_us, seconds)


def test_cyclictest_is_read_as_it_prints():
    text = (
        "# Histogram\n000000 000000\n000003 000041\n000012 000002\n# Total: 000000043\n# Histogram Overflows: 00002\n"
    )
    counts = read_cyclictest(text)
    assert {us: n for us, n in enumerate(counts) if n} == {3: 41, 12: 2, 1999: 2}
    assert read_cyclictest("policy: fifo\n") is None


def test_rows_that_the_writer_is_too_slow_for_are_counted(folder):
    """The writer stands still until pipe and patience are full. Each row that is not in the file has been counted."""
    recorder = WallRecorder(folder.recording, folder.frames, metadata(), "bus")
    row = random_rows(1)
    data, sent = row.view(np.uint8).data, 2 * (_WAITING_MAX_BYTES + _PIPE_BYTES) // ROW.itemsize
    os.kill(recorder.writer_pid, signal.SIGSTOP)
    for tick in range(sent):
        row["tick"] = tick
        recorder.row(data)
    os.kill(recorder.writer_pid, signal.SIGCONT)
    recorder.close()
    kept = Recording.open(folder.recording)["tick"]
    assert 0 < recorder.lost_rows == sent - len(kept)
    assert recorder.lost_bytes == recorder.lost_rows * (1 + ROW.itemsize)
    assert (np.diff(kept) >= 1).all()
