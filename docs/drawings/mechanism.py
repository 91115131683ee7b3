"""The mechanism with the paper's symbols, from above and from the side (paper, Fig. 2 and 3), drawn to scale from the
geometry of the stage file; only the displacement is exaggerated.
"""

from typing import Any

import numpy as np
from canvas import THEMES, Theme, bare, figure, save
from matplotlib.patches import Arc, FancyArrowPatch, Polygon, Rectangle

from pkxyz_ctrl import Stage

MM = 1e3
SHOWN_AT_M = np.array([110e-6, 60e-6, 130e-6])
"""Displacement of the platform in the drawing: five times what the combs reach, so that angles can be seen."""


def arrow(plot: Any, start: Any, end: Any, colour: str, style: str = "-|>", width: float = 1.1) -> None:
    plot.add_patch(
        FancyArrowPatch(tuple(start), tuple(end), arrowstyle=style, mutation_scale=9, color=colour, linewidth=width,
                        shrinkA=0, shrinkB=0, zorder=5)
    )  # fmt: skip


def block(plot: Any, centre: Any, along: Any, length: float, width: float, **colours: Any) -> None:
    """A rectangle about ``centre`` with its length along a unit vector."""
    across = np.array([-along[1], along[0]])
    corners = [
        centre + a * length / 2 * along + b * width / 2 * across for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))
    ]
    plot.add_patch(Polygon(corners, closed=True, **colours))


def _lengths(plot: Any, points: tuple[Any, Any, Any, Any], axes: tuple[Any, Any], theme: Theme) -> None:
    """The lengths and the angle of chain 1: ``points`` base, slider, pin and platform, ``axes`` inward and left."""
    (base, slider, pin, platform), (e, n) = points, axes
    for a, b, words, offset in (
        (base, slider, "$\\lambda_1$", 0.56), (base, np.zeros(2), "$r$", 0.86),
    ):  # fmt: skip
        shift = -n * offset
        arrow(plot, a + shift, b + shift, theme.ink, "<|-|>", 0.9)
        for end in (a, b):
            plot.plot(*np.array([end, end + shift * 1.06]).T, color=theme.faint, linewidth=0.5, zorder=1)
        plot.text(*((a + b) / 2 + shift * 1.0 + [0.07, 0]), words, color=theme.ink, fontsize=12, va="center")
    plot.text(*(slider * 0.5 + pin * 0.5 + [-0.19, 0.0]), "$L_1$", color=theme.chains[0], fontsize=12, ha="right")
    plot.text(*(pin * 0.5 + platform * 0.5 + [0.07, -0.06]), "$\\delta$", color=theme.chains[0], fontsize=12)
    plot.plot(*np.array([slider, slider + e * 0.56]).T, color=theme.ink, linewidth=0.6, linestyle=":", zorder=5)
    turned = float(np.degrees(np.arctan2(*(pin - slider)[::-1])))
    plot.add_patch(
        Arc(tuple(slider), 0.62, 0.62, theta1=min(turned, 90), theta2=max(turned, 90), color=theme.ink, lw=0.9)
    )
    x, y = slider
    plot.text(x + 0.30, y + 0.27, "$\\theta_1$", color=theme.ink, fontsize=11)
    plot.plot([x + 0.29, x + 0.05], [y + 0.30, y + 0.30], color=theme.ink, linewidth=0.6, zorder=5)


def _directions(plot: Any, inward: Any, left: Any, theme: Theme) -> None:
    """The unit vectors of the chains."""
    for i, colour in enumerate(theme.chains):
        at = -inward[i] * 1.2 + left[i] * 0.30
        arrow(plot, at, at + inward[i] * 0.36, colour)
        plot.text(
            *(at + inward[i] * 0.18 + left[i] * 0.14),
            f"$e_{i + 1}$",
            color=colour,
            fontsize=11,
            ha="center",
            va="center",
        )
    at = -inward[0] * 1.2 + left[0] * 0.30
    arrow(plot, at, at + left[0] * 0.3, theme.chains[0])
    plot.text(
        *(at + left[0] * 0.30 + [-0.1, 0.0]), "$n_1$", color=theme.chains[0], fontsize=11, ha="center", va="center"
    )


