"""What the native loop does not wait for, and what it does not take: a writer or a path that comes too late, folders
that are not ours, learning and buses that do not go.
"""

import dataclasses
import os
import shutil
import signal
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from standalone import loop, written
from two_processes import assert_ended_by_the_controller, bench, changes

from hil import cli
from hil.bus.unix_folder import UnsafeFolderError, open_folder
from hil.lanes.ending import Ending
from hil.native.mapped import BLOCKS, RING_BYTES, Mapped
from hil.native.native_rig import NativeRig
from hil.native.program import compiled
from hil.native.ring_recorder import RingRecorder
from hil.recording.recording import Recording
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.export.shared import BLOCK_ROWS
from pkxyz_ctrl.safety.modes import Mode

__all__ = ["bench", "changes"]

TICKS = 1800


class Ran:
    """A run of the native loop in this process, with a file of the given sizes."""

    def __init__(self, bench, out, blocks=BLOCKS, ring_bytes=RING_BYTES, channel=None, before=lambda recorder: None):
        setup = load_scenario(bench / "on_slow.toml").setup()
        can = setup.bus.can if channel is None else setup.bus.can.model_copy(update={"channel": str(channel)})
        setup = dataclasses.replace(setup, bus=setup.bus.model_copy(update={"can": can}))
        mapped = Mapped(blocks, ring_bytes)
        self.path = out / "recording.parquet"
        with Ending() as ending:
            recorder = RingRecorder(mapped, self.path, out / "frames.log", {}, "bus")
            rig = NativeRig(compiled(), setup, can, mapped, recorder, ending)
            try:
                before(recorder)
                rig.wait_for_others(lambda words: None, 30.0)
                rig.start(lambda words: None)
                rig.run()
            finally:
                os.kill(recorder.writer_pid, signal.SIGCONT)
                rig.close()
                recorder.close()
        self.faults, self.lost_rows = tuple(rig.controller.faults), recorder.lost_rows
        self.memory = rig.controller.memory


@pytest.mark.at_rate
def test_a_writer_that_stands_still_costs_rows_which_are_counted_and_no_tick(bench, changes, tmp_path):
    """Room for 80 ticks and a writer that is stopped: the rest is lost, ticks whole, and the recording says so."""
    changes("pre-operational", False)
    ran = Ran(bench, tmp_path, ring_bytes=60_000, before=lambda r: os.kill(r.writer_pid, signal.SIGSTOP))
    assert ran.faults == ()
    recording = Recording.open(ran.path)
    assert 20 < recording.ticks < 200
    assert recording.ticks + ran.lost_rows == TICKS
    assert not recording.whole
    assert (np.diff(recording["tick"]) == 1).all()
    assert ran.memory["tick_index"][0] >= TICKS


@pytest.mark.at_rate
def test_a_path_that_is_not_sampled_in_time_leads_the_stage_down(bench, changes, tmp_path):
    """One block, which is filled anew only when the loop has left it."""
    changes("pre-operational", False)
    ran = Ran(bench, tmp_path, blocks=1)
    assert len(ran.faults) == 1
    assert "not sampled in time" in ran.faults[0]
    recording = Recording.open(ran.path)
    modes, tick = recording["mode"], recording["reference_tick"]
    assert BLOCK_ROWS - 1 <= tick.max() <= BLOCK_ROWS
    assert (modes[-15:] != Mode.FAULT).all()
    assert Mode.LANDING in modes
    assert_ended_by_the_controller(tmp_path / "frames.log")
    assert changes("pre-operational", False)[-2]["driven"]


@pytest.mark.parametrize("kind", ["open", "file", "link", "below"])
def test_a_folder_that_is_not_ours_alone_is_refused_in_the_words_of_python_s_bus(bench, tmp_path, request, kind):
    reached = Path(tempfile.mkdtemp(dir=tempfile.gettempdir()))  # by others, as pytest's own folders are not
    request.addfinalizer(lambda: shutil.rmtree(reached))
    reached.chmod(0o755)
    folder = reached / "above" / "bus"
    folder.parent.mkdir(mode=0o755)
    match kind:
        case "open":
            folder.mkdir()
            folder.chmod(0o770)
        case "file":
            folder.write_text("mine")
        case "link":
            (tmp_path / "elsewhere").mkdir(mode=0o700)
            folder.symlink_to(tmp_path / "elsewhere")
        case "below":
            folder.mkdir(mode=0o700)
            folder.parent.chmod(0o777)
    with pytest.raises(UnsafeFolderError) as expected:
        open_folder(str(folder))
    with pytest.raises(ConfigError) as refused:
        Ran(bench, tmp_path, channel=folder)
    assert str(expected.value) in str(refused.value)
    assert "can.interface 'pkxyz-unix'" in str(refused.value)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--learn", "--bus", "unix_5k"), "learning writes the path while the loop runs"),
        (("--bus", "serial.toml"), "knows pkxyz-unix and socketcan, not 'slcan'"),
        (("--bus", "loud.toml"), "does not know can.options.receive_own_messages"),
    ],
)
def test_what_does_not_go_is_said_in_a_line(bench, capsys, monkeypatch, words, says):
    slow = (bench / "slow.toml").read_text(encoding="utf-8")
    (bench / "serial.toml").write_text(slow.replace('"pkxyz-unix"', '"slcan"'), encoding="utf-8")
    loud = slow.replace("[can.driver]", "[can.options]\nreceive_own_messages = true\n[can.driver]")
    (bench / "loud.toml").write_text(loud, encoding="utf-8")
    monkeypatch.chdir(bench)
    scenario = "circle" if "--learn" in words else "on_slow.toml"
    bus = () if "--bus" in words else ("--bus", "slow.toml")
    monkeypatch.setattr(sys, "argv", ["pkxyz", "run", scenario, "--native", *bus, *words, "--out", "refused"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("pkxyz: ")]
    assert says in line
    assert not (bench / "refused").exists()


def test_a_file_that_is_none_is_refused_in_a_line(bench, tmp_path):
    file = written(tmp_path, load_scenario(bench / "on_slow.toml"))
    content = file.read_bytes()
    for name, damaged, says in (
        ("nothing", b"", "Invalid argument"),  # an empty file can't be mapped
        ("rubbish", b"x" * len(content), "is not what this program goes by"),
        ("other", content[:8] + bytes(8) + content[16:], "was written for another version"),
        ("cut", content[:-1], "is cut short"),
    ):
        (tmp_path / name).write_bytes(damaged)
        done = loop(tmp_path / name)
        assert done.returncode == 2, name
        assert len(done.stderr.splitlines()) == 1
        assert says in done.stderr
    assert "No such file" in loop(tmp_path / "missing").stderr
