"""The picture of a run at the wall clock: reference and estimate, commanded voltages, and how late its ticks were."""

from pathlib import Path

import numpy as np

from hil.pictures.latency import draw_lateness
from hil.pictures.style import AXIS, COMB, REFERENCE, dress, legend, save, sheet
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
    figure = sheet(
        16, 10,
        f"{summary.scenario}   ·   wall clock   ·   bus {summary.bus}   ·   {summary.rows.ticks} ticks, "
        f"{summary.loop.missed_ticks} missed, faults: {len(summary.loop.faults)}",
        dpi=100,
    )  # fmt: skip
    plots = figure.subplots(4, 1, height_ratios=(2, 1.2, 1.2, 1.2))
    error = np.where(tracking[:, None], estimate - reference, np.nan)
    for axis, name in enumerate("xyz"):
        colour = AXIS[axis]
        plots[0].plot(t_s, reference[:, axis] * 1e6, color=REFERENCE, linewidth=3,
                      label="reference" if axis == 0 else None)  # fmt: skip
        plots[0].plot(t_s, estimate[:, axis] * 1e6, color=colour, linewidth=1, label=f"{name} estimated")
        plots[1].plot(t_s, error[:, axis] * 1e9, color=colour, linewidth=0.6)
    for comb in range(3):
        volts = recording.vector("voltage_v")[::step, comb]
        plots[2].plot(t_s, volts, color=COMB[comb], linewidth=0.9, label=f"comb {comb + 1} commanded")
    for plot, label in zip(plots, ("position  (µm)", "estimate less\nreference  (nm)", "combs  (V)"), strict=False):
        dress(plot, "stage time  (s)", label, grid="y")
        plot.set_xlim(plots[0].get_xlim())  # also where the loop was closed for a while only
    for plot in (plots[0], plots[2]):
        legend(plot, "lower right", columns=4)
    draw_lateness(plots[3], {"wake-ups of this run": lateness_us})
    save(figure, out)
