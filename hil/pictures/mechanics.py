"""The paper's figures redrawn, and those of the design tools. Lengths in µm on every axis."""

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from numpy.typing import NDArray

from hil.pictures.style import FAINT, INK, LABEL_PT, SERIES, SMALL_PT, WASH, box, dress, legend, save, sheet
from pkxyz_ctrl.elements.flexures import folded_spring_stiffness, link_hinge_stiffness
from pkxyz_ctrl.mechanics.jacobians import nominal_jacobians
from pkxyz_ctrl.mechanics.linearisation import LinearisationStudy
from pkxyz_ctrl.mechanics.modes import modes
from pkxyz_ctrl.mechanics.selection import MARGINS, Selection
from pkxyz_ctrl.mechanics.stiffness import (
    lifting_stiffness_n_per_m,
    nominal_stiffness_n_per_m,
    small_signal_stiffness_n_per_m,
)
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]


def draw_design_space(stages: dict[str, Stage], out: Path) -> None:
    """Fig. 4: L2 against alpha_0 with one constraint for each comb force (Eq. 24 at full stroke);
    above it the comb lifts.
    """
    first = next(iter(stages.values()))
    springs, hinge = folded_spring_stiffness(first.config.flexures), link_hinge_stiffness(first.config.flexures)
    stroke, chains = first.config.limits.stroke_max_m, first.config.flexures.out_of_plane_chains
    elevation, link = np.linspace(0.2, 1.3, 121), np.linspace(0.2e-3, 1.6e-3, 121)
    needed = np.array(
        [
            [lifting_stiffness_n_per_m(springs, hinge, float(b), float(a), chains) * stroke for a in elevation]
            for b in link
        ]
    )
    figure = sheet(
        7.2, 5.2, f"Design space: which comb force lifts over the full {stroke * 1e6:g} µm (Eq. 24)", free=True
    )
    plot = figure.add_axes((0.11, 0.12, 0.86, 0.78))
    levels = [0.5, 0.75, 1.0, 1.5, 2.5, 4.0]
    lines = plot.contour(elevation, link * 1e6, needed * 1e3, levels, colors=SERIES, linewidths=1.6)
    plot.contourf(elevation, link * 1e6, needed * 1e3, [0, 1.0], colors=[WASH], zorder=0)
    plot.clabel(lines, fmt=lambda mn: f"{mn:g} mN", fontsize=SMALL_PT, inline_spacing=4)
    plot.text(0.93, 1480, "lifts with less than 1 mN", fontsize=SMALL_PT, color=SERIES[0])
    for (name, stage), mark, side in zip(stages.items(), ("o", "s"), ((8, -4), (-8, -14)), strict=False):
        at = (float(stage.geometry["elevation_rest_rad"][0]), float(stage.geometry["link_m"][0]) * 1e6)
        plot.plot(*at, mark, color=INK, markersize=6, markerfacecolor="white", markeredgewidth=1.4)
        plot.annotate(
            name,
            at,
            xytext=side,
            textcoords="offset points",
            fontsize=SMALL_PT,
            bbox=box(),
            ha="right" if side[0] < 0 else "left",
        )
    dress(plot, "elevation of the links at rest, α₀ (rad)", "length of the links, L₂ (µm)")
    save(figure, out)


def draw_modes(stage: Stage, out: Path) -> None:
    """Fig. 8: the three translational modes seen from above; the sliders' strokes are those of Eq. 12."""
    found = modes(nominal_stiffness_n_per_m(stage.config), stage.config.dynamics.mass_kg)
    jacobian = nominal_jacobians(stage.config.geometry).stroke_m_per_m
    e = stage.geometry["e"][0]
    title = f"Translational modes of the {stage.config.name} stage, seen from above"
    figure = sheet(10.2, 3.9, title, free=True)
    for axis, words in enumerate(("two sliders in anti-phase", "one against two, twice as far", "all in phase")):
        plot = figure.add_axes((0.02 + axis * 0.325, 0.02, 0.31, 0.76))
        plot.set_aspect("equal")
        plot.axis("off")
        plot.set(xlim=(-1.5, 1.5), ylim=(-1.45, 0.95))
        plot.set_title(f"{'xyz'[axis]}:  {found.frequency_hz[axis]:.1f} Hz\n{words}", fontsize=LABEL_PT, color=INK)
        for chain in range(3):
            base, slider = -1.35 * e[chain], -0.95 * e[chain]
            plot.plot(*np.stack([base, -0.3 * e[chain]], axis=1), color=FAINT, linewidth=1.0, zorder=1)
            plot.plot(
                *slider,
                "s",
                color="white",
                markeredgecolor=SERIES[chain],
                markersize=13,
                markeredgewidth=1.8,
                zorder=2,
            )
            across = np.array([-e[chain][1], e[chain][0]]) * 0.2
            stroke = 0.45 * jacobian[chain, axis] / np.abs(jacobian[:, axis]).max()
            _arrow(plot, slider + across, slider + across + stroke * e[chain], SERIES[chain])
        plot.add_patch(Circle((0, 0), 0.3, facecolor="white", edgecolor=INK, linewidth=1.6, zorder=2))
        if axis < 2:
            _arrow(plot, np.zeros(2), 0.55 * np.eye(2)[axis], INK)
        else:
            plot.plot(0, 0, "o", color=INK, markersize=6, zorder=3)
            plot.add_patch(Circle((0, 0), 0.11, fill=False, edgecolor=INK, linewidth=1.6, zorder=3))
            plot.text(0.3, -0.42, "out of the plane", fontsize=SMALL_PT, color=INK, zorder=3)
    save(figure, out)