def from_above(plot: Any, stage: Stage, theme: Theme) -> None:
    """Plan view in mm about the centre C: sliders, cranks, the links' projections, the platform."""
    g = stage.geometry
    inward, left = g["e"][0][:, :2], g["n"][0][:, :2]
    crank, height_rest = float(g["crank_m"][0]), stage.config.geometry.height_rest_m
    link = float(g["link_m"][0])
    height = height_rest + SHOWN_AT_M[2]
    delta = np.sqrt(link**2 - height**2)
    strokes = stage.inverse_kinematics(SHOWN_AT_M)
    rest = stage.config.geometry
    lambdas = rest.base_radius_m - rest.projection_rest_m - crank + strokes
    p = SHOWN_AT_M[:2]
    for i, colour in enumerate(theme.chains):
        e, n = inward[i], left[i]
        base = -rest.base_radius_m * e * MM
        slider = base + lambdas[i] * e * MM
        pin = (p - delta * e) * MM
        plot.plot(
            *np.array([slider, [0, 0]]).T, color=theme.faint, linewidth=0.7, linestyle=(0, (6, 3, 1, 3)), zorder=1
        )
        for side in (-0.085, 0.085):  # the crank is a parallelogram
            plot.plot(*np.array([slider + side * n, pin + side * n]).T, color=colour, linewidth=2.0, zorder=3)
        block(plot, slider, e, 0.10, 0.34, facecolor=theme.wash, edgecolor=colour, linewidth=1.3, zorder=4)
        block(plot, pin, e, 0.06, 0.28, facecolor=theme.wash, edgecolor=colour, linewidth=1.3, zorder=4)
        plot.plot(*np.array([pin, p * MM]).T, color=colour, linewidth=4.0, alpha=0.55, zorder=3)
        comb(plot, base, slider, slider - base - strokes[i] * MM * e, (e, n), colour, theme)
        plot.plot(*base, ".", color=theme.ink, markersize=5, zorder=6)
        away = -e * 0.16 if i == 0 else -e * 0.34
        plot.text(*(base + away), f"comb {i + 1}", color=colour, ha="center", va="center", fontsize=10)
    corners = [p * MM + 0.062 * np.array([np.cos(a), np.sin(a)]) for a in np.deg2rad([30, 150, 270])]
    plot.add_patch(Polygon(corners, closed=True, facecolor=theme.wash, edgecolor=theme.ink, linewidth=1.4, zorder=6))
    base, pin = -rest.base_radius_m * inward[0] * MM, (p - delta * inward[0]) * MM
    _lengths(plot, (base, base + lambdas[0] * inward[0] * MM, pin, p * MM), (inward[0], left[0]), theme)
    _directions(plot, inward, left, theme)
    plot.plot(0, 0, "+", color=theme.ink, markersize=9, zorder=8)
    plot.text(-0.07, -0.05, "$C$", color=theme.ink, fontsize=11, ha="right", va="top", zorder=8)
    plot.text(*(p * MM + [0, 0.47]), "platform, at $p$", color=theme.ink, fontsize=10, ha="center", zorder=8)
    plot.text(-0.52, -1.44, "fixed half", color=theme.faint, fontsize=9, ha="right", va="center")
    corner = np.array([-1.9, -1.95])
    for way, name in (((0.4, 0), "x"), ((0, 0.4), "y")):
        arrow(plot, corner, corner + way, theme.ink)
        plot.text(*(corner + np.array(way) * 1.25), name, color=theme.ink, fontsize=11, ha="center", va="center")
    plot.set(xlim=(-2.3, 2.3), ylim=(-2.38, 1.55))
    plot.set_title("from above", color=theme.ink, fontsize=11.5, y=0.985)


def comb(plot: Any, base: Any, slider: Any, shaft: Any, axes: Any, colour: str, theme: Theme) -> None:
    """A drive comb: moving fingers on the slider's shaft, fixed ones before them, so that the pull is inward."""
    e, n = axes
    moving = slider - shaft
    plot.plot(*np.array([moving, slider]).T, color=colour, linewidth=2.6, alpha=0.55, zorder=2)
    block(plot, moving, e, 0.06, 0.80, facecolor=theme.wash, edgecolor=colour, linewidth=1.2, zorder=3)
    for side in (-1, 1):
        root = base + 0.56 * e + side * 0.25 * n
        block(plot, root, e, 0.06, 0.32, facecolor=theme.wash, edgecolor=theme.faint, linewidth=1.0, zorder=2)
        for k in np.linspace(-0.13, 0.13, 4):
            plot.plot(*np.array([root + k * n, root + k * n - e * 0.27]).T, color=theme.faint, linewidth=1.2, zorder=2)
        for k in np.linspace(-0.087, 0.173, 4) * side:
            near = moving + side * 0.25 * n + k * n
            plot.plot(*np.array([near, near + e * 0.31]).T, color=colour, linewidth=1.2, zorder=2)


