"""Sampled devices that are stopped on their way, led down or at once: which of them meet their mechanical stops.

python tests/studies/alarms/stopped.py [LAW ...] [--devices 500] [--motions raster,moves]

A line of docs/tables/stops.jsonl for each law and motion; what has as many devices already is left alone.
"""

import dataclasses
import time
from typing import Any, NamedTuple

import numpy as np
from sampled import BEFORE_TICKS, designed, options, read, write
from sampled import KEPT as ALARMS

from hil.lanes.fast import runner_of
from hil.lanes.in_process import instants_us
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.loop.cycle import new_memory
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.trips import Trip
from pkxyz_ctrl.trajectory import Trajectory

KEPT = ALARMS.with_name("stops.jsonl")
INSTANTS, AFTER_S = 8, 0.02
"""Of a device, drawn by its seed; each stop is looked at for so long, and for twice the way down."""


class Stop(NamedTuple):
    """Of a device, at one instant."""

    hits: int
    """led down by an operator's stop"""
    lowest_m: float
    """... its lowest stroke"""
    hits_at_once: int
    """with 0 V at once"""
    is_beyond: bool
    """its combs were at their limits before, so it was not where it was to be"""


def way_us(trajectory: Trajectory) -> tuple[int, int]:
    """From the first scan or jump to the last one's end; of moves, from the one that leaves mid-workspace."""
    segments = [s for s in trajectory.segments if s.scan_us or s.jumps_us]
    segments = segments or [s for s in trajectory.segments if s.kind == "move"][1:]
    return segments[0].t_start_us, segments[-1].t_end_us


def stops(motion: str, law: str, seed: int, instants: int = INSTANTS, bus: str | None = None) -> list[Stop]:
    """Those of the device of a seed; fewer where it faults before."""
    study, base = designed(motion, law, bus)
    setup = dataclasses.replace(base, plant=study.sampled(seed).plant, seed=seed)
    vars(setup)["law"] = base.law
    period_us = base.bus.period_us
    begin, end = (t_us // period_us for t_us in way_us(base.trajectory))
    at = np.sort(np.random.default_rng(seed).integers(begin, end, instants))
    rows = np.zeros(max(20, end), ROW)
    reference = reference_rows(base.trajectory.sample(0, end + 400, period_us))
    plant, memory = setup.new_plant(), new_memory(Mode.IDLE)
    run_block = runner_of(base.law)
    after = max(round(AFTER_S * 1e6) // period_us, 2 * int(base.law["landing_ticks"][0]))
    done, found, saturated = 0, [], np.zeros(0)
    for target in at:
        while (ahead := int(target) - int(memory["reference_tick"][0])) > 0:
            count = ahead if memory["mode"][0] == Mode.TRACKING else 20
            sample_us = instants_us(setup, done, count)
            run_block(base.law, memory, reference, plant.params, plant.state, sample_us, rows, count)
            done += count
            saturated = np.concatenate([saturated, rows["saturated"][:count]])[-BEFORE_TICKS:]
            if memory["mode"][0] == Mode.FAULT:
                return found
        sample_us, hits, lowest_m = instants_us(setup, done, after), [], 0.0
        for trip in (Trip.GATE_BLOCKED, Trip.OPERATOR):
            state, left = plant.state.copy(), memory.copy()
            left["input"]["trips"] = int(trip)
            run_block(base.law, left, reference, plant.params, state, sample_us, rows, after)
            assert left["mode"][0] == Mode.FAULT
            hits.append(int(state["event_count"][0]) - int(plant.state["event_count"][0]))
            lowest_m = float(rows["stroke_m"][:after].min())
        found.append(Stop(hits[1], lowest_m, hits[0], bool(saturated.mean() > 0.5)))
    return found


def study_of(motion: str, law: str, devices: int) -> dict[str, Any]:
    """What is kept of a law and motion: devices (by seed) that hit, also from beyond their reach, and those that had
    faulted before an instant.
    """
    found = {seed: stops(motion, law, seed) for seed in range(1, devices + 1)}
    each = [stop for of_device in found.values() for stop in of_device]
    return {
        "motion": motion,
        "law": law,
        "devices": devices,
        "stops": len(each),
        "hits": [seed for seed, of_device in found.items() if any(s.hits and not s.is_beyond for s in of_device)],
        "beyond": [seed for seed, of_device in found.items() if any(s.hits and s.is_beyond for s in of_device)],
        "before": [seed for seed, of_device in found.items() if len(of_device) < INSTANTS],
        "lowest_um": round(1e6 * min(stop.lowest_m for stop in each), 3),
        "hits_at_once": sum(stop.hits_at_once > 0 for stop in each),
    }


def main() -> None:
    """Go through what is missing in the file of results."""
    asked = options(["youla"], KEPT)
    known = read(asked.results)
    for motion in asked.motions.split(","):
        for law in asked.laws:
            if known.get((motion, law), {"devices": 0})["devices"] >= asked.devices:
                continue
            begin_s = time.process_time()
            try:
                known[motion, law] = study_of(motion, law, asked.devices)
            except ConfigError as error:
                print(f"{law} in {motion}: {error}", flush=True)
                continue
            write(asked.results, known)
            print(known[motion, law], f"{time.process_time() - begin_s:.0f} s", flush=True)


if __name__ == "__main__":
    main()
