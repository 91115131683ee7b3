"""Writes docs/figures/trajectories.png: every kind of segment, as the shipped scenarios use it."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from hil.pictures.style import BLUE, REFERENCE, TINY_PT, VERMILION, dress, save, sheet
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.trajectory import Sine, Trajectory

STEP_US = 20
PATHS = [  # title, scenario, segment
    ("raster", "raster", 3),
    ("circle", "circle", 3),
    ("spiral, constant linear velocity", "spiral", 3),
    ("spiral, constant angular velocity", "spiral", 5),
    ("lissajous", "lissajous", 3),
    ("rosette", "lissajous", 4),
    ("waypoints", "path", 3),
    ("csv", "path", 4),
]
COURSES = [  # title, scenario, segment, axis
    ("move", "raster", 1, 2),
    ("sine", "", 0, 0),
    ("sweep: the first 0.5 s", "sweep", 3, 0),
    ("steps, which jump", "steps", 3, 0),
    ("staircase", "steps", 5, 2),
]


def rows_of(trajectory: Trajectory, segment: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Times in s since the segment's start, rows (n, 9) relative to where it ends, and which of them are its scan."""
    timed = trajectory.segments[segment]
    first, last = timed.t_start_us // STEP_US, timed.t_end_us // STEP_US
    rows = trajectory.sample(first, last - first + 1, STEP_US)
    rows[:, 0:3] -= rows[0, 0:3]
    t_us = np.arange(first, last + 1) * STEP_US
    begin, end = timed.scan_us or (timed.t_start_us, timed.t_end_us)
    return (t_us - timed.t_start_us) * 1e-6, rows, (begin <= t_us) & (t_us <= end)


def draw_path(axes: Axes, title: str, trajectory: Trajectory, segment: int) -> None:
    """x and y, the scan in blue; the dots of spirals are 4 ms apart, the inset of waypoints is their first corner."""
    _, rows, scans = rows_of(trajectory, segment)
    x, y = rows[:, 0] * 1e6, rows[:, 1] * 1e6
    if title == "raster":  # one layer
        first_layer = rows[:, 2] <= rows[scans][0, 2] + 1e-9
        x, y, scans = x[first_layer], y[first_layer], scans[first_layer]
    axes.plot(x, y, color=REFERENCE, lw=0.8, zorder=1)
    axes.plot(np.where(scans, x, np.nan), y, color=BLUE, lw=0.7)
    dress(axes, "x (µm)", "y (µm)", title, grid="")
    axes.set_aspect("equal", "datalim")
    if title.startswith("spiral"):
        axes.plot(x[scans][:: 4000 // STEP_US], y[scans][:: 4000 // STEP_US], ".", color=VERMILION, ms=2.5)
    if title == "waypoints":
        inset = axes.inset_axes((0.02, 0.62, 0.3, 0.36), xlim=(-0.2, 0.2), ylim=(1.63, 2.03), xticks=[], yticks=[])
        inset.plot(x, y, color=BLUE, lw=1.0)
        inset.plot(0.0, 2.0, "+", color=VERMILION)
        inset.set_xlabel("400 nm", fontsize=TINY_PT)


def draw_course(axes: Axes, title: str, trajectory: Trajectory, segment: int, axis: int) -> None:
    """One axis over time, lead-in and lead-out in grey."""
    t_s, rows, scans = rows_of(trajectory, segment)
    shown = t_s <= 0.5
    t_ms, position = t_s[shown] * 1e3, rows[shown, axis] * 1e6
    axes.plot(t_ms, position, color=REFERENCE, lw=0.8)
    axes.plot(t_ms, np.where(scans[shown], position, np.nan), color=VERMILION, lw=0.7)
    dress(axes, "time (ms)", f"{'xyz'[axis]} (µm)", title, grid="")


def main() -> None:
    """Draw the sheet."""
    figure = sheet(15, 9, dpi=110)
    upper, lower = figure.subfigures(2, 1, height_ratios=[2, 0.75])
    paths, courses = upper.subplots(2, 4).ravel(), lower.subplots(1, 5)
    shipped = {name: load_scenario(name).trajectory for _, name, *_ in (*PATHS, *COURSES) if name}
    shipped[""] = Trajectory([Sine(kind="sine", axis="x", amplitude_m=1e-6, frequency_hz=100.0, cycles=6.0)])
    for axes, (title, scenario, segment) in zip(paths, PATHS, strict=True):
        draw_path(axes, title, shipped[scenario], segment)
    for axes, (title, scenario, segment, axis) in zip(courses, COURSES, strict=True):
        draw_course(axes, title, shipped[scenario], segment, axis)
    save(figure, Path(__file__).with_suffix(".png"))


if __name__ == "__main__":
    main()
