"""Sampled devices in a closed loop: what the shipped law makes of them, and laws that know the device, and which
spread makes them differ.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from hil.pictures.style import BLUE, GREEN, ORANGE, VERMILION, bound, dress, save, sheet
from hil.pictures.wafer.overview import draw_indices
from hil.studies.wafer.causes import Indices
from hil.studies.wafer.closed_loop import ClosedLoops
from hil.studies.wafer.shares import Share

Columns = Mapping[str, NDArray[Any]]

_COLOURS = {"shipped": BLUE, "identified": ORANGE, "instrument": VERMILION, "known": GREEN}
_WIDTHS = {"shipped": 3.5}
"""Of what lies below another curve for the most part."""
_LEGEND = {
    "shipped": "law as shipped",
    "identified": "as identified",
    "instrument": "and with an instrument",
    "known": "law for the device as it is",
}
_PANELS = {
    "peak_s": "Ms in the middle of the strokes",
    "rejection_hz": "rejection there, |S| < -3 dB up to (Hz)",
    "error_about_mean_nm": "RMS error about its mean (nm)",
    "error_nm": "RMS error (nm)",
}
_LINEAR = ("peak_s", "rejection_hz")
_SHORT = {
    "peak_s": "Ms", "rejection_hz": "rejection", "error_nm": "error", "error_about_mean_nm": "error about mean",
    "ok": "all met",
}  # fmt: skip


def draw_loops(
    asked: ClosedLoops, columns: Columns, shares: Mapping[str, Share], found: Indices | None, path: Path
) -> None:
    """Each figure over the share of devices that stay below it, what the links' height leaves of the error, and the
    causes.

    ``columns`` of the study's table; ``shares`` by law; without causes their plot is left out.
    """
    said = ", ".join(f"{_LEGEND[law]}: {shares[law].value:.0%} work" for law in asked.laws)
    name = f"{asked.wafers.process.name}, {asked.scenario.config.name}, {len(columns['wafer'])} devices"
    figure = sheet(15.0, 9.6 if found is not None else 8.4, f"{name}; {said}")
    halves: Any = figure.subfigures(2, 1, height_ratios=(1.0, 1.2 if found is not None else 1.0))
    above, below = halves
    panels = above.subplots(1, len(_PANELS))
    for plot, (key, words) in zip(panels, _PANELS.items(), strict=True):
        for law in asked.laws:
            _below(plot, columns[f"{law}.{key}"], law)
            limit = asked.wafers.process.closed_loop.get(f"{law}.{key}")
            if limit is not None and limit.max is not None:
                plot.axvline(limit.max, color=_COLOURS[law], lw=1.0, ls="--")
        plot.set_xscale("linear" if key in _LINEAR else "log")
        plot.set_ylim(0.0, 101.0)
        dress(plot, words, "devices at most there (%)")
    above.legend(
        *panels[0].get_legend_handles_labels(), frameon=False, loc="outside lower center", ncols=len(asked.laws)
    )
    if found is None:
        _over_height(below.subplots(), asked, columns)
    else:
        left, right = below.subplots(1, 2, width_ratios=(1.0, 2.0))
        _over_height(left, asked, columns)
        draw_indices(right, found, [_short(name) for name in found.figures])
    save(figure, path)


def _short(name: str) -> str:
    """``shipped.peak_s``, ``ok.known`` in words."""
    first, second = name.split(".")
    law, key = (second, first) if first == "ok" else (first, second)
    return f"{law}: {_SHORT[key]}"


def _below(plot: Axes, values: NDArray[np.float64], law: str) -> None:
    order = np.sort(values[np.isfinite(values)])
    share = 100.0 * np.arange(1, len(order) + 1) / len(values)
    plot.step(order, share, where="post", color=_COLOURS[law], label=_LEGEND[law], lw=_WIDTHS.get(law, 1.5))


def _over_height(plot: Axes, asked: ClosedLoops, columns: Columns) -> None:
    for law in asked.laws:
        error = columns[f"{law}.error_nm"]
        plot.plot(
            1e6 * columns["handle_m"], error, ".", ms=8 if law == "shipped" else 5, color=_COLOURS[law], alpha=0.8
        )
    bound(plot, 5.0, "5 nm", float(1e6 * columns["handle_m"].min()))
    plot.set_yscale("log")
    dress(plot, "handle thicker than drawn (µm)", "RMS error (nm)")
