"""Writes docs/figures/calibration.png: the raster on the harsh plant, with the stage as drawn and as identified."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hil.lanes import in_process as lanes
from hil.lanes.lane import Lane
from hil.lanes.setup import bare_setup
from hil.runs.scenario import load_scenario
from hil.studies.identify.calibrated_stage import write_calibrated_stage
from hil.studies.identify.identification import identify
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import find, load

ORANGE, BLUE, GREY = "#d55e00", "#0072b2", "#9aa5ad"
WINDOW_MS = (330.0, 560.0)
"""Of the reference: a layer and the step to the next one."""

Array = NDArray[np.float64]


def errors_nm(stage: str) -> tuple[Array, Array]:
    """Times (n,) of the reference in ms, and true position less reference (n, 3), while scanning."""
    scenario = load_scenario("raster_harsh", stage=stage)
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
    found = identify(bare_setup("reconstructed", "harsh", controller, bus, 1), np.full(3, 12.5e-6), "fast")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "stage.toml"
        write_calibrated_stage(find("stages", "reconstructed"), found, "figure", path)
        runs = [("as drawn", ORANGE, *errors_nm("reconstructed")), ("as identified", BLUE, *errors_nm(str(path)))]
    figure = Figure(figsize=(11.0, 6.6), layout="constrained", dpi=120)
    FigureCanvasAgg(figure)
    for axis, plot in enumerate(figure.subplots(3, 1, sharex=True)):
        for name, colour, t_ms, error in runs:
            inside = (t_ms >= WINDOW_MS[0]) & (t_ms < WINDOW_MS[1])
            values = error[:, axis]
            label = f"{name}: mean {values.mean():.1f}, about it {values.std():.1f} nm rms"
            plot.plot(t_ms[inside], values[inside], color=colour, lw=0.9, label=label)
        plot.axhline(0.0, color=GREY, lw=0.8, zorder=0)
        plot.set(ylabel=f"error in {'xyz'[axis]} (nm)", xlim=WINDOW_MS)
        plot.spines[["top", "right"]].set_visible(False)
        plot.legend(frameon=False, fontsize=9, loc="upper left", ncols=2, bbox_to_anchor=(0.0, 1.16))
    plot.set_xlabel("time of the reference (ms)")
    figure.suptitle("Raster on the harsh plant, lqg: true position less reference", fontsize=12)
    figure.savefig(Path(__file__).with_suffix(".png"))


if __name__ == "__main__":
    main()