def from_the_side(plot: Any, stage: Stage, theme: Theme) -> None:
    """Chain 1 in the plane of e_1 and z, in mm along e_1 from the base point."""
    rest = stage.config.geometry
    crank, link = rest.crank_length_m, float(stage.geometry["link_m"][0])
    rise = 90e-6
    height = rest.height_rest_m + rise
    delta = float(np.sqrt(link**2 - height**2))
    start = (
        rest.base_radius_m - rest.projection_rest_m - crank + float(stage.inverse_kinematics([0, 0, rise])[0])
    ) * MM
    pin, table = start + crank * MM, start + crank * MM + delta * MM
    colour, z = theme.chains[0], height * MM
    box = {"facecolor": theme.wash, "linewidth": 1.4, "zorder": 4}
    plot.add_patch(Rectangle((0.62, -0.16), 1.55, 0.05, facecolor=theme.wash, edgecolor=theme.faint, linewidth=0.8))
    plot.text(0.66, -0.20, "handle layer", color=theme.faint, fontsize=9.5, va="top")
    plot.add_patch(Rectangle((start - 0.12, -0.045), 0.24, 0.09, edgecolor=colour, **box))
    plot.plot([start + 0.12, pin], [0, 0], color=colour, linewidth=2.6, zorder=3)
    plot.plot([pin, table], [0, z], color=colour, linewidth=4.0, alpha=0.55, zorder=3)
    plot.add_patch(Rectangle((table - 0.05, z - 0.03), 0.26, 0.06, edgecolor=theme.ink, **box))
    plot.plot([start + 0.15, pin - 0.035], [0, 0], "o", color=theme.accent, markersize=5, zorder=6)
    plot.plot([pin, table], [0, z], "s", color=theme.accent, markersize=5, zorder=6)
    arrow(plot, (start - 0.34, 0), (start - 0.12, 0), theme.ink)
    plot.text(start - 0.24, 0.04, "$F_1$", color=theme.ink, fontsize=11, ha="center")
    plot.text(start, 0.075, "slider,\nspring $K_1$", color=colour, fontsize=10, ha="center")
    plot.text((start + pin) / 2 + 0.06, 0.05, "crank $L_1$", color=colour, fontsize=10, ha="center")
    plot.text(
        (start + pin) / 2 + 0.06,
        -0.05,
        "hinges $K_2$, $\\theta$",
        color=theme.accent,
        fontsize=10,
        ha="center",
        va="top",
    )
    plot.text((pin + table) / 2 - 0.05, z / 2 + 0.05, "link $L_2$", color=colour, fontsize=11, ha="right")
    plot.text(table + 0.08, z + 0.06, "platform", color=theme.ink, fontsize=10, ha="center")
    plot.add_patch(Arc((pin, 0), 0.44, 0.44, theta1=0, theta2=float(np.degrees(np.arctan2(height, delta))),
                       color=theme.accent, lw=0.9))  # fmt: skip
    plot.text(pin + 0.235, 0.06, "$\\alpha$, hinges $K_3$", color=theme.accent, fontsize=10)
    plot.plot([pin, table + 0.42], [0, 0], color=theme.faint, linewidth=0.6, linestyle=":")
    plot.plot([table + 0.21, table + 0.42], [z, z], color=theme.faint, linewidth=0.6, linestyle=":")
    arrow(plot, (table + 0.36, 0), (table + 0.36, z), theme.ink, "<|-|>", 0.9)
    plot.text(table + 0.39, z / 2, "$L_2\\sin\\alpha$\n$= z_0 + z$", color=theme.ink, fontsize=10.5, va="center")
    arrow(plot, (pin, -0.30), (table, -0.30), theme.ink, "<|-|>", 0.9)
    for x, top, end in ((pin, -0.02, -0.33), (table, z - 0.04, 0.13), (table, 0.04, -0.33)):  # not through the words
        plot.plot([x, x], [top, end], color=theme.faint, linewidth=0.5)
    plot.text(
        (pin + table) / 2, -0.33, "$\\delta = L_2\\cos\\alpha$", color=theme.ink, fontsize=10.5, ha="center", va="top"
    )
    plot.set(xlim=(0.58, 2.62), ylim=(-0.48, 0.56))
    plot.set_title("chain 1 from the side", color=theme.ink, fontsize=11.5, y=0.985)


def draw() -> None:
    stage = Stage.load("reconstructed")
    for theme in THEMES:
        made = figure(11.6, 5.0)
        from_above(bare(made, (0.0, 0.0, 0.48, 0.95), equal=True), stage, theme)
        from_the_side(bare(made, (0.49, 0.18, 0.51, 0.62), equal=True), stage, theme)
        save(made, "mechanism", theme)


if __name__ == "__main__":
    draw()
