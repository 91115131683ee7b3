"""Writes docs/figures/wafer.png: what the shipped process makes of the shipped drawing, as `pkxyz yield` draws it."""

from pathlib import Path

from hil.pictures.wafer.overview import draw_wafer
from hil.studies.wafer.causes import causes
from hil.studies.wafer.shares import share_of
from hil.studies.wafer.study import WaferStudy
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.fabrication.process import Process

WAFERS = 400


def main() -> None:
    """Draw it."""
    process = load("processes", "oreo_drie", Process)
    study = WaferStudy(process, load("stages", "reconstructed", StageConfig), 1)
    columns = study.columns(range(WAFERS))
    shares = {name.removeprefix("ok."): share_of(columns[name], columns["wafer"]) for name in study.requirement_columns}
    draw_wafer(process, columns, shares, causes(study, 4096), Path(__file__).parents[1] / "wafer.png")


if __name__ == "__main__":
    main()
