"""The loop in C with nobody beside it: a file says what to do, and a folder holds what happened."""

import subprocess

import can
import numpy as np
import pytest
from two_processes import assert_ended_by_the_controller, bench, served

from hil.commands.export import run_beside
from hil.native.program import compiled
from hil.recording.recording import Recording
from hil.runs.replay import replay
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.safety.modes import Mode

__all__ = ["bench"]

TICKS = 1800


def written(folder, scenario):
    """What ``pkxyz export --target linux`` adds for the loop."""
    for name, content in run_beside(scenario, None):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content)
    return folder / "loop.bin"


def loop(*words):
    return subprocess.run([str(compiled()), *map(str, words)], check=False, capture_output=True, text=True, timeout=120)


@pytest.mark.at_rate
def test_it_leaves_a_folder_that_replays_in_every_bit_and_its_file_as_it_was(bench, tmp_path):
    file = written(tmp_path, load_scenario(bench / "on_slow.toml"))
    before = file.read_bytes()
    with served(bench) as changes:
        changes("pre-operational", False)
        for _ in range(2):  # the second run begins as the first did
            done = loop(file)
            assert done.returncode == 0, done.stderr
            assert f"0 of {TICKS} rows lost" in done.stderr
            assert "real time: " in done.stderr
            changes("pre-operational", False)
    assert file.read_bytes() == before
    recording = Recording.open(tmp_path / "run" / "recording.parquet")
    assert recording.ticks == TICKS
    assert (np.diff(recording["tick"]) == 1).all()
    assert (recording["mode"] == Mode.TRACKING).sum() > 1500
    assert replay(tmp_path / "run" / "recording.parquet").differences == []
    frames = list(can.LogReader(tmp_path / "run" / "frames.log"))
    assert sum(frame.arbitration_id == 0x080 for frame in frames) > TICKS
    assert_ended_by_the_controller(tmp_path / "run" / "frames.log")


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


def test_a_simulated_bus_is_refused(bench):
    with pytest.raises(ConfigError, match="is simulated"):
        run_beside(load_scenario("raster"), None)
