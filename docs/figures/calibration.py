"""Draws docs/figures/calibration.png: the raster on the harsh plant under the default law, with the shipped stage file,
with what an identification and an instrument outside have found, and counted from that one's origin.
"""

import dataclasses
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from hil.lanes import in_process as lanes
from hil.lanes.lane import Lane
from hil.lanes.setup import Setup, bare_setup
from hil.pictures.style import BLUE, GREEN, VERMILION, bound, dress, legend, save, sheet
from hil.runs.scenario import load_scenario
from hil.studies.identify.calibrated_stage import write_calibrated_stage
from hil.studies.identify.identification import identify
from hil.studies.identify.outside_scale import outside_scale
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import find, load
from pkxyz_ctrl.stage import Stage
from pkxyz_ctrl.trajectory import Hold, Move, Trajectory

WINDOW_MS = (330.0, 560.0)
"""Of the reference: a layer and the step to the next one."""

HELD_UM = np.array([[0, 0, 10], [2, 0, 18], [-2, 1, 18], [0, -2, 24], [1, 1.5, 21], [0, 0, 19.25]])
"""Where an instrument sees the table."""

Array = NDArray[np.float64]


def recorded(setup: Setup, trajectory: Trajectory) -> tuple[NDArray[np.int64], NDArray[np.void]]:
    """Times (n,) of the reference in us, and rows (n,), of a run along another trajectory."""
    setup = dataclasses.replace(setup, trajectory=trajectory, duration_s=trajectory.duration_us * 1e-6 + 0.3)
    blocks: list[NDArray[np.void]] = []
    lanes.run(setup, Lane.FAST, on_block=lambda block: blocks.append(block.copy()))
    rows = np.concatenate(blocks)
    rows = rows[rows["reference_tick"] >= 0]
    return rows["reference_tick"] * setup.bus.period_us, rows


def errors_nm(stage: str, rests_m: Array) -> tuple[Array, Array]:
    """Times (n,) of the reference in ms, and true position less reference (n, 3), while scanning; set-points count from
    where the stage rests (3,).
    """
    scenario = load_scenario("raster_harsh", stage=stage)
    segments = [
        s.model_copy(update={"to_m": tuple(s.to_m - rests_m)}) if isinstance(s, Move) else s
        for s in scenario.config.reference
    ]
    trajectory = Trajectory(segments)
    t_us, rows = recorded(scenario.setup(), trajectory)
    (scan_us,) = [s.scan_us for s in trajectory.segments if s.scan_us]
    scan = (t_us >= scan_us[0]) & (t_us < scan_us[1])
    return t_us[scan] * 1e-3, (rows["position_m"] - rows["reference_m"] - rests_m)[scan] * 1e9


def seen_m(setup: Setup) -> Array:
    """True mean positions (n, 3) at ``HELD_UM``: what an ideal instrument sees whose origin is the drawn rest."""
    segments: list[Move | Hold] = []
    for x, y, z in HELD_UM * 1e-6:
        segments.append(Move(kind="move", to_m=(x, y, z), velocity_max_m_per_s=1e-3, acceleration_max_m_per_s2=0.1,
                             jerk_max_m_per_s3=1e2))  # fmt: skip
        segments.append(Hold(kind="hold", duration_s=0.1, settle_s=0.05))
    trajectory = Trajectory(segments)
    t_us, rows = recorded(setup, trajectory)
    stills = [s.still_us for s in trajectory.segments if s.still_us]
    return np.array([rows["position_m"][(t_us >= a) & (t_us < b)].mean(axis=0) for a, b in stills])


def main() -> None:
    """Identify, see, run three times, draw."""
    bus, controller = load("buses", "fd_5k", BusConfig), load("controllers", "lqg", ControllerConfig)
    setup = bare_setup("reconstructed", "harsh", controller, bus, 1)
    found = identify(setup, np.full(3, 12.5e-6), Lane.FAST)
    watched = dataclasses.replace(setup, seed=3)
    outside = outside_scale(Stage(setup.stage), HELD_UM * 1e-6, seen_m(watched))
    with TemporaryDirectory() as folder:
        instrument = Path(folder) / "stage.toml"
        write_calibrated_stage(
            find("stages", "reconstructed"), dataclasses.replace(found, outside=outside), "figure", instrument
        )
        runs = [
            ("as shipped", VERMILION, *errors_nm("reconstructed", np.zeros(3))),
            ("with an instrument", BLUE, *errors_nm(str(instrument), np.zeros(3))),
            ("from its origin", GREEN, *errors_nm(str(instrument), outside.origin_m)),
        ]
    figure = sheet(11.0, 6.6, "Raster on the harsh plant, youla: true position less reference")
    for axis, plot in enumerate(figure.subplots(3, 1, sharex=True)):
        for name, colour, t_ms, error in runs:
            shown = (t_ms >= WINDOW_MS[0]) & (t_ms < WINDOW_MS[1])
            values = error[:, axis]
            label = f"{name}: {values.mean():.1f} +- {values.std():.1f} nm"
            plot.plot(t_ms[shown], values[shown], color=colour, lw=0.9, label=label)
        bound(plot, 0.0, style="-")
        plot.set_xlim(*WINDOW_MS)
        dress(plot, "time of the reference (ms)" if axis == 2 else "", f"error in {'xyz'[axis]} (nm)")
        legend(plot, "upper left", columns=3, anchor=(0.0, 1.16))
    save(figure, Path(__file__).with_suffix(".png"))


if __name__ == "__main__":
    main()
