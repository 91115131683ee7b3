"""The picture of a comparison: each law's error over time, and its figures as bars."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hil.pictures.style import BLUE, LABEL_PT, SMALL_PT, TINY_PT, dress, save, sheet
from hil.studies.compare import Compared

_BINS = 700
_SHOWN = {"rms_error_nm": "rms while scanning", "hold_noise_nm": "hold noise"}


def draw(runs: Sequence[Compared], title: str, path: Path) -> None:
    """Write the picture of those runs that have figures."""
    shown = [run for run in runs if run.figures.get("rms_error_nm")]
    figure = sheet(11, 1.6 + 1.05 * max(len(shown), 2))
    grid = figure.add_gridspec(max(len(shown), 1), 2, width_ratios=(2.2, 1))
    largest = _scale(shown)
    first = None
    for n, run in enumerate(shown):
        axes = figure.add_subplot(grid[n, 0], sharex=first)
        first = first or axes
        size = np.linalg.norm(run.error_nm, axis=1)
        t_s, top = _envelope(run.t_s, size)
        axes.fill_between(t_s, np.minimum(top, largest), color=BLUE, lw=0)
        axes.set_ylim(0, largest)
        axes.set_ylabel(run.controller, rotation=0, ha="right", va="center", fontsize=SMALL_PT)
        dress(axes, "time of the trajectory (s)" if n == len(shown) - 1 else "", grid="y")
        axes.tick_params(labelbottom=n == len(shown) - 1)
        if n == 0:
            cut = f", cut off at {largest:.3g}" if any(_farthest(each) > largest for each in shown) else ""
            axes.set_title(f"{title}: distance from the reference (nm){cut}", fontsize=LABEL_PT, loc="left")
    if first is not None:
        _bars(figure, grid, shown)
    save(figure, path)


def _bars(figure: Figure, grid: object, shown: Sequence[Compared]) -> None:
    """Points, not bars: on a logarithmic axis, where they are needed, a bar's length would mean nothing."""
    axes = figure.add_subplot(grid[:, 1])  # type: ignore[index]
    rows = np.arange(len(shown))
    seen = [v for run in shown for k in _SHOWN for v in (run.figures.get(k) or {}).values()]
    is_log = max(seen) > 20.0 * min(seen)
    for k, (name, words) in enumerate(_SHOWN.items()):
        for n, run in enumerate(shown):
            if not run.figures.get(name):
                continue
            value = max(run.figures[name].values())
            row = rows[n] - 0.17 + 0.34 * k
            axes.plot(value, row, "os"[k], color=BLUE, markerfacecolor=BLUE if k == 0 else "white", markersize=6)
            text = f"{value:.3g} {words}" if value < 1000.0 else f"{value:.0f} {words}"
            axes.annotate(text, (value, row), (7, 0), textcoords="offset points", va="center", fontsize=TINY_PT)
    axes.set_yticks(rows, [run.controller for run in shown], fontsize=SMALL_PT)
    axes.set_ylim(len(shown) - 0.5, -0.5)
    if is_log:
        axes.set_xscale("log")
        low, high = 10.0 ** np.floor(np.log10(min(seen))), 10.0 ** np.ceil(np.log10(max(seen)))
        axes.set_xlim(low, high * (high / low) ** 0.9)  # whole decades, and room for the words
        axes.set_xticks([10.0**n for n in range(-3, 8) if low <= 10.0**n <= high], minor=False)
        axes.xaxis.set_major_formatter("{x:g}")
        axes.minorticks_off()
    else:
        axes.set_xlim(0.0, 1.8 * max(seen))
    dress(axes, "nm, worst axis" + (", logarithmic" if is_log else ""), grid="x")


def _scale(shown: Sequence[Compared]) -> float:
    """So that the laws that work are seen whole, and fill their rows: those that do not are cut off."""
    ran = [run for run in shown if len(run.error_nm)]
    usual = [float(np.quantile(np.linalg.norm(run.error_nm, axis=1), 0.99)) for run in ran]
    middle = sorted(usual)[len(usual) // 2] if usual else 1.0
    return 1.05 * max((_farthest(run) for run, q in zip(ran, usual, strict=True) if q <= 3.0 * middle), default=1.0)


def _farthest(run: Compared) -> float:
    return float(np.linalg.norm(run.error_nm, axis=1).max(initial=0.0))


def _envelope(t_s: NDArray[np.float64], values: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Largest value in each of at most ``_BINS`` equal stretches."""
    every = max(1, -(-len(values) // _BINS))
    starts = np.arange(0, len(values), every)
    return t_s[starts], np.maximum.reduceat(values, starts)
