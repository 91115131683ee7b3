"""Draws docs/figures/trade.png: what rejection costs in noise at hold, for the best of all filters, stage as drawn."""

import json
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hil.pictures.style import BLUE, GREEN, MUTED, VERMILION, bound, dress, legend, save, sheet
from hil.studies.tune.taps import TapsSearch, without_filter
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.design.hold_floor import hold_floor_m
from pkxyz_ctrl.design.hold_noise import rounding_force_n
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.laws.estimator_gain import measurement_noise, shaken_covariance
from pkxyz_ctrl.design.laws.youla import Bounds, InnovationLoop, Noise, hold_deviation_m, youla_taps
from pkxyz_ctrl.design.lqg_equivalent import lqg_equivalent, seen_by
from pkxyz_ctrl.design.model.discrete_law import LawError
from pkxyz_ctrl.design.model.loop_plant import loop_plant
from pkxyz_ctrl.design.model.plant_model import linearise
from pkxyz_ctrl.stage import Stage

EDGES_HZ = (20.0, 40.0, 70.0, 100.0, 130.0, 160.0, 190.0, 202.0, 220.0)
FEW_HZ = (40.0, 120.0, 202.0)
LONG = 160
"""Four times as many taps as the tick has room for."""
LINES = ((10.0, 10 ** (-34 / 20)), (50.0, 10 ** (-20 / 20)))
SHAKEN_M_PER_S2 = 98.1e-6
RESULTS = Path(__file__).parents[2] / "benchmarks" / "results.json"


class Trade:
    """Axis x of the stage as drawn, with the filter of the shipped search."""

    def __init__(self) -> None:
        self.stage, self.bus = Stage.load("reconstructed"), load("buses", "fd_5k", BusConfig)
        self.controller = load("controllers", "youla", ControllerConfig)
        self.middle = np.array(self.controller.operating_strokes_m)
        model = linearise(self.stage, self.middle)
        shaken = shaken_covariance(model, model.mass_kg * SHAKEN_M_PER_S2, self.bus.period_s)[::3, ::3]
        sense_m = float(np.sqrt(measurement_noise(self.stage, model, self.bus)[0, 0]))
        self.still = Noise(sense_m, float(rounding_force_n(self.stage, self.bus, model)[0]))
        self.moved = Noise(self.still.sense_m, self.still.rounding_n, np.linalg.cholesky(shaken))
        self.floor_nm = 1e9 * hold_floor_m(self.stage, self.bus, self.middle, SHAKEN_M_PER_S2)[0]
        alone = design_law(self.stage, without_filter(self.controller), self.bus, autostart=True)
        self.law, self.seen = lqg_equivalent(self.stage, alone, self.middle), seen_by(alone["tick"][0]["estimator"])
        self.taps = load("searches", "youla", TapsSearch).taps

    def loop(self) -> InnovationLoop:
        """A fresh one: a search adds to its grid."""
        plant = loop_plant(self.stage, self.bus, self.middle)
        return InnovationLoop(plant, self.law, self.seen, 0, 1.9)

    def least_nm(self, edge_hz: float, noise: Noise, taps: int, below: tuple[tuple[float, float], ...] = ()) -> float:
        """Deviation at hold of the best taps; NaN where there are none."""
        try:
            return 1e9 * youla_taps(self.loop(), [], Bounds(edge_hz, 0.7, 0.7, 1.9, 0.64, 7.8, below), noise, taps)[1]
        except LawError:
            return float("nan")

    def shipped_nm(self, noise: Noise, *, quiet: bool) -> float:
        """Of the taps of the controller file, which bear 135 changed plants."""
        assert self.controller.youla is not None
        taps = self.controller.youla.filter[0]
        chosen = taps.quiet_plane if quiet and taps.quiet_plane is not None else taps.plane
        return 1e9 * hold_deviation_m(self.loop(), noise, np.array(chosen))


def draw() -> Figure:
    """Left: least deviation at hold over the edge of rejection, also with two lines 34 and 20 dB down. Right: the same
    on a shaken base, over the floor of any linear law.
    """
    trade, figure = Trade(), sheet(11, 4.2)
    left, right = figure.subplots(1, 2)

    def curves(
        axes: Axes, noise: Noise, by: float, below: tuple[tuple[float, float], ...], color: str, words: str
    ) -> None:
        """Solid for the taps there are, dashed for as many as one likes."""
        few = [trade.least_nm(f, noise, trade.taps, below) / by for f in EDGES_HZ]
        axes.plot(EDGES_HZ, few, color=color, label=f"{words}: {trade.taps} taps")
        many = [trade.least_nm(f, noise, LONG, below) / by for f in FEW_HZ]
        axes.plot(FEW_HZ, many, "--", color=color, label=f"{LONG} taps")

    curves(left, trade.still, 1.0, (), BLUE, "|S| < -3 dB up to there")
    curves(left, trade.still, 1.0, LINES, VERMILION, "and 34 dB at 10 Hz, 20 dB at 50 Hz")
    curves(right, trade.moved, trade.floor_nm, (), BLUE, "|S| < -3 dB up to there")
    for axes, noise, by in ((left, trade.still, 1.0), (right, trade.moved, trade.floor_nm)):
        bears = "youla, which bears 135 changed plants" if axes is left else None
        axes.plot(203, trade.shipped_nm(noise, quiet=False) / by, "o", color=GREEN, label=bears)
        axes.plot(30, trade.shipped_nm(noise, quiet=True) / by, "s", color=GREEN, label=bears and "its quiet hold")
    left.axvline(200.0, color=MUTED, lw=0.8, ls="--")
    bound(left, 1.0, "1 nm", 22, style="--")
    figures = {f["name"]: f for f in json.loads(RESULTS.read_text(encoding="utf-8"))["figures"]}
    bound(left, figures["beside.hold_nominal"]["target"], "open loop + 0.3 nm", 55, style=":")
    dress(left, "rejection up to (Hz)", "deviation at hold (nm)", "sense noise alone")
    left.set_ylim(top=1.55)
    legend(left, "upper left")
    bound(right, 1.25, "1.25", 150, style="--")
    dress(right, "rejection up to (Hz)", f"over the floor of {trade.floor_nm:.2f} nm", "base shaken by 10 µg/√Hz")
    return figure


if __name__ == "__main__":
    save(draw(), Path(__file__).with_suffix(".png"))
