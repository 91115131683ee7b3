"""Writes docs/figures/raster.png, the picture of the README: what ``pkxyz sil`` leaves behind."""

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
        folder = RunFolder(Path(scratch) / "raster")
        draw(folder, run_into(folder, load_scenario("raster"), Lane.LOCKSTEP))
        shutil.copy(folder.picture, Path(__file__).with_suffix(".png"))
