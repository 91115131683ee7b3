"""A disk that is full, or may not be written: one line, exit code 2, and what was written before stays readable."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hil.lanes.lane import Lane
from hil.pictures.run import draw
from hil.recording.recording import Recording, RecordingError
from hil.runs.run import run_into
from hil.runs.run_folder import FRAMES, PICTURE, SUMMARY, RunFolder
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.config.files import ConfigError

ROOT = Path(__file__).parents[2]


def pkxyz(*words, file_limit_bytes=None):
    """Run ``pkxyz`` in a process in which no file may grow beyond a size; the kernel refuses what is beyond it."""
    limit = (
        "" if file_limit_bytes is None else f"resource.setrlimit(resource.RLIMIT_FSIZE, ({file_limit_bytes},) * 2); "
    )
    script = f"import resource, sys; {limit}from hil.cli import main; sys.argv[0] = 'pkxyz'; main()"
    return subprocess.run(
        [sys.executable, "-c", script, *map(str, words)], text=True, check=False, capture_output=True, timeout=1200,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip


def test_sil_on_a_full_disk_says_so_in_one_line_and_what_was_written_opens(tmp_path):
    whole = pkxyz("sil", "raster", "--out", tmp_path / "whole")  # kernels that are kept are no small files
    assert whole.returncode == 0, whole.stderr
    done = pkxyz("sil", "raster", "--out", tmp_path / "full", file_limit_bytes=2_200_000)
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = [line for line in done.stderr.splitlines() if line]
    assert line.startswith("pkxyz: ")
    assert "file too large" in line
    recording = Recording.open(tmp_path / "full" / "recording.parquet")
    assert recording.ticks >= 4096
    assert np.array_equal(recording["tick"], np.arange(recording.ticks))
    assert np.isfinite(recording.vector("position_m")).all()


@pytest.mark.parametrize("command", [("sil", "raster"), ("soak", "--minutes", "0.01"), ("faults", "--only", "shock")])
def test_a_folder_that_may_not_be_written_is_refused_before_anything_runs(command):
    done = pkxyz(*command, "--out", "/proc/nowhere/run")
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("pkxyz: --out: /proc/nowhere/run: ")


@pytest.mark.parametrize("name", [FRAMES, SUMMARY, PICTURE])
def test_whichever_file_meets_the_end_of_the_disk_the_recording_beside_it_opens(tmp_path, name):

    class OnAFullDisk(RunFolder):
        def write_config(self, scenario):
            (self.path / name).symlink_to("/dev/full")
            return super().write_config(scenario)

    folder = OnAFullDisk(tmp_path / "run")
    with pytest.raises((ConfigError, RecordingError), match="no space left on device"):
        draw(folder, run_into(folder, load_scenario("raster"), Lane.LOCKSTEP))
    recording = Recording.open(folder.recording)
    assert recording.ticks > (0 if name == FRAMES else 5000)
    assert np.array_equal(recording["tick"], np.arange(recording.ticks))
