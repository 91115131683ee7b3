"""Writes the figures of docs/understand/mechanics.md, whose table of split modes the site takes from here.

python docs/figures/mechanics.py
"""

from pathlib import Path

from hil.pictures.mechanics import (
    draw_design_space,
    draw_linearisation,
    draw_modes,
    draw_modes_over_workspace,
    draw_selection,
)
from hil.pictures.workspace import draw_edge_path, draw_workspace
from pkxyz_ctrl.config.calibration import Calibration
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.mechanics.linearisation import linearisation_study
from pkxyz_ctrl.mechanics.modes import modes
from pkxyz_ctrl.mechanics.selection import Requirements, select
from pkxyz_ctrl.stage import Stage

HERE = Path(__file__).parent


def splitting_table() -> str:
    """Both in-plane modes at rest where the flexures of one chain are stiffer than those of the others (IV.F)."""
    lines = ["| flexures of chain 1 stiffer by | modes 1, 2 (Hz) | apart (Hz) |", "| --- | --- | --- |"]
    config = Stage.load("reconstructed").config
    for share in (0.0, 0.01, 0.02, 0.05, 0.1):
        stiffer = (1.0 + share, 1.0, 1.0)
        measured = Calibration(slider_stiffness=stiffer, crank_stiffness=stiffer)
        stage = Stage(config.model_copy(update={"calibration": measured}))
        first, second, _ = modes(stage.stiffness([0.0] * 3), stage.mass_kg).frequency_hz
        lines.append(f"| {share:.0%} | {first:.1f}, {second:.1f} | {second - first:.1f} |")
    return "\n".join(lines)


def main() -> None:
    """Draw all pictures."""
    stages = {name: Stage.load(name) for name in ("printed", "reconstructed")}
    stage = stages["reconstructed"]
    draw_design_space(stages, HERE / "mechanics_design_space.png")
    draw_workspace(stage, 130.0, HERE / "mechanics_workspace.png")
    draw_modes(stage, HERE / "mechanics_modes.png")
    draw_modes_over_workspace(stage, HERE / "mechanics_modes_over_workspace.png")
    draw_edge_path(stage, HERE / "mechanics_edge_path.png")
    draw_linearisation(linearisation_study(stage, points=17), stage.config.name, HERE / "mechanics_linearisation.png")
    chosen = select(Requirements(), load("stages", "reconstructed", StageConfig))
    draw_selection(chosen, HERE / "mechanics_selection.png")


if __name__ == "__main__":
    main()
