"""Pictures of the workspace: its bounding faces in space, cross-sections with the voltage that holds each point,
and the path along its edges on which the paper computed the parasitic tilt."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import NDArray

from hil.pictures.style import (
    AXIS,
    INK,
    LABEL_PT,
    MAP,
    REFERENCE,
    SMALL_PT,
    TINY_PT,
    box,
    dress,
    dress_space,
    legend,
    save,
    sheet,
)
from pkxyz_ctrl.mechanics.workspace import stroke_box, voltage_needed_v
from pkxyz_ctrl.stage import Stage, StageDomainError

Array = NDArray[np.float64]

_LIMIT = "white"


def draw_workspace(stage: Stage, voltage_max_v: float, out: Path) -> None:
    """Fig. 7: the workspace with its six bounding faces,
    and sections at several heights with the voltage needed there.
    """
    title = f"Workspace of the {stage.config.name} stage, and the voltage that holds it"
    figure = sheet(12.6, 6.0, title, free=True)
    _draw_faces(figure, stage)
    _draw_sections(figure, stage, voltage_max_v)
    save(figure, out)


def face_um(stage: Stage, axis: int, bound: float, cells: int) -> Array:
    """Points (cells + 1, cells + 1, 3) in um of the face where slider ``axis`` stands at ``bound`` (m)."""
    low, high = stroke_box(stage)
    line = np.linspace(low, high, cells + 1)
    u, v = np.meshgrid(line, line, indexing="ij")
    return stage.forward_kinematics(np.insert(np.stack([u, v], axis=-1), axis, bound, axis=-1)) * 1e6


def _draw_faces(figure: Figure, stage: Stage) -> None:
    plot: Any = figure.add_axes((-0.01, 0.06, 0.45, 0.86), projection="3d")
    low, high = stroke_box(stage)
    for axis in range(3):
        for bound in (low, high):
            p = face_um(stage, axis, bound, 12)
            quads = np.stack([p[:-1, :-1], p[1:, :-1], p[1:, 1:], p[:-1, 1:]], axis=2).reshape(-1, 4, 3)
            alpha = 0.3 if bound == low else 0.5
            plot.add_collection3d(Poly3DCollection(quads, facecolor=AXIS[axis], edgecolor="none", alpha=alpha))
            rim = np.concatenate([p[:, 0], p[-1, :], p[::-1, -1], p[0, ::-1]])
            plot.plot(*rim.T, color=INK, linewidth=0.8)
        centre = face_um(stage, axis, high, 2)[1, 1]
        outward = centre + 9 * np.append(stage.geometry["e"][0][axis], 0.4)
        plot.text(
            *outward,
            f"$q_{axis + 1}$ = {high * 1e6:g} µm",
            fontsize=SMALL_PT,
            color=AXIS[axis],
            ha="center",
            zorder=20,
            bbox=box(),
        )
    _dress_space(plot)
    plot.text2D(
        0.5, 0.0, "each pair of opposite faces is one slider at its two limits", transform=plot.transAxes,
        fontsize=SMALL_PT, ha="center", color=INK,
    )  # fmt: skip


def _dress_space(plot: Any) -> None:
    dress_space(plot, "x (µm)", "y (µm)", "z (µm)")
    plot.set(xlim=(-20, 20), ylim=(-20, 20), zlim=(0, 40))
    plot.set(xticks=(-15, 0, 15), yticks=(-15, 0, 15), zticks=(0, 10, 20, 30, 40))  # none at a corner of two axes
    plot.view_init(elev=18, azim=-58)


def _draw_sections(figure: Figure, stage: Stage, voltage_max_v: float) -> None:
    top = float(stage.forward_kinematics(np.full(3, stroke_box(stage)[1]))[2])
    heights = np.round(np.array([0.12, 0.27, 0.43, 0.58, 0.74, 0.9]) * top * 1e6)
    highest = float(voltage_needed_v(stage, np.full(3, stroke_box(stage)[1])))
    scale = Normalize(0, highest)
    for index, height in enumerate(heights):
        row, column = divmod(index, 3)
        plot = figure.add_axes((0.515 + column * 0.14, 0.515 - row * 0.425, 0.122, 0.37))
        x = np.linspace(-18, 18, 181)
        inside, voltage = section(stage, height * 1e-6, x * 1e-6)
        plot.contourf(x, x, np.where(inside > 0, voltage, np.nan), 40, cmap=MAP, norm=scale)
        plot.contour(x, x, inside, [0], colors=[INK], linewidths=1.1)
        held = np.where(inside > 0, voltage, np.nan)
        plot.contour(x, x, held, [voltage_max_v], colors=[_LIMIT], linewidths=1.8)
        plot.set_aspect("equal")
        plot.set(xlim=(-18, 18), ylim=(-18, 18), xticks=(-10, 0, 10), yticks=(-10, 0, 10))
        plot.set_title(f"z = {height:g} µm", fontsize=LABEL_PT)
        dress(plot, "x (µm)" if row else "", "y (µm)" if column == 0 else "")
        plot.tick_params(labelsize=TINY_PT, labelbottom=bool(row), labelleft=column == 0)
    bar = figure.colorbar(ScalarMappable(scale, MAP), cax=figure.add_axes((0.935, 0.14, 0.012, 0.67)))
    bar.set_label("highest comb voltage needed (V)")
    if voltage_max_v < highest:
        bar.ax.axhline(voltage_max_v, color=_LIMIT, linewidth=2.4)
    figure.text(
        0.515, 0.015, f"black: stroke limits; white: {voltage_max_v:g} V, held inside it", fontsize=SMALL_PT, color=INK
    )


def section(stage: Stage, height_m: float, line_m: Array) -> tuple[Array, Array]:
    """Distance in m to the nearest stroke limit (n, n), negative outside, and the voltage needed, at one height.

    First axis y, second x; the voltage is NaN where the links do not reach.
    """
    low, high = stroke_box(stage)
    x, y = np.meshgrid(line_m, line_m)
    points = np.stack([x, y, np.full_like(x, height_m)], axis=-1)
    strokes = stage.inverse_kinematics(points)
    distance = np.minimum(strokes - low, high - strokes).min(axis=-1)
    voltage = np.full(x.shape, np.nan)
    near = distance > -3e-6
    try:
        voltage[near] = voltage_needed_v(stage, strokes[near])
    except StageDomainError:
        near = distance >= 0
        voltage[near] = voltage_needed_v(stage, strokes[near])
    return distance, voltage


EDGE_PATH = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 1]], dtype=float)
"""Corners of the path of Appendix B in units of full stroke: rest, greatest lateral
displacement, and on to the highest point.
"""


def edge_path(stage: Stage, points: int = 60) -> tuple[Array, Array]:
    """Strokes (n, 3) and positions (n, 3) in m along the edges of Appendix B's path."""
    low, high = stroke_box(stage)
    share = np.linspace(0, 1, points)[:, None]
    legs = [a + (b - a) * share for a, b in pairwise(EDGE_PATH)]
    strokes = low + (high - low) * np.concatenate(legs)
    return strokes, stage.forward_kinematics(strokes)


