"""What the drawings share: two themes, for light and dark pages, and a way to
write an SVG with the same bytes each time.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

FIGURES = Path(__file__).parents[1] / "figures"


@dataclass(frozen=True)
class Theme:
    """Colours on a transparent ground."""

    name: str
    ink: str
    faint: str
    wash: str
    chains: tuple[str, str, str]
    accent: str


THEMES = (
    Theme("light", "#222222", "#8a8a8a", "#e9eef4", ("#0072B2", "#C34E00", "#00835F"), "#9A4D80"),
    Theme("dark", "#e6e6e6", "#9a9a9a", "#2c3440", ("#63B3E8", "#F2955A", "#3FCFA0"), "#DB93BF"),
)


def figure(width_in: float, height_in: float) -> Figure:
    """An empty figure without a ground of its own."""
    made = Figure(figsize=(width_in, height_in))
    made.patch.set_alpha(0.0)
    FigureCanvasSVG(made)
    return made


def bare(made: Figure, box: tuple[float, float, float, float], *, equal: bool) -> Any:
    """Axes without ticks or frame."""
    plot = made.add_axes(box)
    plot.set_axis_off()
    if equal:
        plot.set_aspect("equal")
    return plot


def save(made: Figure, name: str, theme: Theme) -> Path:
    """docs/figures/NAME-THEME.svg; letters as outlines, no date, fixed identifiers."""
    path = FIGURES / f"{name}-{theme.name}.svg"
    with mpl.rc_context({"svg.hashsalt": name, "svg.fonttype": "path"}):
        made.savefig(path, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    path.write_text("\n".join(line.rstrip() for line in path.read_text(encoding="utf-8").splitlines()) + "\n")
    return path
