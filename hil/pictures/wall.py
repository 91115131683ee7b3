"""The picture of a run at the wall clock: reference and estimate, commanded voltages, and how late its ticks were."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from hil.pictures.report import AXIS_COLOURS, COMB_COLOURS
from hil.recording.recording import Recording
from hil.runs.summary import Summary

_POINTS = 20_000


def draw_wall(recording_path: Path, summary: Summary, lateness_us: list[int], out: Path) -> None:
    """Draw a PNG of 1600 pixels across."""
    recording = Recording.open(recording_path)
    step = -(-recording.ticks // _POINTS)
    t_s = recording["tick"][::step] * summary.period_us * 1e-6
    reference, estimate = (recording.vector(name)[::step] for name in ("reference_m", "estimate_m"))
    tracking = recording["reference_tick"][::step] >= 0
    figure = Figure(figsize=(16, 10), dpi=100, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    plots = figure.subplots(4, 1, height_ratios=(2, 1.2, 1.2, 1.2))
    error = np.where(tracking[:, None], estimate - reference, np.nan)
    for axis, name in enumerate("xyz"):
        colour = AXIS_COLOURS[axis]
        plots[0].plot(t_s, reference[:, axis] * 1e6, color="#bdbdbd", linewidth=3,
                      label="reference" if axis == 0 else None)  # fmt: skip
        plots[0].plot(t_s, estimate[:, axis] * 1e6, color=colour, linewidth=1, label=f"{name} estimated")
        plots[1].plot(t_s, error[:, axis] * 1e9, color=colour, linewidth=0.6)
    for comb in range(3):
        volts = recording.vector("voltage_v")[::step, comb]
        plots[2].plot(t_s, volts, color=COMB_COLOURS[comb], linewidth=0.9, label=f"comb {comb + 1} commanded")
    for plot, label in zip(plots, ("position  (µm)", "estimate less\nreference  (nm)", "combs  (V)"), strict=False):
        plot.set_ylabel(label)
        plot.set_xlabel("stage time  (s)")
        plot.set_xlim(plots[0].get_xlim())  # also where the loop was closed for a while only
    for plot in (plots[0], plots[2]):
        plot.legend(loc="lower right", ncols=4, frameon=False, fontsize=9)
    draw_lateness(plots[3], {"wake-ups of this run": lateness_us})
    figure.suptitle(
        f"{summary.scenario}   ·   wall clock   ·   bus {summary.bus}   ·   {summary.rows.ticks} ticks, "
        f"{summary.loop.missed_ticks} missed, faults: {len(summary.loop.faults)}",
        fontsize=15,
    )
    figure.savefig(out)


def draw_lateness(plot: Axes, histograms: dict[str, list[int]]) -> None:
    """Histograms by whole microseconds as steps, both axes logarithmic."""
    longest = 1
    for name, counts in histograms.items():
        filled = [late_us for late_us, count in enumerate(counts) if count]
        if filled:
            longest = max(longest, filled[-1] + 1)
            plot.step(np.arange(len(counts)) + 1, np.asarray(counts, float), where="mid", linewidth=1.1, label=name)
    plot.set_xscale("log")
    plot.set_yscale("log")
    plot.set_xlim(1, 1.2 * longest + 1)
    plot.set_ylim(bottom=0.7)
    plot.set_xlabel("1 + lateness  (µs)")
    plot.set_ylabel("count")
    plot.legend(loc="upper right", frameon=False, fontsize=9)
