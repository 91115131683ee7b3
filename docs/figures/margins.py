"""Writes docs/figures/margins.png and margins.json, the table of margins.md: the shipped laws on ``fd_5k`` at
mid-workspace, and over the changed and the sampled plants.
"""

import json
import math
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from hil.pictures.style import (
    BAD_WASH,
    BLUE,
    GREEN,
    INK,
    MUTED,
    PINK,
    REFERENCE,
    SKY,
    SMALL_PT,
    TINY_PT,
    VERMILION,
    bound,
    dress,
    save,
    sheet,
)  # fmt: skip
from hil.studies.margins.loop import Loop, over_changed_plants
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.design.hold_noise import hold_noise_m
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.law_about import law_about
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.design.model.discrete_law import response
from pkxyz_ctrl.design.model.loop_plant import loop_plant
from pkxyz_ctrl.stage import Stage

MIDDLE = np.full(3, 12.5e-6)
COLOURS = {
    "youla": PINK, "lqg": SKY, "lqg_wide": BLUE, "hinf": GREEN, "pi_notch": "#e6b58f", "pi_notch_robust": VERMILION,
    "irc": REFERENCE, "irc_robust": MUTED, "robust": INK,
}  # fmt: skip
SHOWN = ("youla", "lqg", "lqg_wide", "hinf", "pi_notch_robust", "irc_robust", "robust")
SAMPLED = range(1, 201)
TABLE = Path(__file__).with_suffix(".json")
"""Of margins.md: header and rows."""


def loops(stage: Stage, bus: BusConfig) -> dict[str, Loop]:
    """Of the controller files."""
    files = {name: load("controllers", name, ControllerConfig) for name in COLOURS}
    return {name: Loop(stage, bus, design_law(stage, file, bus, autostart=True)) for name, file in files.items()}


HEADER = (
    "law", "Ms", "disk margin", "|S| < -3 dB to (Hz)", "gain margin, x (dB)", "hold noise (nm)", "largest |K S| / k",
    "slowest pole (ms)", "135 changed plants: worst Ms", "200 sampled plants: 95 % of Ms, unstable",
)  # fmt: skip


def rows(all_loops: dict[str, Loop]) -> list[list[str]]:
    """A row of the table for each law."""
    tolerances = load("tolerances", "wide", Tolerances)
    told = []
    for name, loop in all_loops.items():
        found = loop.margins(MIDDLE)
        plant, law = loop_plant(loop.stage, loop.bus, MIDDLE), law_about(loop.stage, loop.law, MIDDLE)
        noise = hold_noise_m(loop.stage, loop.bus, plant, law).max() * 1e9
        slowest_ms = -plant.period_s / np.log(found.spectral_radius) * 1e3
        worst = over_changed_plants(loop, tolerances.cases()).worst[1]
        sampled = np.array([loop.peak_sensitivity(tolerances.sample(seed)) for seed in SAMPLED])
        lost = int(np.count_nonzero(np.isinf(sampled)))
        most = np.percentile(sampled, 95, method="higher")
        told.append([
            f"`{name}`", f"{found.mimo.peak_s:.2f}", f"{found.mimo.disk_margin:.2f}", f"{found.mimo.bandwidth_hz:.0f}",
            f"{20.0 * math.log10(found.axes[0].gain_margin):.1f}", f"{noise:.2f}", f"{effort(loop):.1f}",
            f"{slowest_ms:.1f}", _ms(worst), f"{_ms(most)}, {lost}",
        ])  # fmt: skip
    return told


def _ms(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "unstable"


def effort(loop: Loop) -> float:
    """Largest |K S| of an axis over the stage's stiffness along it."""
    plant, law = loop_plant(loop.stage, loop.bus, MIDDLE), law_about(loop.stage, loop.law, MIDDLE)
    f = np.linspace(1.0, 0.4999 / plant.period_s, 5000)
    k = response(law.a, law.b, law.c, law.d, np.exp(2j * np.pi * f * plant.period_s))
    size = np.abs(k @ loop.response(MIDDLE, f).s).max(axis=0)
    return float((np.diag(size) / np.diag(plant.stiffness_n_per_m)).max())


def draw(all_loops: dict[str, Loop]) -> Figure:
    """|S| of x, and the loops of x in the Nyquist plane beside the disk of margin 0.6."""
    figure = sheet(11, 4.5)
    left, right = figure.subplots(1, 2)
    frequency = np.unique(np.r_[np.geomspace(10, 2499, 800), np.linspace(500, 800, 600)])
    for name in SHOWN:
        s = all_loops[name].response(MIDDLE, frequency).s[:, 0, 0]
        left.loglog(frequency, np.abs(s), color=COLOURS[name], label=name, lw=1.8 if name == "robust" else 1.2)
        right.plot((1 / s - 1).real, (1 / s - 1).imag, color=COLOURS[name], lw=1.8 if name == "robust" else 1.2)
    for level, style, words in ((2.0, ":", "2"), (np.sqrt(0.5), "--", "-3 dB")):
        bound(left, level, words, 10.4, style=style)
    left.axvline(200.0, color=MUTED, lw=0.8, ls="--")
    left.text(195.0, 0.032, "200 Hz", fontsize=TINY_PT, color=MUTED, ha="right", va="bottom")
    left.set(xlim=(10, 2500), ylim=(0.03, 4))
    dress(left, "frequency (Hz)", "|S|", "Sensitivity in x")
    figure.legend(frameon=False, fontsize=SMALL_PT, loc="outside lower center", ncols=len(SHOWN))
    turn = 0.3 * np.exp(1j * np.linspace(0, 2 * np.pi, 200))
    edge = -(1 + turn) / (1 - turn)  # of L that some factor of the disk takes to -1
    right.fill(edge.real, edge.imag, color=BAD_WASH, lw=0)
    right.plot(-1, 0, "+", color=INK)
    right.set(xlim=(-3, 1.5), ylim=(-2, 2), aspect="equal")
    dress(right, "Re L", "Im L", "Loops in x; shaded: disk margin below 0.6")
    return figure


def main() -> None:
    """Draw the picture and keep the table."""
    all_loops = loops(Stage.load("reconstructed"), load("buses", "fd_5k", BusConfig))
    save(draw(all_loops), Path(__file__).with_suffix(".png"))
    kept = {"header": HEADER, "rows": rows(all_loops)}
    TABLE.write_text(json.dumps(kept, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
