"""The picture of a run: where the stage was, how far from where it should be, and what that took."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from numpy.typing import NDArray

from hil.bus.load_trace import BusTrace, read_bus_trace
from hil.pictures import style
from hil.pictures.style import box, dress, dress_space, legend, save, sheet
from hil.recording.recording import Recording
from hil.runs.metrics import bound_words
from hil.runs.summary import Summary

Array = NDArray[np.float64]

_ENVELOPES = 2500  # more points than the picture has pixels across
_PATH_POINTS = 6000
_LEAST_SPAN_UM = 0.2  # of a position's row: its scale has room for two decimals
_FLAT = 8.0  # an axis whose largest error is this much smaller than another's gets a scale of its own


@dataclass
class Signals:
    """What is drawn: the extremes of each signal at n instants, and the path of the scan."""

    t_s: Array
    """(n,)"""
    low: dict[str, Array]
    """by field of the recording, or ``error_nm``: (n, 3)"""
    high: dict[str, Array]
    path_um: Array
    """(m, 3), true position while scanning"""
    path_error_nm: Array
    """(m,), distance from the reference"""


def read_signals(recording: Recording) -> Signals:
    """Envelopes of a recording of any length, block by block."""
    fields = ("reference_m", "position_m", "comb_voltage_v")
    every = max(1, -(-recording.ticks // _ENVELOPES))
    count = -(-recording.ticks // every)
    names = (*fields, "error_nm")
    low = {name: np.full((count, 3), np.inf) for name in names}
    high = {name: np.full((count, 3), -np.inf) for name in names}
    windows = [s["scan_us"] for s in recording.metadata["segments"] if s.get("scan_us")]
    period_us = recording.metadata["period_us"]
    scan_ticks = sum(end - begin for begin, end in windows) // period_us
    stride = max(1, scan_ticks // _PATH_POINTS)
    path, path_error = [np.empty((0, 3))], [np.empty(0)]
    first = 0
    for block in recording.blocks((*fields, "reference_tick")):
        block["error_nm"] = (block["position_m"] - block["reference_m"]) * 1e9
        ticks = len(block["reference_tick"])
        bins = (first + np.arange(ticks)) // every
        starts = np.flatnonzero(np.diff(bins, prepend=-1))
        for name in names:
            at = bins[starts]
            low[name][at] = np.minimum(low[name][at], np.minimum.reduceat(block[name], starts))
            high[name][at] = np.maximum(high[name][at], np.maximum.reduceat(block[name], starts))
        t_us = block["reference_tick"] * period_us
        scanning = np.any([(t_us >= begin) & (t_us < end) for begin, end in windows] or [np.zeros(ticks, bool)], axis=0)
        chosen = np.flatnonzero(scanning)[::stride]
        path.append(block["position_m"][chosen] * 1e6)
        path_error.append(np.linalg.norm(block["error_nm"][chosen], axis=1))
        first += ticks
    t_s = np.arange(count) * every * period_us * 1e-6
    return Signals(t_s, low, high, np.concatenate(path), np.concatenate(path_error))


def draw_report(recording_path: str | Path, frame_log: str | Path | None, summary: Summary, out: str | Path) -> None:
    """Draw the recording, the frame log if there is one and the summary's figures to a PNG of 1600 pixels across."""
    recording = Recording.open(recording_path)
    signals = read_signals(recording)
    bus = _bus_trace(frame_log, recording.metadata)
    figure = sheet(16, 11, dpi=100, free=True)
    grid = figure.add_gridspec(
        8, 2, width_ratios=(1.5, 1), height_ratios=(1, 1, 1, 0.8, 0.8, 0.8, 1.1, 0.7),
        left=0.058, right=0.97, top=0.888, bottom=0.052, hspace=0.18, wspace=0.07,
    )  # fmt: skip
    rows = [figure.add_subplot(grid[row, 0]) for row in range(8)]
    begin_s = _tracking_begin_s(recording)
    limits_nm = _error_limits_nm(signals, _measured_windows(recording, begin_s))
    for axis in range(3):
        _draw_position(rows[axis], signals, axis)
        _draw_error(rows[3 + axis], signals, axis, limits_nm, summary)
    _draw_voltages(rows[6], signals)
    _draw_bus(rows[7], bus, summary)
    _dress_time_axes(rows, signals.t_s, recording, begin_s)
    _draw_path(figure, signals)
    _draw_figures(figure.add_subplot(grid[5:8, 1]), summary)
    _draw_title(figure, summary)
    save(figure, out)


