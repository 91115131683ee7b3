"""Writes docs/figures/learning.png: what a run of ``frames_harsh`` learns."""

import shutil
import tempfile
from pathlib import Path

from hil.lanes.lane import Lane
from hil.pictures.run import draw
from hil.runs.run import run_into
from hil.runs.run_folder import RunFolder
from hil.runs.scenario import load_scenario

if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        folder = RunFolder(Path(scratch) / "frames")
        draw(folder, run_into(folder, load_scenario("frames_harsh"), Lane.FAST, lambda done, total: None))
        shutil.copy(folder.learning_picture, Path(__file__).with_suffix(".png"))
