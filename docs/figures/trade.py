"""Draws docs/figures/trade.png: what rejection costs in noise at hold, for the best of all filters, stage as drawn."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from hil.pictures.style import BLUE, GREEN, MUTED, VERMILION, bound, dress, legend, save, sheet
from hil.studies.tune.taps import without_filter
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.design.hold_floor import hold_floor_m
from pkxyz_ctrl.design.hold_noise import rounding_force_n
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.laws.estimator_gain import measurement_noise, shaken_covariance
from pkxyz_ctrl.design.laws.youla import Bounds, InnovationLoop, Noise, youla_taps
from pkxyz_ctrl.design.lqg_equivalent import lqg_equivalent, seen_by
from pkxyz_ctrl.design.model.discrete_law import LawError
from pkxyz_ctrl.design.model.loop_plant import loop_plant
from pkxyz_ctrl.design.model.plant_model import linearise
from pkxyz_ctrl.stage import Stage

EDGES_HZ = (20.0, 40.0, 70.0, 100.0, 130.0, 160.0, 190.0, 202.0, 220.0)
LINES = ((10.0, 10 ** (-34 / 20)), (50.0, 10 ** (-20 / 20)))
SHAKEN_M_PER_S2 = 98.1e-6


def draw() -> Figure:
    """Axis x. Left: least deviation at hold over the edge of rejection, also with two lines 34 and 20 dB down. Right:
    the same on a shaken base, over the floor of any linear law.
    """
    stage, bus = Stage.load("reconstructed"), load("buses", "fd_5k", BusConfig)
    controller = load("controllers", "youla", ControllerConfig)
    alone, middle = (
        design_law(stage, without_filter(controller), bus, autostart=True), np.array(controller.operating_strokes_m)
    )  # fmt: skip
    model = linearise(stage, middle)
    shaken = shaken_covariance(model, model.mass_kg * SHAKEN_M_PER_S2, bus.period_s)[::3, ::3]
    sense_m = float(np.sqrt(measurement_noise(stage, model, bus)[0, 0]))
    still = Noise(sense_m, float(rounding_force_n(stage, bus, model)[0]))
    moved = Noise(still.sense_m, still.rounding_n, np.linalg.cholesky(shaken))
    floor_nm = 1e9 * hold_floor_m(stage, bus, middle, SHAKEN_M_PER_S2)[0]

    def least_nm(edge_hz: float, noise: Noise, taps: int = 40, below: tuple[tuple[float, float], ...] = ()) -> float:
        law, seen = lqg_equivalent(stage, alone, middle), seen_by(alone["tick"][0]["estimator"])
        drawn = InnovationLoop(loop_plant(stage, bus, middle), law, seen, 0, 1.9)
        try:
            return 1e9 * youla_taps(drawn, [], Bounds(edge_hz, 0.7, 0.7, 1.9, 0.64, 7.8, below), noise, taps)[1]
        except LawError:
            return float("nan")

    figure = sheet(11, 4.2)
    left, right = figure.subplots(1, 2)
    plain = [least_nm(f, still) for f in EDGES_HZ]
    left.plot(EDGES_HZ, plain, color=BLUE, label="|S| < -3 dB up to there")
    for taps, style in ((40, "-"), (80, "--")):
        lines = [least_nm(f, still, taps, LINES) for f in EDGES_HZ]
        left.plot(EDGES_HZ, lines, style, color=VERMILION, label=f"and 34 dB at 10 Hz, 20 dB at 50 Hz: {taps} taps")
    left.plot(203, 0.964, "o", color=GREEN, label="youla, which bears 135 changed plants")
    left.plot(30, 0.473, "s", color=GREEN, label="its quiet hold")
    left.axvline(200.0, color=MUTED, lw=0.8, ls="--")
    bound(left, 1.0, "1 nm", 22, style="--")
    dress(left, "rejection up to (Hz)", "deviation at hold (nm)", "sense noise alone")
    left.set_ylim(top=1.55)
    legend(left, "upper left")
    right.plot(EDGES_HZ, [least_nm(f, moved) / floor_nm for f in EDGES_HZ], color=BLUE)
    right.plot([203, 30], [1.165 / floor_nm, 0.703 / floor_nm], "o", color=GREEN)
    bound(right, 1.25, "1.25", 150, style="--")
    dress(right, "rejection up to (Hz)", f"over the floor of {floor_nm:.2f} nm", "base shaken by 10 µg/√Hz")
    return figure


if __name__ == "__main__":
    save(draw(), Path(__file__).with_suffix(".png"))
