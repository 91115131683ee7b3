"""Writes docs/figures/margins.png and the table of docs/margins.md: the laws on ``fd_5k`` at mid-workspace."""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from pkxyz_ctrl.bus_config import BusConfig
from pkxyz_ctrl.config import load
from pkxyz_ctrl.controller_config import ControllerConfig
from pkxyz_ctrl.design.discrete_law import DiscreteLaw
from pkxyz_ctrl.design.glover_mcfarlane import hinf
from pkxyz_ctrl.design.hold_noise import hold_noise_m
from pkxyz_ctrl.design.irc import irc
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.loop_plant import LoopPlant, Perturbation, loop_plant
from pkxyz_ctrl.design.lqg_equivalent import lqg_equivalent
from pkxyz_ctrl.design.margins import loop_response, margins
from pkxyz_ctrl.design.pi_notch import pi_notch
from pkxyz_ctrl.stage import Stage

MIDDLE = np.full(3, 12.5e-6)
COLOURS = {"lqg": "#0072b2", "hinf": "#009e73", "pi_notch": "#d55e00", "irc": "#8a8a8a"}
CHANGED = (
    Perturbation(stiffness=0.2),
    Perturbation(stiffness=-0.2),
    Perturbation(mass=0.1),
    Perturbation(mass=-0.1),
    Perturbation(quality_factor=5.0),
    Perturbation(quality_factor=200.0),
    Perturbation(comb_gain=(0.1, 0.1, 0.1)),
    Perturbation(comb_gain=(0.1, -0.1, 0.0)),
)
BEGIN, END = "<!-- table: begin -->\n", "<!-- table: end -->"


def laws(stage: Stage, bus: BusConfig, plant: LoopPlant) -> dict[str, DiscreteLaw]:
    """The shipped default and the others with their default numbers."""
    designed = design_law(stage, load("controllers", "lqg", ControllerConfig), bus, autostart=True)
    return {
        "lqg": lqg_equivalent(stage, designed, MIDDLE),
        "hinf": hinf(plant).law,
        "pi_notch": pi_notch(plant, stage.config.dynamics.mass_kg),
        "irc": irc(plant),
    }


def table(stage: Stage, bus: BusConfig, plant: LoopPlant, all_laws: dict[str, DiscreteLaw]) -> str:
    """Markdown: a line for each law."""
    lines = [
        "| law | Ms | disk margin | \\|S\\| < -3 dB to (Hz) | gain margin, x | phase margin, x (deg) | hold noise (nm) "
        "| worst Ms of the changed stages |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, law in all_laws.items():
        found, x = margins(plant, law), margins(plant, law).axes[0]
        noise = hold_noise_m(stage, bus, plant, law).max() * 1e9
        worst = max(margins(loop_plant(stage, bus, MIDDLE, change), law).mimo.peak_s for change in CHANGED)
        lines.append(
            f"| `{name}` | {found.mimo.peak_s:.2f} | {found.mimo.disk_margin:.2f} | {found.mimo.bandwidth_hz:.0f} "
            f"| {x.gain_margin:.2f} | {np.degrees(x.phase_margin_rad):.0f} | {noise:.2f} "
            f"| {f'{worst:.2f}' if np.isfinite(worst) else 'unstable'} |"
        )
    return "\n".join(lines) + "\n"


def draw(plant: LoopPlant, all_laws: dict[str, DiscreteLaw]) -> Figure:
    """|S| of x, and the loops of x in the Nyquist plane beside the disk of margin 0.6."""
    figure = Figure(figsize=(11, 4.2), layout="constrained", dpi=130)
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    frequency = np.unique(np.r_[np.geomspace(10, 2500, 800), np.linspace(500, 800, 600)])
    for name, law in all_laws.items():
        response = loop_response(plant, law, frequency)
        s = response.s[:, 0, 0]
        left.loglog(frequency, np.abs(s), color=COLOURS[name], label=name)
        right.plot((1 / s - 1).real, (1 / s - 1).imag, color=COLOURS[name])
    left.axhline(2.0, color="#5b6770", lw=0.8, ls=":")
    left.axhline(np.sqrt(0.5), color="#5b6770", lw=0.8, ls="--")
    left.set(xlabel="frequency (Hz)", ylabel="|S|", title="Sensitivity in x", xlim=(10, 2500), ylim=(0.03, 4))
    left.legend(frameon=False, fontsize=9, loc="lower right")
    turn = 0.3 * np.exp(1j * np.linspace(0, 2 * np.pi, 200))
    edge = -(1 + turn) / (1 - turn)  # of L that some factor of the disk takes to -1
    right.fill(edge.real, edge.imag, color="#f3d9d0", lw=0)
    right.plot(-1, 0, "+", color="black")
    right.set(
        xlabel="Re L", ylabel="Im L", title="Loops in x; shaded: disk margin below 0.6", xlim=(-3, 1.5), ylim=(-2, 2)
    )
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
        axes.title.set_fontsize(11)
    return figure


def main() -> None:
    """Draw the picture and put the table into its page."""
    stage, bus = Stage.load("reconstructed"), load("buses", "fd_5k", BusConfig)
    plant = loop_plant(stage, bus, MIDDLE)
    all_laws = laws(stage, bus, plant)
    draw(plant, all_laws).savefig(Path(__file__).with_suffix(".png"))
    page = Path(__file__).parents[1] / "margins.md"
    before, rest = page.read_text().split(BEGIN)
    page.write_text(before + BEGIN + table(stage, bus, plant, all_laws) + END + rest.split(END)[1])


if __name__ == "__main__":
    main()
