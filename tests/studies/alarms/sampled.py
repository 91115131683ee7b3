"""Sampled devices in shipped scenarios, in moves and in circles, under the shipped laws: who is stopped, and why.

python tests/studies/alarms/sampled.py RESULTS.jsonl [LAW ...] [--devices 500] [--motions raster,moves]

A line for each law and motion, kept when it is done: called again, it goes on with what is missing.
"""

import argparse
import dataclasses
import json
import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from test_false_alarms import circles, corner_to_corner

from hil.lanes import in_process
from hil.lanes.lane import Lane
from hil.lanes.setup import Setup
from hil.runs.scenario import Scenario, load_scenario
from hil.studies.margins.loop import Loop
from hil.studies.montecarlo import Study
from pkxyz_ctrl.config.files import ConfigError, load
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.safety.modes import LOOP_CLOSED
from pkxyz_ctrl.stage import Stage

LAWS = (
    "youla", "lqg", "lqg_wide", "robust", "irc", "irc_robust", "pi_notch", "pi_notch_robust", "hinf", "open_loop", "mpc"
)  # fmt: skip
SCENARIOS = (
    "raster", "steps", "circle", "lissajous", "path", "spiral", "sweep", "frames", "raster_mild", "raster_lab",
    "circle_lab", "raster_harsh", "frames_lab", "frames_harsh",
)  # fmt: skip
BEFORE_TICKS = 50
STOP_M = 25e-6
"""Of a slider, at either end of its stroke."""
MOTIONS = {"moves": corner_to_corner, "circles": circles}
"""Beside the scenarios: 2 mm/s to every corner of the workspace, and circles of 4 um at 100 Hz at three heights."""


@cache
def designed(motion: str, law: str) -> tuple[Study, Setup]:
    """The study that samples devices, and a setup with its law designed."""
    scenario: Scenario = load_scenario("faults" if motion in MOTIONS else motion, controller=law)
    setup = scenario.setup()
    if motion in MOTIONS:
        way = MOTIONS[motion]()
        setup = dataclasses.replace(setup, trajectory=way, duration_s=0.1 + way.duration_us * 1e-6)
        vars(setup)["law"] = scenario.setup().law
    return Study(scenario, load("tolerances", "wide", Tolerances)), setup


def stopped(motion: str, law: str, seed: int) -> tuple[str, bool] | None:
    """Why the device of a seed was stopped, and whether it could not get where it was to be: it was at a stop of its
    own, or its combs at their limits. None if it was not stopped.
    """
    study, base = designed(motion, law)
    setup = dataclasses.replace(base, plant=study.sampled(seed).plant, seed=seed)
    vars(setup)["law"] = base.law
    last: list[Any] = []

    def on_block(block: Any) -> None:
        driven = block[LOOP_CLOSED[block["mode"]] != 0]
        last[:] = [driven[-BEFORE_TICKS:].copy()] if len(driven) else last

    faults = in_process.run(setup, Lane.FAST, on_block=on_block).faults
    if not faults:
        return None
    strokes = Stage(setup.stage).inverse_kinematics(last[0]["position_m"]) if last else np.zeros((1, 3))
    at_limits = float(last[0]["saturated"].mean()) > 0.5 if last else False
    return faults[0].splitlines()[0], bool(strokes.max() > STOP_M or strokes.min() < 0.0) or at_limits


def is_stable(motion: str, law: str, seed: int) -> bool:
    """Whether the linear loop of that device is, where it was sampled and in all of the workspace's corners."""
    study, setup = designed(motion, law)
    if law == "open_loop":
        return True
    case, loop = study.tolerances.sample(seed), Loop(Stage(setup.stage), setup.bus, setup.law)
    points = [case.strokes_m, *study.tolerances.points_m().values()]
    return all(math.isfinite(loop.peak_sensitivity(dataclasses.replace(case, strokes_m=p))) for p in points)


def of_law(motion: str, law: str, devices: int) -> dict[str, Any]:
    """How many were stopped, and why; which of them could not get there, and which have a stable loop and could: those
    are false alarms.
    """
    found: dict[str, Any] = {"law": law, "motion": motion, "devices": devices, "stopped": {}, "beyond": [], "false": []}
    try:
        assert designed(motion, law)[1].law is not None  # some stages are too slow or too stiff for a law
    except ConfigError as error:
        return found | {"refused": str(error)}
    for seed in range(1, devices + 1):
        why = stopped(motion, law, seed)
        if why is None:
            continue
        found["stopped"][seed] = why[0]
        if why[1]:
            found["beyond"].append(seed)
        elif is_stable(motion, law, seed):
            found["false"].append(seed)
    return found


def main() -> None:
    """Go through what is missing in the file of results."""
    parser = argparse.ArgumentParser()
    parser.add_argument("results", type=Path)
    parser.add_argument("laws", nargs="*", default=list(LAWS))
    parser.add_argument("--devices", type=int, default=500)
    parser.add_argument("--motions", default=",".join((*MOTIONS, *SCENARIOS)))
    asked = parser.parse_args()
    text = asked.results.read_text(encoding="utf-8") if asked.results.exists() else ""
    known = {(d["law"], d["motion"]) for d in map(json.loads, text.splitlines()) if d["devices"] >= asked.devices}
    for motion in asked.motions.split(","):
        for law in asked.laws:
            if (law, motion) in known:
                continue
            found = of_law(motion, law, asked.devices)
            with asked.results.open("a", encoding="utf-8") as file:
                file.write(json.dumps(found) + "\n")
            if "refused" in found:
                print(f"{law} in {motion}: {found['refused']}", flush=True)
                continue
            print(
                f"{law} in {motion}: {len(found['stopped'])} of {asked.devices} stopped, {len(found['beyond'])} beyond "
                f"what they reach, false alarms: {len(found['false'])} {found['false'][:5]}", flush=True
            )  # fmt: skip


if __name__ == "__main__":
    main()
