"""Two periods of ``fd_5k``: when the combs are driven and sampled, when frames pass, when the controller computes."""

from itertools import pairwise
from typing import Any

from canvas import THEMES, Theme, bare, figure, save
from matplotlib.patches import FancyArrowPatch, Rectangle

from hil.bus.frame_time import INTERFRAME_BITS, frame_range_us
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import load

ROWS = {"bus": 2.0, "controller": 1.0, "combs": 0.0}


def instants(bus: BusConfig) -> dict[str, float]:
    """Instants of a tick in us from the start of SYNC, all frames at their longest."""
    can = bus.can
    assert can is not None
    rates = can.nominal_bitrate_bit_per_s, can.data_bitrate_bit_per_s
    sync, sense, drive = (
        frame_range_us(can_id, length, *rates, is_fd=True)[1] for can_id, length in ((0x080, 1), (0x28A, 8), (0x30A, 8))
    )
    gap = INTERFRAME_BITS * 1e6 / can.nominal_bitrate_bit_per_s
    sampled = sync - gap
    sense_from = max(sync, sampled + can.turnaround_us)
    sense_to = sense_from + sense - gap
    drive_from = sense_to + can.compute_us
    return {
        "sampled": sampled, "sense_from": sense_from, "sense_to": sense_to, "drive_from": drive_from,
        "drive_to": drive_from + drive - gap,
    }  # fmt: skip


def draw_one(plot: Any, theme: Theme, bus: BusConfig) -> None:
    t, period = instants(bus), float(bus.period_us)
    first, second, third = theme.chains
    bar = {"height": 0.5, "linewidth": 0, "zorder": 3}
    for name, y in ROWS.items():
        plot.text(-8, y + 0.25, name, color=theme.ink, fontsize=11, ha="right", va="center")
        plot.plot([0, 2.32 * period], [y, y], color=theme.faint, linewidth=0.7, zorder=1)
    for k in range(3):
        at = k * period
        plot.plot([at, at], [-0.12, 2.9], color=theme.faint, linewidth=0.7, linestyle=":", zorder=1)
        plot.text(at, 3.0, f"tick {'k' if k == 0 else f'k+{k}'}", color=theme.ink, fontsize=10.5, ha="center")
        plot.add_patch(Rectangle((at, 2.0), t["sampled"], facecolor=first, **bar))
        plot.text(at + t["sampled"] / 2, 2.56, "SYNC", color=first, fontsize=10, ha="center")
        plot.plot([at + t["sampled"]] * 2, [0.0, 2.0], color=first, linewidth=0.9, linestyle=(0, (3, 2)), zorder=2)
        plot.plot(at + t["sampled"], 0.0, "o", color=first, markersize=7, zorder=5)
        if k == 2:
            continue
        plot.add_patch(Rectangle((at + t["sense_from"], 2.0), t["sense_to"] - t["sense_from"], facecolor=third, **bar))
        plot.text(at + (t["sense_from"] + t["sense_to"]) / 2, 2.56, "sense PDO", color=third, fontsize=10, ha="center")
        plot.add_patch(
            Rectangle((at + t["sense_to"], 1.0), t["drive_from"] - t["sense_to"], facecolor=theme.accent, **bar)
        )
        plot.text(
            at + t["drive_from"] + 4,
            1.25,
            "decode, estimate,\ncompute, gate",
            color=theme.accent,
            fontsize=9.5,
            va="center",
        )
        plot.add_patch(Rectangle((at + t["drive_from"], 2.0), t["drive_to"] - t["drive_from"], facecolor=second, **bar))
        plot.text(at + (t["drive_from"] + t["drive_to"]) / 2, 2.56, "drive PDO", color=second, fontsize=10, ha="center")
    heights = (0.22, 0.55, 0.38)
    edges = [0.0, t["sampled"], period + t["sampled"], 2 * period + t["sampled"], 2.32 * period]
    levels = (0.30, *heights)
    for (start, end), level in zip(pairwise(edges), levels, strict=True):
        plot.plot([start, end], [level, level], color=theme.ink, linewidth=1.6, zorder=4)
    for at, low, high in zip(edges[1:-1], levels[:-1], levels[1:], strict=True):
        plot.plot([at, at], [low, high], color=theme.ink, linewidth=1.6, zorder=4)
    plot.text(t["sampled"] + 10, 0.36, "voltages held", color=theme.ink, fontsize=9.5)
    ends = {"arrowstyle": "<|-|>", "mutation_scale": 10, "shrinkA": 0, "shrinkB": 0}
    span = (t["sampled"], -0.3), (period + t["sampled"], -0.3)
    plot.add_patch(FancyArrowPatch(*span, color=theme.ink, linewidth=1.0, **ends))
    words = f"from sample to action: {bus.period_us} µs, exactly one period"
    plot.text(t["sampled"] + period / 2, -0.42, words, color=theme.ink, fontsize=10, ha="center", va="top")
    plot.text(t["sampled"] - 4, -0.2, "sampled", color=first, fontsize=9.5, ha="right", va="center")
    plot.text(period + t["sampled"] + 6, -0.3, "the answer acts", color=first, fontsize=9.5, va="center")
    plot.set(xlim=(-62, 2.36 * period), ylim=(-0.85, 3.3))


def draw() -> None:
    bus = load("buses", "fd_5k", BusConfig)
    for theme in THEMES:
        made = figure(11.0, 3.7)
        draw_one(bare(made, (0.0, 0.0, 1.0, 1.0), equal=False), theme, bus)
        save(made, "timing", theme)


if __name__ == "__main__":
    draw()
