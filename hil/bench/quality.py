"""How well the stage follows: the default scenario on three shipped plants, over the bus, and a circle on two."""

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.bench.rigs.figure import Direction, Figure
from hil.lanes import in_process as lanes
from hil.lanes.lane import Lane
from hil.runs.metrics import Metrics
from hil.runs.scenario import load_scenario

RASTER_NM = {"nominal": 1.1, "mild": 3.2}
"""Bounds on the raster's error about the set-point, each axis. What harsh has is its sense chain's."""
DEVIATION_NM = {"mild": 1.3, "harsh": 4.5}
"""The same about its own mean."""
CIRCLE_NM = {"nominal": 1.5, "mild": 8.0}
"""Bounds on the error in a circle of 4 um at 100 Hz, x and y, of a stage that nobody has identified."""
CIRCLES = range(1, 11)
"""Seeds: what the law learns first is noise."""
HOLD_NM, BUS_LOAD = 2.0, 0.85

_UNITS = {"bus_load": "of 1"}
_WORDS = {
    "rms_error_nm": "true position against reference while scanning, worst axis",
    "error_deviation_nm": "the same about its own mean, which an offset in sensing shifts, worst axis",
    "max_error_nm": "largest while scanning, worst axis",
    "hold_noise_nm": "true position in holds, standard deviation, worst axis",
    "saturated_ticks": "ticks in which a comb force met a bound",
    "bus_load": "share of time in which the wire is busy",
    "missed_ticks": "ticks skipped, without a sense frame or late on the wire",
    "faults": "fault decisions",
}
_AT_MOST = {
    "nominal": {"rms_error_nm": RASTER_NM["nominal"], "hold_noise_nm": HOLD_NM, "saturated_ticks": 0.0,
                "bus_load": BUS_LOAD, "missed_ticks": 0.0, "faults": 0.0},
    "mild": {"rms_error_nm": RASTER_NM["mild"], "error_deviation_nm": DEVIATION_NM["mild"], "hold_noise_nm": HOLD_NM,
             "saturated_ticks": 0.0, "missed_ticks": 0.0, "faults": 0.0},
    "harsh": {"error_deviation_nm": DEVIATION_NM["harsh"], "missed_ticks": 0.0, "faults": 0.0},
}  # fmt: skip


def nominal() -> list[Figure]:
    """The plant as the stage file describes it, with default noise."""
    return [*_figures("nominal"), _circle("nominal")]


def mild() -> list[Figure]:
    """Every effect on, in sizes that are usual."""
    return [*_figures("mild"), _circle("mild")]


def harsh() -> list[Figure]:
    """Every effect on, in sizes that a device may have and still be sold."""
    return _figures("harsh")


def _figures(plant: str) -> list[Figure]:
    setup = load_scenario("raster", plant=plant).setup()
    metrics = Metrics(setup.trajectory, setup.bus.period_us)
    result = lanes.run(setup, Lane.LOCKSTEP, on_block=metrics.update)
    found: dict[str, Any] = dataclasses.asdict(metrics.figures()) | {
        "bus_load": result.bus_load, "missed_ticks": result.missed_ticks, "faults": len(result.faults),
    }  # fmt: skip
    figures = []
    for what, words in _WORDS.items():
        measured = found[what]
        value = float(max(measured.values()) if isinstance(measured, dict) else measured)
        target = _AT_MOST[plant].get(what)
        direction: Direction | None = "at most" if target is not None else None
        by_axis = ", ".join(f"{axis} {v:.2f}" for axis, v in measured.items()) if isinstance(measured, dict) else ""
        name = f"{plant}.{what.removesuffix('_nm')}"
        detail = f"{words} ({by_axis})" if by_axis else words
        unit = "nm" if what.endswith("_nm") else _UNITS.get(what, "count")
        figures.append(Figure(name, value, unit, target, direction, None, detail))
    return figures


def circles_nm(plant: str) -> NDArray[np.float64]:
    """RMS error (n, 2) in x and y about the set-point, for each seed of ``CIRCLES``; over the compiled loop, whose bits
    are those of the bus."""
    found = []
    for seed in CIRCLES:
        loaded = load_scenario("circle", plant=plant, seed=seed)
        metrics = Metrics(loaded.trajectory, loaded.bus.period_us)
        lanes.run(loaded.setup(), Lane.FAST, on_block=metrics.update)
        error = metrics.figures().rms_error_nm
        assert error is not None, "a circle was scanned"
        found.append([error["x"], error["y"]])
    return np.array(found)


def _circle(plant: str) -> Figure:
    error_nm = circles_nm(plant)
    x, y = np.median(error_nm, axis=0)
    detail = (
        f"circle of 4 um at 100 Hz, rms about the set-point, median of {len(error_nm)} seeds, worst axis "
        f"(x {x:.2f}, y {y:.2f}; largest {error_nm.max():.2f})"
    )
    return Figure(f"{plant}.circle", float(max(x, y)), "nm", CIRCLE_NM[plant], "at most", None, detail)
