"""What a process makes of a drawing, at a glance: the wafer, the shares, the spread of the figures, and its causes."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.patches import Circle
from numpy.typing import NDArray

from hil.pictures.style import (
    BAD,
    BLUE,
    FAINT,
    GOOD,
    INK,
    LABEL_PT,
    MUTED,
    SMALL_PT,
    TINY_PT,
    dress,
    save,
    sheet,
)  # fmt: skip
from hil.studies.wafer.causes import ALL, Causes, Indices
from hil.studies.wafer.shares import Share
from pkxyz_ctrl.fabrication.process import Process

Columns = Mapping[str, NDArray[Any]]

_SHARE = LinearSegmentedColormap.from_list("share", [BAD, "#f2e6c9", GOOD])
_SHADE = LinearSegmentedColormap.from_list("index", ["white", BLUE])
SOURCE_WORDS = {
    "layer_1_m": "layer 1 thickness", "layer_2_m": "layer 2 thickness", "handle_m": "handle thickness",
    "wafer_bow_m": "wafer bow", "etch_bias_m": "etch bias", "sidewall_rad": "sidewall lean", "comb_gap_m": "comb gap",
    "hinge_m": "hinge thickness", "alignment_x_m": "alignment x", "alignment_y_m": "alignment y",
    "youngs_modulus": "Young's modulus", "residual_stress_pa": "residual stress", "finger_offset_m": "finger offset",
    "pressure_pa": "pressure", "frequency_low_hz": "lower resonance in plane", "frequency_high_hz": "upper in plane",
    "frequency_z_hz": "resonance along z", "frequency_held_hz": "lowest, held", "split_hz": "split of the pair",
    "top_v": "voltage of the top corner", "pull_in_m": "pull-in stroke", "snap_v": "snap voltage",
    "held_m": "strokes held", "comb_unlike": "combs unlike", "place": "place on the wafer", ALL: "all met",
}  # fmt: skip
_SCALES = {"_hz": (1.0, "Hz"), "_m": (1e6, "µm"), "_v": (1.0, "V"), "quality_factor": (1.0, "")}
"""How a figure is shown, by the end of its name; any other is relative, in per cent."""


def draw_wafer(
    process: Process, columns: Columns, shares: Mapping[str, Share], found: Causes | None, path: Path
) -> None:
    """``columns`` of a study's table; ``shares`` by requirement, ``ALL`` among them; without causes their plots are
    left out.
    """
    every = shares[ALL]
    title = (
        f"{process.name}: {every.value:.1%} of {every.devices} devices meet every requirement "
        f"({every.low:.1%} to {every.high:.1%})"
    )
    figure = sheet(15.0, 9.6 if found is not None else 5.2, title)
    rows: Any = figure.subfigures(2 if found is not None else 1, 1, squeeze=False)[:, 0]
    left, middle, right = rows[0].subplots(1, 3, width_ratios=(1.0, 0.9, 1.4))
    _map(left, process, columns, every.value)
    _bars(middle, shares)
    _spreads(right, process, columns)
    if found is not None:
        gained, heat = rows[1].subplots(1, 2, width_ratios=(1.0, 2.0))
        _gains(gained, found)
        draw_indices(heat, found.indices, [words(name) for name in found.indices.figures])
    save(figure, path)


def _map(plot: Axes, process: Process, columns: Columns, share: float) -> None:
    """Which part of each die fails over all wafers; where there is one wafer only, its good and bad dies."""
    places, where = np.unique(np.stack([columns["x_m"], columns["y_m"]], axis=1), axis=0, return_inverse=True)
    held = np.bincount(where, weights=columns[ALL]) / np.bincount(where)
    half = 0.47e3 * process.wafer.die_m
    digits = 1 if 0.9 < held.min() < 1.0 else 0
    least = min(0.98, float(held.min()), share)
    for (x, y), value in zip(places * 1e3, held, strict=True):
        colour = _SHARE((value - least) / (1.0 - least))
        plot.fill([x - half, x + half, x + half, x - half], [y - half, y - half, y + half, y + half], color=colour)
        fails = f"{100 * (1.0 - value):.{digits}f}"
        plot.annotate(fails, (x, y), ha="center", va="center", fontsize=TINY_PT, color=INK)
    plot.add_patch(Circle((0, 0), 0.5e3 * process.wafer.diameter_m, fill=False, color=FAINT))
    plot.set_aspect("equal")
    dress(plot, "x (mm)", "y (mm)", "where they fail (% of each die)", grid="")


def _bars(plot: Axes, shares: Mapping[str, Share]) -> None:
    names = list(shares)[::-1]
    for row, name in enumerate(names):
        share = shares[name]
        colour = GOOD if share.value > 0.99 else BLUE if share.value > 0.9 else BAD
        plot.barh(row, 100.0 * (1.0 - share.value), color=colour, height=0.6)
        plot.plot([100.0 * (1.0 - share.high), 100.0 * (1.0 - share.low)], [row, row], color=INK, lw=1.2)
    plot.set_yticks(range(len(names)), [words(name) for name in names])
    plot.set_xlim(left=0.0)
    dress(plot, "devices that fail (%), with 95 % interval", title="what fails", grid="x")


def _spreads(plot: Axes, process: Process, columns: Columns) -> None:
    """Each required figure on an axis of its own, from bound to bound where it has two."""
    names = list(process.requirements)[::-1]
    for row, name in enumerate(names):
        bound, values = process.requirements[name], columns[name][np.isfinite(columns[name])]
        low, mid, high = np.percentile(values, [0.5, 50.0, 99.5])
        ends = [v for v in (bound.min, bound.max) if v is not None]
        least, most = min(low, *ends), max(high, *ends)
        room = 0.08 * (most - least) or 1.0
        begin, length = least - room, most - least + 2.0 * room
        count, edges = np.histogram(values, 60, (begin, begin + length))
        heights = 0.55 * count / max(1, count.max())
        plot.fill_between((edges[:-1] - begin) / length, row, row + heights, step="mid", color=BLUE, alpha=0.8, lw=0)
        for end in ends:
            at = (end - begin) / length
            plot.plot([at, at], [row, row + 0.6], color=BAD, lw=1.4)
            plot.annotate(f" {_shown(name, end)} ", (at, row + 0.32), ha="left" if end == bound.min else "right",
                          fontsize=TINY_PT, color=BAD)  # fmt: skip
        plot.annotate(_shown(name, mid), ((mid - begin) / length, row - 0.02), ha="center", va="top",
                      fontsize=TINY_PT, color=MUTED)  # fmt: skip
    plot.set_yticks(range(len(names)), [words(name) for name in names])
    plot.set_xticks([])
    plot.set_ylim(-0.35, len(names) - 0.2)
    dress(plot, title="figures, their medians, and where they have to lie", grid="")


def _gains(plot: Axes, found: Causes) -> None:
    gain = {name: 100.0 * (share - found.share) for name, share in found.share_without.items()}
    order = sorted(gain, key=lambda name: gain[name])
    plot.barh([words(name) for name in order], [gain[name] for name in order], color=BLUE, height=0.6)
    plot.axvline(0.0, color=FAINT, lw=0.8)
    dress(
        plot, f"more devices that work (%), of {found.share:.1%} here", title="won if a cause had no spread", grid="x"
    )


def draw_indices(plot: Axes, found: Indices, called: Sequence[str]) -> None:
    """Causes by figures, which are ``called`` so. What is estimated beyond 1, where no index is, is shown as 1."""
    plot.imshow(found.total, cmap=_SHADE, vmin=0.0, vmax=1.0, aspect="auto")
    for row in range(len(found.names)):
        for column in range(len(found.figures)):
            value = found.total[row, column]
            if value >= 0.005:
                told = f"{100.0 * min(value, 1.0):.0f}"
                plot.annotate(told, (column, row), ha="center", va="center", fontsize=SMALL_PT,
                              color="white" if value > 0.6 else INK)  # fmt: skip
    plot.set_yticks(range(len(found.names)), [words(name) for name in found.names])
    plot.set_xticks(range(len(found.figures)), called, rotation=35, ha="right")
    dress(plot, title="part of each figure's variance that a cause has a hand in (%, Sobol's total index)", grid="")
    plot.tick_params(labelsize=SMALL_PT)
    plot.title.set_fontsize(LABEL_PT + 1)


def words(name: str) -> str:
    """What a cause, a figure or a requirement is called."""
    if name in SOURCE_WORDS:
        return SOURCE_WORDS[name]
    return next((name.removesuffix(end) for end in ("_hz", "_m", "_v") if name.endswith(end)), name).replace("_", " ")


def _shown(name: str, value: float) -> str:
    for end, (scale, unit) in _SCALES.items():
        if name.endswith(end):
            return f"{value * scale:.4g} {unit}".strip()
    return f"{100 * value:.1f} %"
