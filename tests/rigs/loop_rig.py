"""The loop on the bench: designed laws by name of their files, a cycle to be fed by hand, and whole runs of a lane."""

import dataclasses
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.lanes import in_process as lanes
from hil.lanes.lane import Lane
from hil.lanes.setup import Setup
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import load, plain
from pkxyz_ctrl.core import tick
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Event, Mode
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]
Rows = NDArray[np.void]

MIDDLE = np.array([12.5e-6, 12.5e-6, 12.5e-6])


@cache
def stage(name: str = "reconstructed") -> Stage:
    return Stage.load(name)


@cache
def bus(name: str = "fd_5k", delay_periods: int = 1) -> BusConfig:
    return load("buses", name, BusConfig).model_copy(update={"delay_periods": delay_periods})


@cache
def controller() -> ControllerConfig:
    return load("controllers", "lqg", ControllerConfig)


def controller_with(**sections: dict[str, Any]) -> ControllerConfig:
    """The shipped controller with some sections' keys, or top-level keys, replaced."""
    data = plain(controller())
    for section, changes in sections.items():
        data[section] = data[section] | changes if isinstance(changes, dict) else changes
    data["operating_strokes_m"] = tuple(data["operating_strokes_m"])
    return ControllerConfig.model_validate(data)


def monitor_limits() -> NDArray[np.void]:
    """(1,) of ``monitors.LIMITS`` as the shipped controller's law has them; a copy, to be changed."""
    return law()["limits"].copy()


@cache
def law(bus_name: str = "fd_5k", stage_name: str = "reconstructed", autostart: bool = True) -> NDArray[np.void]:
    """(1,) of ``cycle.LAW`` for the shipped files; read-only."""
    return design_law(stage(stage_name), controller(), bus(bus_name), autostart=autostart)


def tick_law(bus_name: str = "fd_5k") -> np.void:
    """Record of ``tick.LAW``, a copy that may be written to."""
    record: np.void = law(bus_name)["tick"].copy()[0]
    return record


def new_tick_memory() -> np.void:
    """Record of ``tick.MEMORY``, all zero."""
    record: np.void = np.zeros(1, tick.MEMORY)[0]
    return record


def counts_at(strokes_m: Any, bus_name: str = "fd_5k") -> NDArray[np.int32]:
    """Sense counts (3,) that a noiseless converter would give at strokes (3,)."""
    analog = bus(bus_name).analog
    farads = stage().sense_capacitance(strokes_m)
    return np.round((farads - analog.sense_offset_f) / analog.sense_farad_per_count).astype(np.int32)


class Cycle:
    """A cycle in IDLE that is fed by hand, without bus and without plant."""

    def __init__(self, law_array: NDArray[np.void], reference: Array | None = None, mode: Mode = Mode.IDLE) -> None:
        self.law = law_array
        self.memory = cycling.new_memory(mode)
        """``reference`` (n, 9)"""
        self.reference = reference_rows(np.zeros((16, 9)) if reference is None else reference)

    def tick(
        self,
        counts: Any = (0, 0, 0),
        *,
        status: int = 0,
        event: Event = Event.NONE,
        trips: int = 0,
        base: int = 0,
        node_events: int = 0,
        overrun: int = 0,
    ) -> np.void:
        """One period; returns a copy of its row."""
        seen = self.memory["input"]
        seen["sense_count"], seen["sense_status"], seen["event"] = counts, status, int(event)
        seen["trips"], seen["node_events"], seen["overrun"] = trips, node_events, overrun
        self.reference["tick"] = base + np.arange(len(self.reference))
        cycling.cycle(self.law, self.memory, self.reference)
        row: np.void = self.memory["row"].copy()[0]
        return row

    @property
    def mode(self) -> Mode:
        return Mode(int(self.memory["mode"][0]))


@cache
def setup(plant: str = "nominal", bus_name: str = "fd_5k", seed: int = 1) -> Setup:
    """The default scenario under lqg, on another plant, bus or seed; ``duration_s`` may be replaced."""
    return load_scenario("raster", controller="lqg", plant=plant, bus=bus_name, seed=seed).setup()


def shortened(original: Setup, ticks: int) -> Setup:
    """The first ticks of a run."""
    return dataclasses.replace(original, duration_s=ticks * original.bus.period_s)


def rows_of(run_setup: Setup, lane: str) -> tuple[Rows, lanes.LaneResult]:
    """All rows of a run, and what the lane says about it."""
    blocks: list[Rows] = []
    result = lanes.run(run_setup, Lane(lane), on_block=lambda block: blocks.append(block.copy()))
    return np.concatenate(blocks), result


def first_difference(a: Rows, b: Rows) -> str | None:
    """The first tick and field in which two recordings differ in a bit; None if in none. Padding does not count."""
    if len(a) != len(b):
        return f"{len(a)} rows against {len(b)}"
    found = []
    for name in ROW.names or ():
        left, right = (np.ascontiguousarray(x[name]).reshape(len(x), -1).view(np.uint8) for x in (a, b))
        differs = np.flatnonzero((left.reshape(len(a), -1) != right.reshape(len(b), -1)).any(axis=1))
        if len(differs):
            found.append((int(differs[0]), name))
    if not found:
        return None
    at, name = min(found)
    return f"tick {at}: {name} = {a[name][at]} against {b[name][at]}"