def draw_edge_path(stage: Stage, out: Path) -> None:
    """Appendix B: the path along the edges, as a path; the tilt on it came from finite elements,
    a rigid model has none.
    """
    strokes, positions = edge_path(stage)
    figure = sheet(
        11.0, 5.0, "Path of Appendix B along the workspace's edges (the rigid mechanism has no tilt on it)", free=True
    )
    plot: Any = figure.add_axes((0.0, 0.03, 0.5, 0.86), projection="3d")
    low, high = stroke_box(stage)
    for axis in range(3):
        for bound in (low, high):
            p = face_um(stage, axis, bound, 12)
            rim = np.concatenate([p[:, 0], p[-1, :], p[::-1, -1], p[0, ::-1]])
            plot.plot(*rim.T, color=REFERENCE, linewidth=0.8)
    plot.plot(*(positions.T * 1e6), color=AXIS[1], linewidth=2.6)
    corners = stage.forward_kinematics(low + (high - low) * EDGE_PATH) * 1e6
    plot.plot(*corners.T, "o", color=AXIS[1], markersize=5)
    for corner, words in zip(corners, ("rest", "furthest out", "", "highest"), strict=True):
        plot.text(corner[0] + 2, corner[1], corner[2] + 1.5, words, fontsize=SMALL_PT, color=INK, bbox=box())
    _dress_space(plot)
    travelled = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))]) * 1e6
    for row, (values, names) in enumerate(((strokes, ("q₁", "q₂", "q₃")), (positions, "xyz"))):
        right = figure.add_axes((0.58, 0.54 - row * 0.41, 0.33, 0.34))
        for axis, style in enumerate(("-", "--", "-.")):
            right.plot(travelled, values[:, axis] * 1e6, style, color=AXIS[axis], linewidth=1.8, label=names[axis])
        legend(right, "center left", anchor=(1.0, 0.5))
        dress(right, "way along the path (µm)" if row else "", ("stroke (µm)", "position (µm)")[row])
        right.tick_params(labelbottom=bool(row))
    save(figure, out)
