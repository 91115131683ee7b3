"""How late a loop was: histograms by whole microseconds."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes

from hil.pictures.style import SERIES, dress, legend, save, sheet

if TYPE_CHECKING:
    from hil.studies.latency import Latency


def draw_latency(measured: "Latency", path: Path) -> None:
    """Wake-ups and cycles of ``pkxyz latency``, and cyclictest's beside them if it was measured."""
    histograms = {"wake-up of the loop": measured.lateness_us, "cycle": measured.cycle_us}
    if measured.cyclictest_us is not None:
        histograms["cyclictest at the same time"] = measured.cyclictest_us
    figure = sheet(11, 5, f"{measured.ticks} ticks of {measured.period_us} µs, {measured.missed_ticks} missed")
    draw_lateness(figure.subplots(), histograms, "1 + time  (µs)")
    save(figure, path)


def draw_lateness(plot: Axes, histograms: dict[str, list[int]], x_label: str = "1 + lateness  (µs)") -> None:
    """Histograms by whole microseconds as steps, both axes logarithmic."""
    longest = 1
    for (name, counts), colour in zip(histograms.items(), SERIES, strict=False):
        filled = [late_us for late_us, count in enumerate(counts) if count]
        if filled:
            longest = max(longest, filled[-1] + 1)
            at_us = np.arange(len(counts)) + 1
            plot.step(at_us, np.asarray(counts, float), where="mid", color=colour, linewidth=1.1, label=name)
    plot.set_xscale("log")
    plot.set_yscale("log")
    plot.set_xlim(1, 1.2 * longest + 1)
    plot.set_ylim(bottom=0.7)
    dress(plot, x_label, "count", grid="")
    legend(plot, "upper right")
