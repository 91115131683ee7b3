"""Sampled devices in shipped scenarios, in moves and in circles, under the shipped laws: who is stopped, and why.

python tests/studies/alarms/sampled.py [LAW ...] [--devices 500] [--motions raster,moves]

A line of docs/tables/alarms.jsonl for each law and motion, written anew after every 50 devices: called again, it goes
on with what is missing.
"""

import argparse
import dataclasses
import json
import math
import time
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from test_false_alarms import circles, corner_to_corner

from hil.abreast import batch
from hil.lanes import in_process, many
from hil.lanes.lane import Lane
from hil.lanes.many import Batch
from hil.lanes.setup import Setup
from hil.runs.scenario import Scenario, load_scenario
from hil.studies.margins.loop import Loop
from hil.studies.montecarlo import Study
from pkxyz_ctrl.config.files import ConfigError, load
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.design.model.loop_plant import Perturbation
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import LOOP_CLOSED, Mode
from pkxyz_ctrl.safety.thresholds import SATURATION_SLACK_N
from pkxyz_ctrl.stage import Stage

LAWS = (
    "youla", "lqg", "lqg_wide", "robust", "irc", "irc_robust", "pi_notch", "pi_notch_robust", "hinf", "open_loop",
    "robust_20k", "mpc",
)  # fmt: skip
BUSES = {"robust_20k": "local_20k"}
"""Of laws that are not for fd_5k."""
SCENARIOS = (
    "raster", "steps", "circle", "lissajous", "path", "spiral", "sweep", "frames", "raster_mild", "raster_lab",
    "circle_lab", "raster_harsh", "frames_lab", "frames_harsh",
)  # fmt: skip
KEPT = Path(__file__).parents[3] / "docs" / "tables" / "alarms.jsonl"
PIECE = 50
"""Devices after which what was found is kept."""
BEFORE_TICKS = 50
SWINGS_S, SWINGS, SWING_GROWTH, SWING_LEAST_M = (0.1, 0.4), 4, 1.2, 50e-9
"""A stage whose true error (standard deviation) has grown by this factor from each of so many equal parts of one of
these times before it was stopped to the next, up to more than this, was not stopped for nothing: its loop is not
stable, whatever the linear plant says. What grows fast has not begun 0.4 s before, what grows slowly is not seen in
0.1 s.
"""
STOP_M = 25e-6
"""Of a slider, at either end of its stroke."""
MOTIONS = {"moves": corner_to_corner, "circles": circles}
"""Beside the scenarios: 2 mm/s to every corner of the workspace, and circles of 4 um at 100 Hz at three heights."""


@cache
def designed(motion: str, law: str, bus: str | None = None) -> tuple[Study, Setup]:
    """The study that samples devices, and a setup with its law designed."""
    scenario: Scenario = load_scenario(
        "faults" if motion in MOTIONS else motion, controller=law, bus=bus or BUSES.get(law)
    )
    setup = scenario.setup()
    if motion in MOTIONS:
        way = MOTIONS[motion]()
        setup = dataclasses.replace(setup, trajectory=way, duration_s=0.1 + way.duration_us * 1e-6)
        vars(setup)["law"] = scenario.setup().law
    return Study(scenario, load("tolerances", "wide", Tolerances)), setup


class Stopped(NamedTuple):
    """What became of a device that was stopped."""

    why: str
    is_asked_too_much: bool
    """its combs can't give, at their limits, what the reference takes in the last ticks, whatever the law"""
    is_at_stop: bool
    has_swung: bool
    """its error grew and grew"""


def asks_too_much(stage: Stage, device: Perturbation, rows: np.ndarray, period_s: float) -> bool:
    """Whether the reference of rows of ``ROW`` takes more force than a device has somewhere, or a push."""
    if len(rows) < 3:
        return False
    way_m = rows["reference_m"]
    inertia_n = stage.mass_kg * (1.0 + device.mass) * np.diff(way_m, n=2, axis=0) / period_s**2
    at_m = way_m[1:-1]
    held_n = (1.0 + device.stiffness) * stage.holding_forces(at_m)
    pulls = np.swapaxes(stage.pulls(at_m), -1, -2)
    needed_n = held_n + np.linalg.solve(pulls, inertia_n[..., None])[..., 0]
    most_n = stage.force_max_n * (1.0 + np.array(device.comb_gain))
    return bool(np.any((needed_n > most_n) | (needed_n < -SATURATION_SLACK_N)))


def swings(rows: np.ndarray) -> bool:
    """Whether the true error has grown from part to part of rows of ``ROW``."""
    error_m = rows["position_m"] - rows["reference_m"]
    if len(rows) < 10 * SWINGS:
        return False
    sizes = np.array([part.std(axis=0).max() for part in np.array_split(error_m, SWINGS)])
    return bool(np.all(sizes[1:] >= SWING_GROWTH * sizes[:-1]) and sizes[-1] > SWING_LEAST_M)


