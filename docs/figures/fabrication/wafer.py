"""Writes docs/figures/wafer.png and wafer_loops.png: what the shipped process makes of the shipped drawing, as `pkxyz
yield` draws it.
"""

from pathlib import Path

import numpy as np

from hil.pictures.wafer.loops import draw_loops
from hil.pictures.wafer.overview import draw_wafer
from hil.runs.scenario import load_scenario
from hil.studies.wafer.causes import causes
from hil.studies.wafer.closed_loop import PART_DEVICES, ClosedLoops
from hil.studies.wafer.shares import share_of
from hil.studies.wafer.study import WaferStudy
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.fabrication.process import Process

WAFERS, LOOPS = 400, 400
FOLDER = Path(__file__).parents[1]


def main() -> None:
    """Draw them."""
    process = load("processes", "oreo_drie", Process)
    study = WaferStudy(process, load("stages", "reconstructed", StageConfig), 1)
    columns = study.columns(range(WAFERS))
    shares = {name.removeprefix("ok."): share_of(columns[name], columns["wafer"]) for name in study.requirement_columns}
    draw_wafer(process, columns, shares, causes(study, 4096), FOLDER / "wafer.png")
    asked = ClosedLoops(study, load_scenario("raster"), known=True, identified=True)
    parts = [asked.part(number) for number in range(LOOPS // PART_DEVICES)]
    rows = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    shares = {name.removeprefix("ok."): share_of(rows[name], rows["device"]) for name in asked.verdict_columns}
    draw_loops(asked, rows, shares, FOLDER / "wafer_loops.png")


if __name__ == "__main__":
    main()
