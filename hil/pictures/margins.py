"""Pictures of a loop: Bode plots of L, S and T, and the Nyquist plane with the disk that a margin keeps clear."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hil.studies.margins.measured import MeasuredLoop
from pkxyz_ctrl.design.margins.margins import HALF_POWER, LoopResponse

Array = NDArray[np.float64]

COLOURS = ("#0072b2", "#d55e00", "#009e73")
GREY = "#9aa5ad"
AXES = "xyz"


def draw_bode(
    path: Path, title: str, nominal: LoopResponse, changed: Sequence[LoopResponse], measured: MeasuredLoop | None
) -> None:
    """L in size and phase, S and T in size, for each axis and MIMO; changed plants behind, measured points on top."""
    figure = Figure(figsize=(12.5, 9.5), layout="constrained", dpi=120)
    FigureCanvasAgg(figure)
    panels = figure.subplots(4, 4, sharex=True)
    rows = ("|L|", "phase of L (deg)", "|S|", "|T|")
    for column, name in enumerate((*AXES, "MIMO")):
        for response in changed:
            _curves(panels[:, column], response, column, {"color": GREY, "lw": 0.4, "alpha": 0.6})
        _curves(panels[:, column], nominal, column, {"color": (*COLOURS, "black")[column], "lw": 1.4})
        if measured is not None:
            style = {"color": "black", "marker": ".", "ms": 3, "ls": "none", "alpha": 0.7}
            _curves(panels[:, column], measured.response(), column, style)
        panels[0, column].set_title(name if column < 3 else "MIMO: singular values", fontsize=11)
        panels[2, column].axhline(HALF_POWER, color=GREY, lw=0.8, ls="--")
        panels[2, column].axhline(2.0, color=GREY, lw=0.8, ls=":")
        panels[3, column].set_xlabel("frequency (Hz)")
    for row, label in enumerate(rows):
        panels[row, 0].set_ylabel(label)
    frequency = nominal.frequency_hz
    for axes in panels.ravel():
        axes.set_xscale("log")
        axes.set_xlim(frequency[0], frequency[-1])
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(True, which="major", color="#e6eaed", lw=0.6)
    for row, limits in ((0, (1e-2, 1e2)), (2, (1e-2, 5.0)), (3, (1e-2, 5.0))):
        for axes in panels[row]:
            axes.set_yscale("log")
            axes.set_ylim(*limits)
    for axes in panels[1]:
        axes.set(ylim=(-360, 0), yticks=(-360, -270, -180, -90, 0))
    panels[1, 3].set_axis_off()
    words = ["colour: nominal"]
    words += [f"grey: {len(changed)} changed plants"] if changed else []
    words += ["points: measured in the running loop"] if measured is not None else []
    figure.suptitle(f"{title}  ({', '.join(words)})", fontsize=12)
    figure.savefig(path)


def _curves(panels: Array, response: LoopResponse, column: int, style: dict[str, object]) -> None:
    f = response.frequency_hz
    if column == 3:
        sizes = [np.linalg.svd(m, compute_uv=False) for m in (response.loop, response.s, response.t)]
        for row, values in zip((0, 2, 3), sizes, strict=True):
            panels[row].plot(f, values[:, 0], **style)
            panels[row].plot(f, values[:, -1], **style)
        return
    s = response.s[:, column, column]
    loop = 1.0 / s - 1.0  # cut at this axis, the others closed
    phase = np.degrees(np.angle(loop)) % 360.0 - 360.0
    line = np.where(np.abs(np.diff(phase, prepend=phase[:1])) > 180.0, np.nan, phase)
    panels[0].plot(f, np.abs(loop), **style)
    panels[1].plot(f, phase if style.get("ls") == "none" else line, **style)
    panels[2].plot(f, np.abs(s), **style)
    panels[3].plot(f, np.abs(1.0 - s), **style)


def draw_nyquist(
    path: Path, title: str, nominal: LoopResponse, changed: Sequence[LoopResponse], measured: MeasuredLoop | None
) -> None:
    """The loop of each axis about -1; shaded is what a disk margin of 0.6 keeps clear, dashed where |S| is 2."""
    figure = Figure(figsize=(12.5, 4.6), layout="constrained", dpi=120)
    FigureCanvasAgg(figure)
    turn = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 300))
    edge = -(1.0 + 0.3 * turn) / (1.0 - 0.3 * turn)  # of L that some factor of the disk takes to -1
    for i, axes in enumerate(figure.subplots(1, 3)):
        axes.fill(edge.real, edge.imag, color="#f3d9d0", lw=0)
        axes.plot((-1.0 + 0.5 * turn).real, (0.5 * turn).imag, color=GREY, lw=0.8, ls="--")
        axes.plot(-1, 0, "+", color="black")
        for response, style in (
            *((r, {"color": GREY, "lw": 0.4, "alpha": 0.6}) for r in changed),
            (nominal, {"color": COLOURS[i], "lw": 1.5}),
        ):
            loop = 1.0 / response.s[:, i, i] - 1.0
            axes.plot(loop.real, loop.imag, **style)
        if measured is not None:
            loop = 1.0 / measured.s[:, i, i] - 1.0
            axes.plot(loop.real, loop.imag, ".", color="black", ms=3, alpha=0.7)
        axes.set(xlim=(-3.2, 1.8), ylim=(-2.5, 2.5), xlabel="Re L", title=f"{AXES[i]}", aspect="equal")
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("Im L")
    figure.suptitle(f"{title}: loop of an axis, the others closed", fontsize=12)
    figure.savefig(path)