def stopped(motion: str, law: str, seed: int, bus: str | None = None) -> Stopped | None:
    """What became of the device of a seed. None if it was not stopped."""
    study, base = designed(motion, law, bus)
    setup = dataclasses.replace(base, plant=study.sampled(seed).plant, seed=seed)
    vars(setup)["law"] = base.law
    spans = [round(span_s / setup.bus.period_s) for span_s in SWINGS_S]
    last = np.zeros(0, ROW)

    def on_block(block: Any) -> None:
        nonlocal last
        driven = block[LOOP_CLOSED[block["mode"]] != 0]
        last = np.concatenate([last, driven])[-max(spans) :]

    faults = in_process.run(setup, Lane.FAST, on_block=on_block).faults
    if not faults:
        return None
    end, stage = last[-BEFORE_TICKS:], Stage(setup.stage)
    strokes_m = stage.inverse_kinematics(end["position_m"]) if len(end) else np.zeros((1, 3))
    device = study.tolerances.sample(seed).perturbation
    return Stopped(
        faults[0].splitlines()[0],
        asks_too_much(stage, device, end, setup.bus.period_s),
        bool(strokes_m.max() > STOP_M or strokes_m.min() < 0.0),
        any(swings(last[-ticks:]) for ticks in spans),
    )


def who_may_be_stopped(motion: str, law: str, seeds: range) -> list[int]:
    """Seeds of devices that end in a fault or are led down, all of them run side by side; all seeds where that can't
    be, as the law plans or something is learnt from period to period.
    """
    study, base = designed(motion, law)
    if not many.can_run(base):
        return list(seeds)
    setups = [dataclasses.replace(base, plant=study.sampled(seed).plant, seed=seed) for seed in seeds]
    devices = Batch.of(base, base.law, [setup.new_plant() for setup in setups])
    batch.run(devices)
    is_stopped = (devices.found["faulted"] != 0) | (devices.memories["mode"] == int(Mode.LANDING))
    return [seed for seed, is_one in zip(seeds, is_stopped, strict=True) if is_one]


def is_stable(motion: str, law: str, seed: int) -> bool:
    """Whether the linear loop of that device is, where it was sampled and in all of the workspace's corners."""
    study, setup = designed(motion, law)
    case, loop = study.tolerances.sample(seed), Loop(Stage(setup.stage), setup.bus, setup.law)
    points = [case.strokes_m, *study.tolerances.points_m().values()]
    return all(math.isfinite(loop.peak_sensitivity(dataclasses.replace(case, strokes_m=p))) for p in points)


def judge(motion: str, law: str, seed: int) -> str | None:
    """``None`` for a device that was not stopped; else whether its loop is not stable (``unstable``), it could not get
    there (``beyond``), or it was stopped for nothing (``false``).

    That the combs were at their limits is no excuse: a loop that swings ends there, too. What feeds nothing back can't
    know that its device goes further than the drawing, up to a stop.
    """
    found = stopped(motion, law, seed)
    if found is None:
        return None
    feeds_back = law != "open_loop"
    if feeds_back and (found.has_swung or not is_stable(motion, law, seed)):
        return "unstable"
    if found.is_asked_too_much or (found.is_at_stop and not feeds_back):
        return "beyond"
    print(f"  {law} in {motion}, device {seed}: {found.why}", flush=True)
    return "false"


def read(path: Path) -> dict[tuple[str, str], dict[str, Any]]:
    """What is known, by motion and law."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return {(d["motion"], d["law"]): d for d in map(json.loads, lines)}


def write(path: Path, known: dict[tuple[str, str], dict[str, Any]]) -> None:
    """Keep it, whole or not at all."""
    fresh = path.with_suffix(".part")
    fresh.write_text("".join(json.dumps(known[key]) + "\n" for key in sorted(known)), encoding="utf-8")
    fresh.replace(path)


def extend(found: dict[str, Any], devices: int) -> None:
    """Try further devices of a law and motion, up to a number of them."""
    motion, law = found["motion"], found["law"]
    if "refused" in found:
        return
    try:
        assert designed(motion, law)[1].law is not None  # some stages are too slow or too stiff for a law
    except ConfigError as error:
        found["refused"] = str(error)
        return
    for seed in who_may_be_stopped(motion, law, range(found["devices"] + 1, devices + 1)):
        verdict = judge(motion, law, seed)
        if verdict is not None:
            found[verdict].append(seed)
    found["devices"] = devices


def options(laws: list[str], results: Path) -> argparse.Namespace:
    """Which laws and motions, how many devices of each, and where what came of them is kept."""
    parser = argparse.ArgumentParser()
    parser.add_argument("laws", nargs="*", default=laws)
    parser.add_argument("--devices", type=int, default=500)
    parser.add_argument("--motions", default=",".join((*MOTIONS, *SCENARIOS)))
    parser.add_argument("--results", type=Path, default=results)
    return parser.parse_args()


def main() -> None:
    """Go through what is missing in the file of results."""
    asked = options(list(LAWS), KEPT)
    known = read(asked.results)
    batch.prepare(own_laws=False)
    for motion in asked.motions.split(","):
        for law in asked.laws:
            fresh = {"motion": motion, "law": law, "devices": 0, "beyond": [], "unstable": [], "false": []}
            found = known.setdefault((motion, law), fresh)
            begin_s = time.process_time()
            while found["devices"] < asked.devices and "refused" not in found:
                extend(found, min(found["devices"] + PIECE, asked.devices))
                write(asked.results, known)
            counts = {k: len(v) for k, v in found.items() if isinstance(v, list)}
            print(f"{law} in {motion}: {found['devices']} devices, {counts}, {time.process_time() - begin_s:.0f} s",
                  found.get("refused", ""), flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
