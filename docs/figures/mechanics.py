"""Writes the figures of docs/understand/mechanics.md, and its generated table.

    python docs/figures/mechanics.py

The table stands between ``<!-- generated: numbers -->`` and ``<!-- end -->``.
"""

import re
from pathlib import Path

from hil.pictures.mechanics import draw_design_space, draw_linearisation, draw_modes, draw_selection
from hil.pictures.workspace import draw_edge_path, draw_workspace
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.mechanics.linearisation import linearisation_study
from pkxyz_ctrl.mechanics.published import entries
from pkxyz_ctrl.mechanics.reproduction import reproduction_table
from pkxyz_ctrl.mechanics.selection import Requirements, select
from pkxyz_ctrl.stage import Stage

HERE = Path(__file__).parent
PAGE = HERE.parent / "understand" / "mechanics.md"


def numbers_table() -> str:
    """The paper's numbers as a Markdown table."""
    lines = [
        "| where | number | unit | published | printed design | reconstructed | verdict | why |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in reproduction_table(entries(), Stage.load("printed"), Stage.load("reconstructed")):
        figures = ["" if v is None else f"{v:.6g}" for v in (row.printed, row.reconstructed)]
        cells = [row.where, row.quantity, row.unit, row.published_text, *figures, str(row.verdict), row.why]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Draw all pictures and renew the page's table."""
    stages = {name: Stage.load(name) for name in ("printed", "reconstructed")}
    stage = stages["reconstructed"]
    draw_design_space(stages, HERE / "mechanics_design_space.png")
    draw_workspace(stage, 130.0, HERE / "mechanics_workspace.png")
    draw_modes(stage, HERE / "mechanics_modes.png")
    draw_edge_path(stage, HERE / "mechanics_edge_path.png")
    draw_linearisation(linearisation_study(stage, points=17), stage.config.name, HERE / "mechanics_linearisation.png")
    chosen = select(Requirements(), load("stages", "reconstructed", StageConfig))
    draw_selection(chosen, HERE / "mechanics_selection.png")
    page = PAGE.read_text(encoding="utf-8")
    pattern = re.compile(r"(<!-- generated: numbers -->\n).*?(<!-- end -->)", re.DOTALL)
    PAGE.write_text(pattern.sub(lambda m: f"{m[1]}{numbers_table()}\n{m[2]}", page), encoding="utf-8")


if __name__ == "__main__":
    main()
