"""The loop as blocks: what the controller computes in a tick, what the bus carries, and where the delays are."""

from itertools import pairwise
from typing import Any

from canvas import THEMES, Theme, bare, figure, save
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from pkxyz_ctrl import Stage
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import load

TOP, MIDDLE, BOTTOM = 3.75, 2.3, 0.45
WIDTH, HEIGHT = 1.72, 0.92


def block(plot: Any, theme: Theme, x: float, y: float, words: str, colour: str, width: float = WIDTH) -> None:
    plot.add_patch(
        FancyBboxPatch((x - width / 2, y - HEIGHT / 2), width, HEIGHT, boxstyle="round,pad=0,rounding_size=0.08",
                       facecolor=theme.wash, edgecolor=colour, linewidth=1.4)
    )  # fmt: skip
    plot.text(x, y, words, color=theme.ink, fontsize=10, ha="center", va="center", linespacing=1.25)


def wire(
    plot: Any, theme: Theme, points: list[tuple[float, float]], words: str = "", at: tuple[float, float] = (0, 0)
) -> None:
    for start, end in pairwise(points[:-1]):
        plot.plot(*zip(start, end, strict=True), color=theme.ink, linewidth=1.1, solid_capstyle="round")
    plot.add_patch(FancyArrowPatch(points[-2], points[-1], arrowstyle="-|>", mutation_scale=10, color=theme.ink,
                                   linewidth=1.1, shrinkA=0, shrinkB=0))  # fmt: skip
    if words:
        plot.text(*at, words, color=theme.ink, fontsize=9.5, ha="center", va="center")


def draw_one(plot: Any, theme: Theme, stage: Stage, bus: BusConfig) -> None:
    law, bus_colour, device = theme.chains
    half = WIDTH / 2
    block(plot, theme, 1.3, TOP, "reference\n$r,\\ \\dot r,\\ \\ddot r$", theme.faint)
    block(plot, theme, 3.95, TOP, "law\nfeed-forward\n+ feedback", law)
    block(plot, theme, 6.6, TOP, "allocation\n$F \\geq 0$, limits", law)
    block(plot, theme, 9.25, TOP, "voltages\n$V=\\sqrt{F/G}$\nrounded", law)
    wire(plot, theme, [(1.3 + half, TOP), (3.95 - half, TOP)])
    wire(plot, theme, [(3.95 + half, TOP), (6.6 - half, TOP)], "force $w$", (5.27, TOP + 0.2))
    wire(plot, theme, [(6.6 + half, TOP), (9.25 - half, TOP)], "$F_1, F_2, F_3$", (7.92, TOP + 0.2))
    block(plot, theme, 3.95, MIDDLE, "Kalman filter\n$\\hat x,\\ \\hat v,\\ \\hat d$", law)
    block(plot, theme, 1.3, MIDDLE, "counts to\nposition", law)
    wire(plot, theme, [(1.3 + half, MIDDLE), (3.95 - half, MIDDLE)], "$y$", (2.62, MIDDLE + 0.17))
    wire(plot, theme, [(3.95, MIDDLE + HEIGHT / 2), (3.95, TOP - HEIGHT / 2)])
    plot.text(
        4.05, (TOP + MIDDLE) / 2, "predicted to where\nthe force will act", color=theme.faint, fontsize=9, va="center"
    )
    wire(
        plot,
        theme,
        [(8.75, TOP - HEIGHT / 2), (8.75, MIDDLE), (3.95 + half, MIDDLE)],
        "the counts that were sent",
        (6.8, MIDDLE + 0.17),
    )
    block(plot, theme, 9.25, BOTTOM, f"amplifier\npole {stage.config.amplifier.bandwidth_hz / 1e3:g} kHz", device)
    block(plot, theme, 6.6, BOTTOM, "combs\n$F = G\\,V^2$", device)
    block(plot, theme, 3.95, BOTTOM, "stage\n$m\\ddot x + C\\dot x + \\nabla V = J^T F$", device, 2.35)
    block(plot, theme, 1.3, BOTTOM, "sense combs\n+ noise, 2 nm rms", device)
    wire(plot, theme, [(9.75, TOP - HEIGHT / 2), (9.75, BOTTOM + HEIGHT / 2)])
    wire(plot, theme, [(9.25 - half, BOTTOM), (6.6 + half, BOTTOM)], "$V$", (7.92, BOTTOM + 0.17))
    wire(plot, theme, [(6.6 - half, BOTTOM), (3.95 + 1.175, BOTTOM)], "$F$", (5.43, BOTTOM + 0.17))
    wire(plot, theme, [(3.95 - 1.175, BOTTOM), (1.3 + half, BOTTOM)], "$x$", (2.47, BOTTOM + 0.17))
    wire(plot, theme, [(1.3, BOTTOM + HEIGHT / 2), (1.3, MIDDLE - HEIGHT / 2)])
    level = 1.22
    for x, words, side in ((1.3, "sense PDO", 1), (9.75, "drive PDO", -1)):
        plot.plot([x - 0.22, x + 0.22], [level, level], color=bus_colour, linewidth=5, solid_capstyle="butt", zorder=3)
        plot.text(x + 0.34 * side, level, words, color=bus_colour, fontsize=9.5, ha="left" if side > 0 else "right",
                  va="center", bbox={"facecolor": theme.wash, "edgecolor": "none", "pad": 1.5})  # fmt: skip
    plot.plot([0.2, 10.5], [level, level], color=bus_colour, linewidth=0.8, linestyle=(0, (4, 4)), zorder=0)
    words = f"CAN bus: {bus.delay_periods} period, {bus.period_us} µs, from a sample to the force that answers it"
    plot.text(5.53, level + 0.17, words, color=bus_colour, fontsize=9.5, ha="center")
    plot.text(10.62, TOP, "controller", color=law, fontsize=10, rotation=-90, ha="center", va="center")
    plot.text(10.62, BOTTOM, "device", color=device, fontsize=10, rotation=-90, ha="center", va="center")
    plot.set(xlim=(0.2, 10.8), ylim=(-0.08, 4.28))


def draw() -> None:
    stage, bus = Stage.load("reconstructed"), load("buses", "fd_5k", BusConfig)
    for theme in THEMES:
        made = figure(11.0, 4.5)
        draw_one(bare(made, (0.0, 0.0, 1.0, 1.0), equal=False), theme, stage, bus)
        save(made, "loop", theme)


if __name__ == "__main__":
    draw()
