"""Writes docs/figures/wafer.png and wafer_loops.png: what the shipped process makes of the shipped drawing, as `pkxyz
yield` draws it, and the loops' figures in wafer.json.
"""

import json
import tempfile
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from hil.pictures.wafer.loops import draw_loops
from hil.pictures.wafer.overview import draw_wafer
from hil.runs.scenario import load_scenario
from hil.studies.wafer.causes import causes
from hil.studies.wafer.closed_loop import PART_DEVICES, ClosedLoops
from hil.studies.wafer.loop_causes import LoopCauses
from hil.studies.wafer.shares import share_of
from hil.studies.wafer.study import Parts, WaferStudy, run_study
from hil.studies.wafer.table import Table
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.fabrication.process import Process
from pkxyz_ctrl.io.realtime import cores

WAFERS, LOOPS, LOOP_CAUSES = 400, 400, 128
FOLDER = Path(__file__).parents[1]


def main() -> None:
    """Draw them."""
    process = load("processes", "oreo_drie", Process)
    study = WaferStudy(process, load("stages", "reconstructed", StageConfig), 1)
    columns = study.columns(range(WAFERS))
    shares = {name.removeprefix("ok."): share_of(columns[name], columns["wafer"]) for name in study.requirement_columns}
    draw_wafer(process, columns, shares, causes(study, 4096), FOLDER / "wafer.png")
    asked = ClosedLoops(study, load_scenario("raster"), known=True, identified=True)
    _ = asked.mean_modes  # once here, not in each worker
    moved = LoopCauses(replace(asked, identified=False))
    with tempfile.TemporaryDirectory() as folder:
        rows = worked(asked, LOOPS // PART_DEVICES, Path(folder, "loops")).read(
            ["wafer", "handle_m", *asked.columns, *asked.verdict_columns], LOOPS
        )
        found = moved.found(worked(moved, moved.parts_for(LOOP_CAUSES), Path(folder, "causes")))
    shares = {name.removeprefix("ok."): share_of(rows[name], rows["wafer"]) for name in asked.verdict_columns}
    draw_loops(asked, rows, shares, found, FOLDER / "wafer_loops.png")
    kept = {
        "devices": LOOPS,
        "shares": {name: asdict(share) for name, share in shares.items()},
        "percentiles_50_95_100": {name: np.percentile(rows[name], [50, 95, 100]).tolist() for name in asked.columns},
        "least_rejection_hz": {law: float(rows[f"{law}.rejection_hz"].min()) for law in asked.laws},
        "total_index_and_error": None if found is None else found.as_json(),
    }
    Path(__file__).with_suffix(".json").write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")


def worked(asked: Parts, parts: int, folder: Path) -> Table:
    """Its table, on all cores."""
    table = Table(folder, "")
    run_study(asked, parts, table, cores())
    return table


if __name__ == "__main__":
    main()