def _draw_position(plot: Axes, signals: Signals, axis: int) -> None:
    for field, colour, width, label in (
        ("reference_m", style.REFERENCE, 3.4, "reference"),
        ("position_m", style.AXIS[axis], 1.0, "true position"),
    ):
        low, high = signals.low[field][:, axis] * 1e6, signals.high[field][:, axis] * 1e6
        _plot_envelope(plot, signals.t_s, low, high, colour, width, label)
    plot.set_ylabel(f"{'xyz'[axis]}  (µm)")
    plot.margins(y=0.14)
    low_um, high_um = plot.get_ylim()
    if high_um - low_um < _LEAST_SPAN_UM:  # an axis that stands still: its noise is in the row of its error
        middle_um = (low_um + high_um) / 2
        plot.set_ylim(middle_um - _LEAST_SPAN_UM / 2, middle_um + _LEAST_SPAN_UM / 2)
    if axis == 2:
        legend(plot, "lower right", columns=2)


def _draw_error(plot: Axes, signals: Signals, axis: int, limits_nm: Array, summary: Summary) -> None:
    low, high = signals.low["error_nm"][:, axis], signals.high["error_nm"][:, axis]
    _plot_envelope(plot, signals.t_s, low, high, style.AXIS[axis], 0.6, "")
    plot.set_ylim(-limits_nm[axis], limits_nm[axis])
    plot.axhline(0, color=style.INK, linewidth=0.5)
    name, rows = "xyz"[axis], summary.rows
    plot.set_ylabel(f"{name} error\n(nm)", linespacing=1.3)
    words = [
        f"{label} {measured[name]:.2f} nm"
        for label, measured in (
            ("scan rms", rows.rms_error_nm),
            ("max", rows.max_error_nm),
            ("hold rms", rows.hold_rms_nm),
            ("noise", rows.hold_noise_nm),
        )
        if measured
    ]
    if not np.all(limits_nm == limits_nm[0]):
        words.insert(0, "own scale:")
    plot.text(
        0.995,
        0.97,
        "   ".join(words),
        transform=plot.transAxes,
        ha="right",
        va="top",
        fontsize=style.SMALL_PT,
        color=style.INK,
        bbox=box(),
    )


def _error_limits_nm(signals: Signals, windows: Sequence[tuple[float, float]]) -> Array:
    """Half heights (3,) of the error plots: what was measured fills two thirds; what came before may leave the picture.
    All alike, so that axes can be compared, but for one that would be flat at the scale of the largest.
    """
    t_s = signals.t_s
    inside = np.any([(t_s >= a) & (t_s < b) for a, b in windows], axis=0) if windows else np.ones(len(t_s), bool)
    extremes = np.abs(np.concatenate([signals.low["error_nm"][inside], signals.high["error_nm"][inside]]))
    if not extremes.size:
        return np.ones(3)
    each = np.where(np.isfinite(extremes), extremes, 0.0).max(axis=0)
    largest = float(each.max()) or 1.0
    return np.where((each > largest / _FLAT) | (each == 0.0), 1.5 * largest, 1.5 * each)


def _draw_voltages(plot: Axes, signals: Signals) -> None:
    for comb in range(3):
        low, high = signals.low["comb_voltage_v"][:, comb], signals.high["comb_voltage_v"][:, comb]
        _plot_envelope(plot, signals.t_s, low, high, style.COMB[comb], 0.9, f"comb {comb + 1}")
    plot.set_ylabel("combs  (V)")
    plot.margins(y=0.12)
    legend(plot, "lower right", columns=3)


