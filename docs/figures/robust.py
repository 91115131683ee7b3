"""Draws docs/figures/robust.png: sensitivity of the laws ``robust`` and ``lqg_wide`` over all changed plants."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from hil.pictures.style import BLUE, FAINT, MUTED, bound, dress, save, sheet
from hil.studies.margins.loop import Loop
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.stage import Stage


def draw() -> Figure:
    """Largest singular value of S: nominal, and on each of the 135 plants."""
    stage, bus = Stage.load("reconstructed"), load("buses", "fd_5k", BusConfig)
    cases = load("tolerances", "wide", Tolerances).cases()
    f = np.unique(np.r_[np.geomspace(10, 2490, 400), np.linspace(450, 950, 300)])
    figure = sheet(11, 4.2)
    for axes, name in zip(figure.subplots(1, 2, sharey=True), ("lqg_wide", "robust"), strict=True):
        controller = load("controllers", name, ControllerConfig)
        loop = Loop(stage, bus, design_law(stage, controller, bus, autostart=True))
        for n, case in enumerate(cases[::-1]):
            last = n == len(cases) - 1  # nominal, at mid-workspace
            s = np.linalg.norm(loop.response(case.strokes_m, f, case.perturbation).s, 2, axis=(1, 2))
            axes.loglog(f, s, color=BLUE if last else FAINT, lw=1.8 if last else 0.5)
        for level, style, words in ((np.sqrt(0.5), "--", "-3 dB"), (2.0, ":", "2"), (3.0, "-.", "3")):
            bound(axes, level, words, 10.5, style=style)
        axes.axvline(200.0, color=MUTED, lw=0.8, ls="--")
        axes.set(xlim=(10, 2500), ylim=(0.03, 5))
        dress(axes, "frequency (Hz)", title=name)
    figure.axes[0].set_ylabel("|S|, MIMO: nominal (blue), changed plants (grey)")
    return figure


if __name__ == "__main__":
    save(draw(), Path(__file__).with_suffix(".png"))
