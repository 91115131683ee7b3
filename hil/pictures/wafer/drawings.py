"""Drawings beside each other: how many of their devices work, what the others miss, and which spread each bears."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator
from numpy.typing import NDArray

from hil.pictures.style import INK, SERIES, dress, save, sheet
from hil.pictures.wafer.overview import SOURCE_WORDS, words
from hil.studies.wafer.effects import MEAN
from hil.studies.wafer.shares import Share

Array = NDArray[np.float64]

ERROR = "known.error_about_mean_nm"
PARTS = {"works": "work in all", "own": "meet their own requirements", "shipped": "... in the shipped law's loop",
         "instrument": "... with an instrument", "known": "... in the loop for the device"}  # fmt: skip
_LEAST_FAIL = 0.1
"""Per cent of devices."""
_LEAST_NM = 0.3
"""What is drawn of an effect below."""


@dataclass(frozen=True)
class DrawingFigures:
    """A drawing in the picture."""

    name: str
    shares: Mapping[str, Share]
    """of its devices: ``works`` in all, and by ``PARTS``"""
    requirements: Mapping[str, Share]
    """of devices without a loop"""
    error_nm: Array
    """(n,) ``ERROR`` of each of them"""
    effects: Mapping[str, Mapping[str, float]]
    """as ``effects`` has them"""


def draw_drawings(drawings: list[DrawingFigures], limit_nm: float | None, path: Path) -> None:
    """Errors of all devices by the share that stays below, and what one standard deviation of each source makes of
    the error.
    """
    said = "; ".join(
        f"{d.name}: {s.value:.1%} of {s.devices} work ({s.low:.1%} to {s.high:.1%})"
        for d, s in ((d, d.shares["works"]) for d in drawings)
    )
    figure = sheet(13.0, 9.0, said)
    (shares, missed), (errors, sources) = figure.subplots(2, 2)
    _shares(shares, drawings)
    _missed(missed, drawings)
    _errors(errors, drawings, limit_nm)
    _sources(sources, drawings)
    figure.legend(*errors.get_legend_handles_labels(), frameon=False, loc="outside lower center", ncols=len(drawings))
    save(figure, path)


def _shares(plot: Axes, drawings: list[DrawingFigures]) -> None:
    names = list(PARTS)[::-1]
    _bars(plot, drawings, [[100.0 * d.shares[n].value for n in names] for d in drawings])
    for row, (k, drawn) in itertools.product(range(len(names)), enumerate(drawings)):
        share = drawn.shares[names[row]]
        at = _row(row, k, len(drawings))
        plot.plot([100.0 * share.low, 100.0 * share.high], [at, at], color=INK, lw=1.2)
    plot.set_yticks(range(len(names)), [PARTS[n] for n in names])
    plot.set_xlim(0.0, 100.0)
    dress(plot, "fresh devices (%), with 95 % interval", title="what works", grid="x")


def _missed(plot: Axes, drawings: list[DrawingFigures]) -> None:
    """Requirements that one in a thousand devices misses of some drawing."""
    fails = [{n: 100.0 * (1.0 - s.value) for n, s in d.requirements.items()} for d in drawings]
    names = [n for n in fails[0] if max(each[n] for each in fails) > _LEAST_FAIL][::-1]
    _bars(plot, drawings, [[each[n] for n in names] for each in fails])
    plot.set_yticks(range(len(names)), [words(n) for n in names])
    dress(plot, "devices (%)", title="which of their own requirements they miss", grid="x")


def _errors(plot: Axes, drawings: list[DrawingFigures], limit_nm: float | None) -> None:
    """The first is drawn widest: where curves are the same all of them are seen."""
    for k, (drawn, colour) in enumerate(zip(drawings, SERIES, strict=False)):
        order = np.sort(drawn.error_nm[np.isfinite(drawn.error_nm)])
        share = 100.0 * np.arange(1, len(order) + 1) / len(drawn.error_nm)
        width = 1.5 + 2.0 * (len(drawings) - 1 - k)
        plot.step(order, share, where="post", color=colour, lw=width, label=drawn.name)
    if limit_nm is not None:
        plot.axvline(limit_nm, color=INK, lw=1.0, ls="--")
    plot.set_xscale("log")
    plot.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    plot.xaxis.set_major_formatter("{x:g}")
    plot.set_ylim(0.0, 101.0)
    dress(plot, "RMS error about its mean, law for the device (nm)", "devices at most there (%)")


def _row(row: int, k: int, drawings: int) -> float:
    """Where the bar of a drawing stands."""
    width = 0.8 / drawings
    return row + 0.4 - (k + 0.5) * width


def _bars(plot: Axes, drawings: list[DrawingFigures], values: Sequence[Sequence[float]]) -> None:
    for k, (drawn, each, colour) in enumerate(zip(drawings, values, SERIES, strict=False)):
        rows = [_row(row, k, len(drawings)) for row in range(len(each))]
        plot.barh(rows, each, height=0.8 / len(drawings), color=colour, label=drawn.name)


def _sources(plot: Axes, drawings: list[DrawingFigures]) -> None:
    """Beyond the mean device's error, in squares: noise is no effect."""
    added = [{name: _added(d.effects, name) for name in d.effects if name != MEAN} for d in drawings]
    names = sorted({name for each in added for name in each}, key=lambda n: max(each.get(n, 0.0) for each in added))
    names = [name for name in names if max(each.get(name, 0.0) for each in added) > _LEAST_NM]
    _bars(plot, drawings, [[each.get(n, 0.0) for n in names] for each in added])
    plot.set_ylim(min(0, len(names) - 3) - 0.5, max(1, len(names)) - 0.5)
    plot.set_yticks(range(len(names)), [SOURCE_WORDS[n] for n in names])
    dress(plot, "error that one standard deviation of a source adds (nm)", grid="x")


def _added(effects: Mapping[str, Mapping[str, float]], name: str) -> float:
    return float(np.sqrt(max(0.0, effects[name][ERROR] ** 2 - effects[MEAN][ERROR] ** 2)))
