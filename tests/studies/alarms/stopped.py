"""Sampled devices that are stopped in the middle of a scan: how often they meet their stops.

python tests/studies/alarms/stopped.py circle youla 500 [unix_1k]
"""

import dataclasses
import sys
from functools import cache

import numpy as np

from hil.lanes.fast import runner_of
from hil.lanes.in_process import instants_us
from hil.lanes.setup import Setup
from hil.runs.scenario import load_scenario
from hil.studies.montecarlo import Study
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.loop.cycle import new_memory
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.trips import Trip

SPREAD_S, AFTER_S = 0.015, 0.02
"""The instants lie so close together, a period and a half of the circle; each stop is looked at for so long."""


@cache
def study(scenario: str, law: str, bus: str) -> Study:
    return Study(load_scenario(scenario, controller=law, bus=bus), load("tolerances", "wide", Tolerances))


@cache
def designed(scenario: str, law: str, bus: str) -> Setup:
    return study(scenario, law, bus).scenario.setup()


def stopped(
    scenario: str, law: str, seed: int, trip: Trip, instants: int = 4, bus: str = "fd_5k"
) -> list[tuple[int, float]]:
    """Of each stop its hits and the lowest stroke in m; none where the device faults before."""
    base = designed(scenario, law, bus)
    period_us = base.bus.period_us
    setup = dataclasses.replace(base, plant=study(scenario, law, bus).sampled(seed).plant, seed=seed)
    segment = next(s for s in base.trajectory.segments if s.scan_us or s.jumps_us)
    begin = (segment.t_start_us + 40_000) // period_us
    at = np.linspace(begin, begin + round(SPREAD_S * 1e6) // period_us, instants).astype(int)
    rows = np.zeros(4096, ROW)
    reference = reference_rows(base.trajectory.sample(0, int(at[-1]) + 400, period_us))
    plant, memory = setup.new_plant(), new_memory(Mode.IDLE)
    run_block = runner_of(base.law)
    done, found = 0, []
    for target in at:
        while (ahead := int(target) - int(memory["reference_tick"][0])) > 0:
            count = ahead if memory["mode"][0] == Mode.TRACKING else 20
            sample_us = instants_us(setup, done, count)
            run_block(base.law, memory, reference, plant.params, plant.state, sample_us, rows, count)
            done += count
            if memory["mode"][0] == Mode.FAULT:
                return found
        state, left = plant.state.copy(), memory.copy()
        left["input"]["trips"] = int(trip)
        count = round(AFTER_S * 1e6) // period_us
        sample_us = instants_us(setup, done, count)
        run_block(base.law, left, reference, plant.params, state, sample_us, rows, count)
        assert left["mode"][0] == Mode.FAULT
        hits = int(state["event_count"][0]) - int(plant.state["event_count"][0])
        found.append((hits, float(rows["stroke_m"][:count].min())))
    return found


def main(scenario: str, law: str, devices: int, bus: str = "fd_5k") -> None:
    for trip in (Trip.OPERATOR, Trip.GATE_BLOCKED):
        found = [stop for seed in range(devices) for stop in stopped(scenario, law, seed, trip, 8, bus)]
        with_hits = sum(hits > 0 for hits, _ in found)
        lowest_um = min(low for _, low in found) * 1e6
        print(f"{trip.name}: {len(found)} stops, {with_hits} meet a mechanical stop, lowest stroke {lowest_um:.2f} um")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), *sys.argv[4:])
