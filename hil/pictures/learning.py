"""The picture of what was learnt: the error of each period, and where in the period it was and is."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FormatStrFormatter, LogLocator, MaxNLocator, NullFormatter

from hil.pictures.style import (
    AXIS,
    HEADING_PT,
    INK,
    LABEL_PT,
    MUTED,
    REFERENCE,
    VERMILION,
    WASH,
    bound,
    dress,
    legend,
    save,
    sheet,
)  # fmt: skip
from hil.recording.recording import Recording
from hil.runs.period_errors import WITHIN, PeriodErrors
from hil.runs.scenario import restore
from hil.runs.summary import Summary


def draw_learning(recording_path: Path, summary: Summary, out: Path) -> None:
    """Draw the learning of a recorded run to a PNG of 1600 pixels across."""
    recording = Recording.open(recording_path)
    scenario = restore(recording.metadata["config"], recording_path.parent)
    assert scenario.config.learning is not None
    errors = PeriodErrors(scenario.trajectory, scenario.bus.period_us, scenario.config.learning)
    errors.look_at(recording)
    figure = sheet(16, 6.5, dpi=100, free=True)
    grid = figure.add_gridspec(
        3, 2, width_ratios=(1, 1.5), left=0.058, right=0.97, top=0.84, bottom=0.1, hspace=0.2, wspace=0.13
    )
    draw_periods(figure.add_subplot(grid[:, 0]), errors)
    plots = [figure.add_subplot(grid[axis, 1]) for axis in range(3)]
    draw_profile(plots, errors)
    figure.text(
        0.058, 0.945, f"{summary.scenario}   ·   what was learnt", fontsize=HEADING_PT, color=INK, weight="bold"
    )
    figure.text(
        0.058, 0.9, f"plant {summary.plant}   ·   law {summary.controller}   ·   bus {summary.bus}   ·   "
        f"{scenario.config.learning.mode}   ·   seed {summary.seed}", fontsize=LABEL_PT, color=MUTED,
    )  # fmt: skip
    save(figure, out)


def draw_periods(plot: Axes, errors: PeriodErrors) -> None:
    """Periodic error over periods, logarithmic, with a tenth of the first one."""
    for values, colour, words in ((errors.sensed_nm, MUTED, "as sensed"), (errors.true_nm, VERMILION, "true")):
        if values:
            plot.semilogy(np.arange(len(values)), values, "o-", color=colour, label=words, markersize=6)
    tenth = errors.sensed_nm[0] / 10.0
    bound(plot, tenth, "a tenth of the first")
    plot.axvspan(0, WITHIN, color=WASH, linewidth=0, zorder=0)
    plot.xaxis.set_major_locator(MaxNLocator(integer=True))
    plot.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    plot.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    plot.yaxis.set_minor_formatter(NullFormatter())
    legend(plot)
    dress(plot, "period", "periodic error  (nm, rms over the period, all axes)", grid="y")


def draw_profile(plots: list[Axes], errors: PeriodErrors) -> None:
    """Error over the first and the last period, an axis on each plot, less its mean."""
    if errors.first_m is None or errors.last_m is None:
        return
    t_ms = np.arange(errors.table.period) * errors.period_us * 1e-3
    last = len(errors.sensed_nm) - 1
    for axis, plot in enumerate(plots):
        for error_m, colour, words in (
            (errors.first_m, REFERENCE, "period 0"), (errors.last_m, AXIS[axis], f"period {last}"),
        ):  # fmt: skip
            values = (error_m[:, axis] - error_m[:, axis].mean()) * 1e9
            plot.plot(t_ms, values, color=colour, linewidth=1.0, label=words)
        legend(plot, "lower right", columns=2, anchor=(1.0, 0.9))
        dress(plot, "time in the period  (ms)" if axis == 2 else "", f"{'xyz'[axis]} error\n(nm)", grid="y")
        plot.tick_params(labelbottom=axis == 2)
    plots[0].set_title(
        "error less its mean, " + ("true" if errors.true_nm else "as sensed"), fontsize=LABEL_PT, color=INK, loc="left"
    )
