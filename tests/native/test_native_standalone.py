"""The loop in C with nobody beside it: a file says what to do, and a folder holds what happened."""

import can
import numpy as np
import pytest
from standalone import loop, written
from two_processes import assert_ended_by_the_controller, bench, served

from hil.commands.export import run_beside
from hil.recording.recording import Recording
from hil.runs.replay import replay
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.safety.modes import Mode

__all__ = ["bench"]

TICKS = 1800


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


def test_a_simulated_bus_is_refused(bench):
    with pytest.raises(ConfigError, match="is simulated"):
        run_beside(load_scenario("raster"), None)
