"""Drawings beside each other: what their devices' loops reach, and which spread each of them bears."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from hil.pictures.style import INK, SERIES, dress, legend, save, sheet
from hil.pictures.wafer.overview import SOURCE_WORDS
from hil.studies.wafer.effects import MEAN

Array = NDArray[np.float64]

ERROR = "known.error_about_mean_nm"
_LEAST_NM = 0.3
"""What is drawn of an effect below."""


@dataclass(frozen=True)
class DrawingFigures:
    """A drawing in the picture."""

    name: str
    works: float
    """share of its devices"""
    error_nm: Array
    """(n,) ``ERROR`` of each of them"""
    effects: Mapping[str, Mapping[str, float]]
    """as ``effects`` has them"""


def draw_drawings(drawings: list[DrawingFigures], limit_nm: float | None, path: Path) -> None:
    """Errors of all devices by the share that stays below, and what one standard deviation of each source makes of
    the error.
    """
    said = "; ".join(f"{d.name}: {d.works:.1%} work" for d in drawings)
    figure = sheet(13.0, 5.0, said)
    left, right = figure.subplots(1, 2)
    for drawn, colour in zip(drawings, SERIES, strict=False):
        order = np.sort(drawn.error_nm[np.isfinite(drawn.error_nm)])
        share = 100.0 * np.arange(1, len(order) + 1) / len(drawn.error_nm)
        left.step(order, share, where="post", color=colour, label=drawn.name)
    if limit_nm is not None:
        left.axvline(limit_nm, color=INK, lw=1.0, ls="--")
    left.set_xscale("log")
    left.set_ylim(0.0, 101.0)
    dress(left, "RMS error about its mean, law for the device (nm)", "devices at most there (%)")
    legend(left, "lower right")
    _bars(right, drawings)
    save(figure, path)


def _bars(plot: Axes, drawings: list[DrawingFigures]) -> None:
    """Beyond the mean device's error, in squares: noise is no effect."""
    added = [{name: _added(d.effects, name) for name in d.effects if name != MEAN} for d in drawings]
    names = sorted({name for each in added for name in each}, key=lambda n: max(each.get(n, 0.0) for each in added))
    names = [name for name in names if max(each.get(name, 0.0) for each in added) > _LEAST_NM]
    width = 0.8 / len(drawings)
    for k, (drawn, each, colour) in enumerate(zip(drawings, added, SERIES, strict=False)):
        rows = np.arange(len(names)) + 0.4 - (k + 0.5) * width
        plot.barh(rows, [each.get(n, 0.0) for n in names], height=width, color=colour, label=drawn.name)
    plot.set_yticks(range(len(names)), [SOURCE_WORDS[n] for n in names])
    dress(plot, "error that one standard deviation of a source adds (nm)", grid="x")


def _added(effects: Mapping[str, Mapping[str, float]], name: str) -> float:
    return float(np.sqrt(max(0.0, effects[name][ERROR] ** 2 - effects[MEAN][ERROR] ** 2)))
