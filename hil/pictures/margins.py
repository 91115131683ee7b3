"""Pictures of a loop: Bode plots of L, S and T, and the Nyquist plane with the disk that a margin keeps clear."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.pictures.style import AXIS, BAD_WASH, FAINT, INK, TITLE_PT, bound, dress, save, sheet
from hil.studies.margins.measured import MeasuredLoop
from pkxyz_ctrl.design.margins.margins import HALF_POWER, LoopResponse

Array = NDArray[np.float64]

_CHANGED = {"color": FAINT, "lw": 0.4, "alpha": 0.6}


def draw_bode(
    path: Path, title: str, nominal: LoopResponse, changed: Sequence[LoopResponse], measured: MeasuredLoop | None
) -> None:
    """L in size and phase, S and T in size, for each axis and MIMO; changed plants behind, measured points on top."""
    words = ["colour: nominal"]
    words += [f"grey: {len(changed)} changed plants"] if changed else []
    words += ["points: measured in the running loop"] if measured is not None else []
    figure = sheet(12.5, 9.5, f"{title}  ({', '.join(words)})")
    panels = figure.subplots(4, 4, sharex=True)
    rows = ("|L|", "phase of L (deg)", "|S|", "|T|")
    for column, name in enumerate(("x", "y", "z", "MIMO")):
        for response in changed:
            _curves(panels[:, column], response, column, _CHANGED)
        _curves(panels[:, column], nominal, column, {"color": (*AXIS, INK)[column], "lw": 1.4})
        if measured is not None:
            style = {"color": INK, "marker": ".", "ms": 3, "ls": "none", "alpha": 0.7}
            _curves(panels[:, column], measured.response(), column, style)
        panels[0, column].set_title(name if column < 3 else "MIMO: singular values", fontsize=TITLE_PT)
        first_hz = 1.05 * nominal.frequency_hz[0]
        bound(panels[2, column], HALF_POWER, "-3 dB", first_hz)
        bound(panels[2, column], 2.0, "2", first_hz, style=":")
    frequency = nominal.frequency_hz
    for (row, column), axes in np.ndenumerate(panels):
        axes.set_xscale("log")
        axes.set_xlim(frequency[0], frequency[-1])
        dress(axes, "frequency (Hz)" if row == 3 else "", rows[row] if column == 0 else "")
    for row, limits in ((0, (1e-2, 1e2)), (2, (1e-2, 5.0)), (3, (1e-2, 5.0))):
        for axes in panels[row]:
            axes.set_yscale("log")
            axes.set_ylim(*limits)
    for axes in panels[1]:
        axes.set(ylim=(-360, 0), yticks=(-360, -270, -180, -90, 0))
    panels[1, 3].set_axis_off()
    save(figure, path)


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
    key = "shaded: disk margin below 0.6, dashed: |S| above 2"
    figure = sheet(12.5, 4.6, f"{title}: loop of an axis, the others closed ({key})")
    turn = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 300))
    edge = -(1.0 + 0.3 * turn) / (1.0 - 0.3 * turn)  # of L that some factor of the disk takes to -1
    for i, axes in enumerate(figure.subplots(1, 3)):
        axes.fill(edge.real, edge.imag, color=BAD_WASH, lw=0)
        axes.plot((-1.0 + 0.5 * turn).real, (0.5 * turn).imag, color=FAINT, lw=0.8, ls="--")
        axes.plot(-1, 0, "+", color=INK)
        for response, style in (
            *((r, _CHANGED) for r in changed),
            (nominal, {"color": AXIS[i], "lw": 1.5}),
        ):
            loop = 1.0 / response.s[:, i, i] - 1.0
            axes.plot(loop.real, loop.imag, **style)
        if measured is not None:
            loop = 1.0 / measured.s[:, i, i] - 1.0
            axes.plot(loop.real, loop.imag, ".", color=INK, ms=3, alpha=0.7)
        axes.set(xlim=(-3.2, 1.8), ylim=(-2.5, 2.5), aspect="equal")
        dress(axes, "Re L", "Im L" if i == 0 else "", "xyz"[i])
    save(figure, path)
