"""Draws saturating_move.png: the far jump of the benchmark, up and down, by mpc and by the clipped regulator of lqg."""

from pathlib import Path
from typing import Any

import numpy as np

from hil.bench.control import BAND_M, LOW_M, WAY_M
from hil.bench.rigs.motions import run, settled_s
from hil.pictures.style import BLUE, FAINT, bound, dress, legend, save, sheet
from pkxyz_ctrl.trajectory import Steps

COLOURS = {"lqg": FAINT, "mpc": BLUE}
BEFORE, AFTER = 14, 30


def jumps(controller: str) -> list[tuple[Any, float]]:
    """Rows about the jump up and the one down, and how long each takes to settle in ms."""
    motion = run([Steps(kind="steps", by_m=(0.0, 0.0, WAY_M), count=1, dwell_s=0.04)], controller, height_m=LOW_M)
    t_us, found = motion.period_us, []
    for at_us in motion.segments[0].jumps_us:
        settle_s = settled_s(motion.during((at_us, at_us + 36_000)), 2, BAND_M, t_us * 1e-6)
        found.append((motion.during((at_us - BEFORE * t_us, at_us + AFTER * t_us)), settle_s * 1e3))
    return found


def draw(path: Path) -> None:
    """Height, its distance from the target, and the voltages; the loop's ticks are the marks."""
    figure = sheet(11, 8.5)
    axes = figure.subplots(3, 2, sharex=True)
    for controller, colour in COLOURS.items():
        for column, (rows, settle_ms) in enumerate(jumps(controller)):
            t_ms = (np.arange(len(rows)) - BEFORE) * 0.2
            height, distance, voltage = axes[:, column]
            off_m = np.abs(rows["position_m"][:, 2] - rows["reference_m"][-1, 2])
            label = f"{controller}, within 10 nm after {settle_ms:.1f} ms"
            height.plot(t_ms, rows["position_m"][:, 2] * 1e6, ".-", color=colour, label=label)
            distance.semilogy(t_ms, np.maximum(off_m * 1e9, 0.3), ".-", color=colour)
            voltage.step(t_ms, rows["voltage_v"][:, 0], where="post", color=colour)
            if controller == "mpc":
                solved = rows["solver_iterations"] > 0
                voltage.plot(
                    t_ms[solved], rows["voltage_v"][solved, 0], "o", color=colour, ms=4, label="a problem solved"
                )
    for column, title in enumerate(("up", "down")):
        height, distance, voltage = axes[:, column]
        labels = ("height (µm)", "distance from the target (nm)", "voltage of a comb (V)") if column == 0 else ("",) * 3
        dress(height, "", labels[0], f"a jump of {WAY_M * 1e6:.0f} µm {title}")
        dress(distance, "", labels[1])
        dress(voltage, "time after the jump of the reference (ms)", labels[2])
        bound(distance, BAND_M * 1e9)
        legend(height)
        legend(voltage)
    save(figure, path)


if __name__ == "__main__":
    draw(Path(__file__).with_suffix(".png"))