def _draw_bus(plot: Axes, bus: BusTrace | None, summary: Summary) -> None:
    plot.set_ylabel("bus load  (%)")
    plot.set_ylim(0, 100)
    plot.set_yticks([0, 50, 100])
    if bus is None:
        words = "no bus in this lane" if summary.loop.bus_load is None else f"{summary.loop.bus_load:.1%} on average"
        plot.text(0.5, 0.5, words, transform=plot.transAxes, ha="center", va="center", color=style.FAINT)
        return
    plot.fill_between(bus.t_s, 0, bus.load * 100, color="#c9d3dc", linewidth=0, step="mid")
    plot.step(bus.t_s, bus.load * 100, where="mid", color=style.MUTED, linewidth=0.9)


def _dress_time_axes(plots: Sequence[Axes], t_s: Array, recording: Recording, begin_s: float | None) -> None:
    for plot in plots:
        plot.set_xlim(float(t_s[0]), float(t_s[-1]) if len(t_s) > 1 else 1.0)
        dress(plot, "stage time  (s)" if plot is plots[-1] else "", grid="y")
        plot.tick_params(labelbottom=plot is plots[-1])
        plot.yaxis.set_label_coords(-0.058, 0.5)
    if begin_s is None:
        return
    for segment in recording.metadata["segments"]:
        window = segment.get("scan_us") or segment.get("still_us")
        if window is None:
            continue
        a, b = (begin_s + t * 1e-6 for t in window)
        for plot in plots:
            plot.axvspan(a, b, color=style.WASH, linewidth=0, zorder=0)
        if (b - a) > 0.03 * float(t_s[-1]):
            words = "scan" if segment.get("scan_us") else "hold noise"
            plots[0].annotate(
                words, ((a + b) / 2, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 3),
                textcoords="offset points", ha="center", fontsize=style.SMALL_PT, color=style.MUTED,
            )  # fmt: skip


def _draw_path(figure: Figure, signals: Signals) -> None:
    points = signals.path_um
    if len(points) < 2:
        figure.text(0.8, 0.65, "nothing was scanned", ha="center", color=style.FAINT)
        return
    plot: Any = figure.add_axes((0.585, 0.40, 0.385, 0.5), projection="3d", computed_zorder=False)
    top = float(np.percentile(signals.path_error_nm, 99.5)) or 1.0
    scale = ScalarMappable(Normalize(0.0, top), style.MAP)
    steps = np.stack([points[:-1], points[1:]], axis=1)
    plot.add_collection3d(Line3DCollection(steps, colors=scale.to_rgba(signals.path_error_nm[1:]), linewidths=1.4))
    middle = (points.max(axis=0) + points.min(axis=0)) / 2
    extent = np.ptp(points, axis=0)
    span = np.maximum(extent, 0.25 * extent.max())
    for axis, name in enumerate("xyz"):
        getattr(plot, f"set_{name}lim")(middle[axis] - 0.54 * span[axis], middle[axis] + 0.54 * span[axis])
        plot.tick_params(axis=name, labelsize=style.TINY_PT, pad=1, color=style.FAINT)
        plot.locator_params(axis=name, nbins=5)
    plot.grid(False)
    plot.set_box_aspect(tuple(np.maximum(span / span.max(), 0.5)), zoom=0.92)
    plot.view_init(elev=24, azim=-58)
    dress_space(plot, "x  (µm)", "y  (µm)", "z  (µm)")
    figure.text(
        0.79, 0.893, "true path of the scan", fontsize=style.TITLE_PT, color=style.INK, ha="center", va="center"
    )
    bar = figure.colorbar(
        scale, cax=figure.add_axes((0.68, 0.405, 0.22, 0.011)), orientation="horizontal", extend="max"
    )
    bar.set_label("distance from the reference  (nm)", fontsize=style.SMALL_PT)
    bar.ax.tick_params(labelsize=style.TINY_PT, color=style.FAINT)
    bar.outline.set_visible(False)


