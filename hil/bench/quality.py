"""How well the stage follows: the default scenario on the three shipped plants, over the bus."""

import dataclasses
from typing import Any

from hil.bench.rigs.figure import Direction, Figure
from hil.lanes import in_process as lanes
from hil.lanes.lane import Lane
from hil.runs.metrics import Metrics
from hil.runs.scenario import load_scenario

RMS_NM, HOLD_NM, MILD = 5.0, 2.0, 3.0
"""Bounds on the nominal plant, each axis, and how much more the mild plant may have."""
BUS_LOAD = 0.85

_UNITS = {"rms_error_nm": "nm", "max_error_nm": "nm", "hold_noise_nm": "nm", "bus_load": "of 1"}
_WORDS = {
    "rms_error_nm": "true position against reference while scanning, worst axis",
    "max_error_nm": "largest while scanning, worst axis",
    "hold_noise_nm": "true position in holds, standard deviation, worst axis",
    "saturated_ticks": "ticks in which a comb force met a bound",
    "bus_load": "share of time in which the wire is busy",
    "missed_ticks": "ticks skipped, without a sense frame or late on the wire",
    "faults": "fault decisions",
}
_AT_MOST = {
    "nominal": {"rms_error_nm": RMS_NM, "hold_noise_nm": HOLD_NM, "saturated_ticks": 0.0, "bus_load": BUS_LOAD,
                "missed_ticks": 0.0, "faults": 0.0},
    "mild": {"rms_error_nm": MILD * RMS_NM, "hold_noise_nm": MILD * HOLD_NM, "missed_ticks": 0.0, "faults": 0.0},
    "harsh": {"faults": 0.0},
}  # fmt: skip


def nominal() -> list[Figure]:
    """The plant as the stage file describes it, with default noise."""
    return _figures("nominal")


def mild() -> list[Figure]:
    """Every effect on, in sizes that are usual."""
    return _figures("mild")


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
        figures.append(Figure(name, value, _UNITS.get(what, "count"), target, direction, None, detail))
    return figures
