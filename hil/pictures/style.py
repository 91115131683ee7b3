"""How every picture looks: colours, sheet, axes and sizes of type, in one place. What a picture shows is its own."""

from pathlib import Path
from typing import Any, Literal

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

# Okabe and Ito's palette, told apart with any colour vision
BLUE, VERMILION, GREEN = "#0072B2", "#D55E00", "#009E73"
SKY, ORANGE, PINK = "#56B4E9", "#E69F00", "#CC79A7"

AXIS = (BLUE, VERMILION, GREEN)
"""x, y, z; of anything that comes in threes and is no comb."""
COMB = (SKY, ORANGE, PINK)
SERIES = (BLUE, VERMILION, GREEN, PINK, ORANGE, SKY)
"""Lines of one plot that are neither axes nor combs, in this order."""
INK, MUTED, FAINT = "#2b2b2b", "#5b6770", "#9aa5ad"
"""Titles and what is read first; what explains; what lies behind: bounds, changed plants, ticks."""
REFERENCE = "#bdbdbd"
GRID, WASH = "#e4e7ea", "#eef1f4"
"""Grid lines, and the shade of a stretch that is meant."""
GOOD, BAD, BAD_WASH = "#1b7f5c", "#b3371a", "#f3d9d0"
MAP = "viridis"
"""For a quantity over a plane or a path."""

Grid = Literal["both", "x", "y", ""]

HEADING_PT, TITLE_PT, LABEL_PT, SMALL_PT, TINY_PT = 17.0, 12.0, 10.0, 9.0, 8.0
DPI = 130


def sheet(width_in: float, height_in: float, title: str = "", *, dpi: int = DPI, free: bool = False) -> Figure:
    """An empty white figure with a title at its top left. Its plots arrange themselves, unless ``free``: then each is
    put where it belongs.
    """
    figure = Figure(figsize=(width_in, height_in), dpi=dpi, facecolor="white", layout=None if free else "constrained")
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, x=0.02, ha="left", fontsize=TITLE_PT, color=INK)
    return figure


def dress(plot: Axes, x_label: str = "", y_label: str = "", title: str = "", *, grid: Grid = "both") -> None:
    """Labels and title where they are given, no box, and a thin grid behind: "both", "x", "y", or "" for none."""
    if x_label:
        plot.set_xlabel(x_label, fontsize=LABEL_PT)
    if y_label:
        plot.set_ylabel(y_label, fontsize=LABEL_PT)
    if title:
        plot.set_title(title, fontsize=TITLE_PT, color=INK)
    plot.spines[["top", "right"]].set_visible(False)
    plot.spines[["left", "bottom"]].set_color(FAINT)
    plot.tick_params(labelsize=SMALL_PT, color=FAINT)
    if grid != "":
        plot.grid(True, which="major", axis=grid, color=GRID, linewidth=0.6)
        plot.set_axisbelow(True)


def whole_numbers(axis: Axis) -> None:
    """Ticks at whole numbers alone, for what is counted: half a plant would be a riddle."""
    axis.set_major_locator(MaxNLocator(integer=True))


def dress_space(plot: Any, *labels: str) -> None:
    """Labels of a plot in three dimensions, and its walls almost white."""
    for axis, label in zip((plot.xaxis, plot.yaxis, plot.zaxis), labels, strict=False):
        axis.set_label_text(label)
    for axis in (plot.xaxis, plot.yaxis, plot.zaxis):
        axis.pane.set_facecolor("#fafafa")
        axis.pane.set_edgecolor(GRID)


def legend(plot: Axes, where: str = "best", *, columns: int = 1, anchor: tuple[float, float] | None = None) -> None:
    """The key, without a frame and in small type; ``where`` and ``anchor`` are matplotlib's loc and bbox_to_anchor."""
    plot.legend(frameon=False, fontsize=SMALL_PT, loc=where, ncols=columns, bbox_to_anchor=anchor)


def box(alpha: float = 0.85) -> dict[str, Any]:
    """What words that lie over lines stand on."""
    return {"facecolor": "white", "alpha": alpha, "edgecolor": "none", "pad": 1.5}


def bound(plot: Axes, level: float, words: str = "", at: float = 0.0, *, style: str = "--") -> None:
    """A horizontal line that values are measured against; its words stand on it, from the abscissa ``at``."""
    plot.axhline(level, color=MUTED, lw=0.8, ls=style, zorder=0.5)
    plot.annotate(words, (at, level), xytext=(0, 2), textcoords="offset points", fontsize=TINY_PT, color=MUTED)


def save(figure: Figure, path: str | Path) -> None:
    """Write the picture: the same picture, the same bytes."""
    dated = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
    with rc_context({"svg.hashsalt": "pkxyz"}):
        figure.savefig(path, metadata=dated.get(Path(path).suffix.lower()))
