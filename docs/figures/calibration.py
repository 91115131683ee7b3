"""Draws docs/figures/calibration.png: the raster on the harsh plant, with the shipped stage file and the found one."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from hil.lanes import in_process as lanes
from hil.lanes.lane import Lane
from hil.lanes.setup import bare_setup
from hil.pictures.style import BLUE, VERMILION, bound, dress, legend, save, sheet
from hil.runs.scenario import load_scenario
from hil.studies.identify.calibrated_stage import write_calibrated_stage
from hil.studies.identify.identification import identify
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import find, load

WINDOW_MS = (330.0, 560.0)
"""Of the reference: a layer and the step to the next one."""

Array = NDArray[np.float64]


def errors_nm(stage: str) -> tuple[Array, Array]:
    """Times (n,) of the reference in ms, and true position less reference (n, 3), while scanning."""
    scenario = load_scenario("raster_harsh", stage=stage, controller="lqg")
    blocks: list[NDArray[np.void]] = []
    lanes.run(scenario.setup(), Lane.FAST, on_block=lambda block: blocks.append(block.copy()))
    rows = np.concatenate(blocks)
    (scan_us,) = [s.scan_us for s in scenario.trajectory.segments if s.scan_us]
    t_us = rows["reference_tick"] * scenario.bus.period_us
    scan = (rows["reference_tick"] >= 0) & (t_us >= scan_us[0]) & (t_us < scan_us[1])
    return t_us[scan] * 1e-3, (rows["position_m"] - rows["reference_m"])[scan] * 1e9


def main() -> None:
    """Identify, run twice, draw."""
    bus, controller = load("buses", "fd_5k", BusConfig), load("controllers", "lqg", ControllerConfig)
    found = identify(bare_setup("reconstructed", "harsh", controller, bus, 1), np.full(3, 12.5e-6), Lane.FAST)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "stage.toml"
        write_calibrated_stage(find("stages", "reconstructed"), found, "figure", path)
        runs = [("as shipped", VERMILION, *errors_nm("reconstructed")), ("as identified", BLUE, *errors_nm(str(path)))]
    figure = sheet(11.0, 6.6, "Raster on the harsh plant, lqg: true position less reference")
    for axis, plot in enumerate(figure.subplots(3, 1, sharex=True)):
        for name, colour, t_ms, error in runs:
            inside = (t_ms >= WINDOW_MS[0]) & (t_ms < WINDOW_MS[1])
            values = error[:, axis]
            label = f"{name}: mean {values.mean():.1f}, about it {values.std():.1f} nm rms"
            plot.plot(t_ms[inside], values[inside], color=colour, lw=0.9, label=label)
        bound(plot, 0.0, style="-")
        plot.set_xlim(*WINDOW_MS)
        dress(plot, "time of the reference (ms)" if axis == 2 else "", f"error in {'xyz'[axis]} (nm)")
        legend(plot, "upper left", columns=2, anchor=(0.0, 1.16))
    save(figure, Path(__file__).with_suffix(".png"))


if __name__ == "__main__":
    main()