def draw_modes_over_workspace(stage: Stage, out: Path) -> None:
    """Natural frequencies from rest to the top corner, and along one stroke: of the flexures (Eq. 38 with the exact
    Hessian), and under the comb voltages that hold the point, which a controller meets.
    """
    figure = sheet(10.2, 3.9, f"Natural frequencies over the workspace of the {stage.config.name} stage")
    limit_um = stage.config.limits.stroke_max_m * 1e6
    stroke_um = np.linspace(0.0, limit_um, 51)
    ways = (((1.0, 1.0, 1.0), "all three strokes together"), ((1.0, 0.0, 0.0), "stroke 1 alone"))
    left, right = figure.subplots(1, 2, sharey=True)
    for plot, (way, words) in zip((left, right), ways, strict=True):
        points = stage.forward_kinematics(np.outer(stroke_um * 1e-6, way))
        free = stage.stiffness(points)
        held = small_signal_stiffness_n_per_m(stage, points, stage.holding_forces(points))
        for mode, colour in enumerate(SERIES[:3]):
            for matrices, style, label in ((free, "-", f"mode {mode + 1}"), (held, "--", "")):
                hz = [modes(k, stage.mass_kg).frequency_hz[mode] for k in matrices]
                plot.plot(stroke_um, hz, style, color=colour, lw=1.8, label=label)
        dress(plot, "stroke (µm)", "natural frequency (Hz)" if plot is left else "", words)
    right.plot([], [], "--", color=INK, lw=1.8, label="at held voltages")
    legend(right, "center left", anchor=(1.0, 0.5))
    save(figure, out)


def _arrow(plot: Axes, start: Array, end: Array, colour: str) -> None:
    if float(np.hypot(*(end - start))) < 1e-9:
        plot.plot(*start, "o", color=colour, markersize=4, zorder=4)
        return
    style = {"arrowstyle": "-|>", "color": colour, "linewidth": 1.8, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 14}
    plot.annotate("", xy=tuple(end), xytext=tuple(start), arrowprops=style, zorder=4)


def draw_linearisation(study: LinearisationStudy, name: str, out: Path) -> None:
    """What constant and relinearised Jacobians cost: distribution over the workspace,
    and growth with height on the axis.
    """
    kinds = (
        ("one Jacobian, at rest", study.at_rest_m, "-"),
        ("one Jacobian, at mid-stroke", study.at_middle_m, "--"),
        ("at rest, then one Newton step", study.newton_m, "-."),
        (f"at the set-point, moves of ±{study.move_m * 1e6:g} µm", study.relinearised_m, ":"),
    )
    figure = sheet(
        10.2, 4.6, f"What a linear model costs on the {name} stage: distance from the exact position", free=True
    )
    left = figure.add_axes((0.075, 0.13, 0.4, 0.74))
    right = figure.add_axes((0.58, 0.13, 0.4, 0.74))
    axial = np.ptp(study.strokes_m, axis=1) == 0
    for (label, error, style), colour in zip(kinds, SERIES, strict=False):
        distance = np.sort(np.linalg.norm(error, axis=1)) * 1e9
        share = np.arange(1, len(distance) + 1) / len(distance) * 100
        shown = distance > 1e-3
        left.plot(distance[shown], share[shown], style, color=colour, linewidth=1.8, label=label)
        height = study.position_m[axial, 2] * 1e6
        size = np.linalg.norm(error[axial], axis=1) * 1e9
        right.plot(height[size > 1e-3], size[size > 1e-3], style, color=colour, linewidth=1.8)
    left.set_xscale("log")
    right.set_yscale("log")
    left.set_xlim(1e-2, 1e4)
    right.set_ylim(1e-2, 1e4)
    legend(left, "upper left", anchor=(0.0, 1.0))
    left.set_ylim(0, 140)
    left.set_yticks([0, 25, 50, 75, 100])
    dress(left, "error (nm)", "share of the workspace below it (%)")
    dress(right, "height above rest on the axis (µm)", "error (nm)")
    save(figure, out)


def draw_selection(selection: Selection, out: Path) -> None:
    """The feasible region over (alpha_0, L1) with the border of each requirement, and the recommendation."""
    region, geometry = selection.region, selection.config.geometry
    figure = sheet(
        7.6, 5.4, "Feasible dimensions: every border is one requirement, the shaded side meets all", free=True
    )
    plot = figure.add_axes((0.1, 0.115, 0.62, 0.79))
    x, y = region.elevation_rad, region.crank_m * 1e6
    worst = region.margin.min(axis=-1)
    plot.contourf(x, y, worst, [0, np.inf], colors=[WASH], zorder=0)
    drawn: list[Line2D] = []
    styles = ("-", "--", "-.", ":", (0, (5, 1, 1, 1)), "-")
    for k, name in enumerate(MARGINS):
        margin = np.where(region.margin[..., 0] > 0, region.margin[..., k], np.nan if k else region.margin[..., 0])
        if np.nanmin(margin) < 0 < np.nanmax(margin):
            colour, style = SERIES[len(drawn) % 6], styles[len(drawn) % 6]
            plot.contour(x, y, margin, [0], colors=[colour], linewidths=1.7, linestyles=[style])
            drawn.append(plot.plot([], [], color=colour, linestyle=style, linewidth=1.7, label=name)[0])
    at = (math.atan2(geometry.height_rest_m, geometry.projection_rest_m), geometry.crank_length_m * 1e6)
    drawn.append(plot.plot(*at, "*", color=INK, markersize=12, linestyle="none", label="recommended")[0])
    legend(plot, "upper left", anchor=(1.02, 1.0))
    dress(plot, "elevation of the links at rest, α₀ (rad)", "crank, L₁ (µm)")
    save(figure, out)