def _draw_figures(plot: Axes, summary: Summary) -> None:
    """The checks as a table: name, value, bound, verdict in words and colour."""
    plot.set_axis_off()
    checks = summary.checks
    plot.set_xlim(0, 1)
    plot.set_ylim(-max(8.0, len(checks) + 1.6), 0.4)
    columns = ((0.02, "left"), (0.54, "right"), (0.78, "right"), (0.98, "right"))
    for (x, side), words in zip(columns, ("check", "value", "bound", ""), strict=True):
        plot.text(x, 0, words, ha=side, va="center", fontsize=style.SMALL_PT, color=style.MUTED)
    plot.axhline(-0.55, xmin=0.01, xmax=0.99, color=style.GRID, linewidth=0.8)
    for row, check in enumerate(checks, start=1):
        ok = check.ok
        words, colour = {True: ("holds", style.GOOD), False: ("fails", style.BAD), None: ("no bus", style.FAINT)}[ok]
        value = "none" if check.value is None else f"{check.value:.4g}"
        for (x, side), text in zip(columns, (check.name, value, bound_words(check), words), strict=True):
            plot.text(
                x, -row, text, ha=side, va="center", fontsize=style.LABEL_PT,
                color=colour if text is words else style.INK,
                fontweight="bold" if text is words and ok is False else "normal",
            )  # fmt: skip


def _draw_title(figure: Figure, summary: Summary) -> None:
    heading = f"{summary.scenario}   ·   {summary.lane} lane   ·   seed {summary.seed}"
    figure.text(0.055, 0.962, heading, fontsize=style.HEADING_PT, color=style.INK, fontweight="bold", va="center")
    rate = f"{1e6 / summary.period_us:,.0f} ticks/s".replace(",", " ")
    parts = [
        f"stage {summary.stage}",
        f"plant {summary.plant}",
        f"law {summary.controller}",
        f"bus {summary.bus}",
        rate,
    ]
    for measured, words in ((summary.rows.rms_error_nm, "rms error"), (summary.rows.hold_rms_nm, "hold")):
        if measured:
            parts.append(f"{words} " + " / ".join(f"{v:.2f}" for v in measured.values()) + " nm")
    if summary.loop.bus_load is not None:
        parts.append(f"bus load {summary.loop.bus_load:.0%}")
    figure.text(0.055, 0.927, "   ·   ".join(parts), fontsize=style.LABEL_PT, color=style.MUTED, va="center")
    verdict, colour = ("all checks hold", style.GOOD) if summary.ok else ("checks fail", style.BAD)
    if summary.interrupted:
        verdict, colour = "interrupted", style.BAD
    elif summary.loop.faults:
        verdict, colour = "fault", style.BAD
    figure.text(
        0.965, 0.962, verdict, fontsize=style.TITLE_PT, color=colour, ha="right", va="center", fontweight="bold"
    )


def _plot_envelope(
    plot: Axes, t_s: Array, low: Array, high: Array, colour: str, width: float, label: str, alpha: float = 1.0
) -> None:
    """Low and high of each instant as one line; where they are equal it is the plain signal."""
    if np.array_equal(low, high):
        plot.plot(t_s, low, color=colour, linewidth=width, label=label, alpha=alpha)
    else:
        plot.plot(
            np.repeat(t_s, 2),
            np.column_stack([low, high]).ravel(),
            color=colour,
            linewidth=width,
            label=label,
            alpha=alpha,
        )


def _tracking_begin_s(recording: Recording) -> float | None:
    """Stage time at which the reference starts."""
    first = 0
    for block in recording.blocks(("reference_tick",)):
        tracking = np.flatnonzero(block["reference_tick"] >= 0)
        if len(tracking):
            at = int(tracking[0])
            return float((first + at - int(block["reference_tick"][at])) * recording.metadata["period_us"]) * 1e-6
        first += len(block["reference_tick"])
    return None


def _measured_windows(recording: Recording, begin_s: float | None) -> list[tuple[float, float]]:
    if begin_s is None:
        return []
    windows: Iterable[Any] = (s.get(key) for s in recording.metadata["segments"] for key in ("scan_us", "still_us"))
    return [(begin_s + w[0] * 1e-6, begin_s + w[1] * 1e-6) for w in windows if w]


def _bus_trace(frame_log: str | Path | None, metadata: dict[str, Any]) -> BusTrace | None:
    can = metadata["config"]["bus"].get("can")
    if frame_log is None or can is None or not Path(frame_log).is_file():
        return None
    return read_bus_trace(frame_log, can)
