"""How fast the lanes are, and where a tick of the lockstep lane goes."""

import platform
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.abreast import batch as side_by_side
from hil.bench.rigs.closed_loop import scan
from hil.bench.rigs.figure import Figure, once, repeated, times_of
from hil.bench.rigs.instructions import chain_of_products, clock_hz, instructions_per_tick
from hil.bench.rigs.played import Played, PlayedPort, drive_counts, recorded_frames
from hil.bench.tick import ticks_from_python
from hil.lanes import in_process as lanes
from hil.lanes.lane import Lane
from hil.lanes.setup import Setup
from hil.plant.on_bus import PlantOnBus
from hil.recording.recording import RecordingWriter
from hil.runs.metrics import Metrics
from hil.runs.run_folder import metadata_of
from hil.runs.scenario import Scenario, load_scenario, resolve

REPEATS = 15
BATCH_DEVICES = 64
TAKEN_IN = 6
"""Instructions a cycle: Intel's Golden Cove renames so many (Optimization Reference Manual, 2.3), AMD's Zen 4 too."""

_PARTS = {
    "bus_and_node": "clock, wire, amplifier node, row: the remainder",
    "driver_and_gate": "the loop itself, driver, gate, supervision",
    "cycle": "the tick, as tick.call",
    "plant": "a period of motion, combs, sense chain with its noise",
    "recording_and_log": "rows to Arrow, frames to candump lines, figures",
}


def lockstep() -> list[Figure]:
    """The default scenario in the lockstep lane, recording and frame log written, on one core; and, event by event, its
    parts.

    A part is measured alone on what a run gave it: the plant on the recorded voltages, the controller on the recorded
    frames, the cycle on the recorded samples. Recording and log are the difference to a run without them, bus and node
    what then remains. Each part alone has the caches for itself, so the remainder also holds what they cost each other.
    """
    scenario = load_scenario("raster")
    setup = scenario.setup()
    came, went = recorded_frames(setup)
    counts = drive_counts(went, setup.gate.node_id)
    cycle = ticks_from_python(scan())
    seconds: dict[str, list[float]] = {
        k: [] for k in ("whole", "close", "events", "bare", "controller", "plant", "cycle")
    }
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(REPEATS):
            whole_s, close_s = _recorded_run(scenario, setup, Path(folder))
            seconds["whole"].append(whole_s)
            seconds["close"].append(close_s)
            seconds["events"].append(_recorded_run(scenario, setup, Path(folder), whole_ticks=False)[0])
            bare = partial(lanes.run, setup, Lane.LOCKSTEP, on_block=_forget, whole_ticks=False)
            seconds["bare"].append(once(bare))
            played = Played(setup, PlayedPort(came))
            seconds["controller"].append(once(played.run))
            if not np.array_equal(drive_counts(played.port.sent, setup.gate.node_id)[: len(counts)], counts):
                raise RuntimeError("the controller alone sent other voltages than in the run: not the same work")
            plant = PlantOnBus(setup.new_plant())
            seconds["plant"].append(once(partial(_plant_alone, plant, counts.tolist(), setup.bus.period_us)))
            seconds["cycle"].append(once(cycle))
    ticks = setup.ticks
    per_tick = {
        k: times_of(s).per(len(scan().rows) if k == "cycle" else len(counts) if k == "plant" else ticks)[0]
        for k, s in seconds.items()
    }
    whole, events, tick_us = times_of(seconds["whole"]), times_of(seconds["events"]), per_tick["events"]
    shares = {
        "bus_and_node": per_tick["bare"] - per_tick["plant"] - per_tick["controller"],
        "driver_and_gate": per_tick["controller"] - per_tick["cycle"],
        "cycle": per_tick["cycle"],
        "plant": per_tick["plant"],
        "recording_and_log": tick_us - per_tick["bare"],
    }
    return [
        Figure("lockstep.realtime", _factor(setup, whole.best_s), "times", 25.0, "at least",
               _factor(setup, whole.median_s),
               f"{setup.bus.name}, start-up, recording, frame log and figures included; closing the files takes "
               f"{min(seconds['close']) * 1e3:.0f} ms more"),
        Figure("lockstep.events", _factor(setup, events.best_s), "times", None, None, _factor(setup, events.median_s),
               "the same, every tick event by event, as it is with an endpoint of python-can's on the bus"),
        Figure("lockstep.tick", tick_us, "us", None, None, events.per(ticks)[1],
               "event by event: the sum of the following"),
        *(Figure(f"lockstep.{part}", part_us, "us", None, None, None, f"{part_us / tick_us:.0%}: {_PARTS[part]}")
          for part, part_us in shares.items()),
    ]  # fmt: skip


def fast() -> list[Figure]:
    """The default scenario in the fast lane: as a study runs it, without a file, and as `pkxyz sil` does, recorded;
    and with laws that learn nothing meanwhile.
    """
    scenario = load_scenario("raster")
    setup = scenario.setup()
    fixed = replace(setup, controller=setup.controller.model_copy(update={"learn": "off"}))
    setups = {"bare": setup, "fixed": fixed, "lqg": load_scenario("raster", controller="lqg").setup()}
    runs = {what: partial(lanes.run, each, Lane.FAST, on_block=_forget) for what, each in setups.items()}
    for run in runs.values():
        run()
    taken = repeated(runs, REPEATS)
    bare = taken["bare"]
    best, median = bare.per(setup.ticks)
    with tempfile.TemporaryDirectory() as folder:
        recorded = times_of([_recorded_run(scenario, setup, Path(folder), Lane.FAST)[0] for _ in range(REPEATS)])
    return [
        Figure("fast.realtime", _factor(setup, bare.best_s), "times", 200.0, "at least", _factor(setup, bare.median_s),
               "trajectory, cycle and plant, rows handed on"),
        Figure("fast.realtime_fixed", _factor(setup, taken["fixed"].best_s), "times", None, None,
               _factor(setup, taken["fixed"].median_s), 'the same with learn = "off"'),
        Figure("fast.realtime_lqg", _factor(setup, taken["lqg"].best_s), "times", None, None,
               _factor(setup, taken["lqg"].median_s), "the same under lqg, which neither learns nor has a ring"),
        Figure("fast.realtime_recorded", _factor(setup, recorded.best_s), "times", None, None,
               _factor(setup, recorded.median_s), "with the recording and the figures of the run"),
        Figure("fast.tick", best, "us", None, None, median, "tick.kernel and plant.period make most of it"),
        *_instructions(setup),
    ]  # fmt: skip


def _instructions(setup: Setup) -> list[Figure]:
    """What no compiler can go below with so many; nothing where they can't be counted."""
    instructions = instructions_per_tick()
    if instructions is None or platform.machine() != "x86_64":
        return []
    products = repeated({"products": chain_of_products}, REPEATS)["products"]
    hz = clock_hz(products.best_s)
    least_s = instructions / (TAKEN_IN * hz)
    detail = (
        f"of a tick of one device; a core that takes in {TAKEN_IN} a cycle, at {hz / 1e9:.1f} GHz, needs "
        f"{least_s * 1e6:.2f} us for them at least, {setup.bus.period_s / least_s:.0f} times real time"
    )
    return [Figure("fast.instructions", instructions, "count", None, None, None, detail)]


def batch() -> list[Figure]:
    """Devices of the default scenario, each with a noise of its own, on one core, side by side where it has AVX-512;
    making them is left out. Raises ``RuntimeError`` where one is left in a fault, or sees no scan.
    """
    how = "side by side" if side_by_side.prepare(own_laws=False) else "one after another, as there is no AVX-512"
    setup = load_scenario("raster").setup()
    plants = [replace(setup, seed=seed).new_plant() for seed in range(1, BATCH_DEVICES + 1)]

    def run() -> None:
        found = side_by_side.scan_errors(setup, setup.law, plants)
        if found["faulted"].any() or not found["ticks"].all():
            raise RuntimeError("a device was not run to its end: not the same work")

    run()
    taken = repeated({"batch": run}, REPEATS)["batch"]
    best, median = taken.per(BATCH_DEVICES * setup.ticks)
    return [
        Figure("batch.realtime", _factor(setup, taken.best_s) * BATCH_DEVICES, "times", 300.0, "at least",
               _factor(setup, taken.median_s) * BATCH_DEVICES,
               f"{BATCH_DEVICES} devices {how}, of each the errors of its scan"),
        Figure("batch.tick", best, "us", None, None, median, "of one device: cycle and plant, no rows"),
    ]  # fmt: skip


def _factor(setup: Setup, seconds: float) -> float:
    return setup.ticks * setup.bus.period_s / seconds


def _recorded_run(
    scenario: Scenario, setup: Setup, folder: Path, lane: Lane = Lane.LOCKSTEP, *, whole_ticks: bool = True
) -> tuple[float, float]:
    """Processor time in s of one run as `pkxyz sil` does it, and of closing its recording."""
    metrics, log = Metrics(setup.trajectory, setup.bus.period_us), folder / "frames.log"
    recording = RecordingWriter(folder / "recording.parquet", metadata_of(scenario, lane, resolve(scenario)))

    def on_block(block: NDArray[np.void]) -> None:
        recording.write(block)
        metrics.update(block)

    try:
        run_s = once(partial(lanes.run, setup, lane, on_block=on_block, frame_log=log, whole_ticks=whole_ticks))
    finally:
        close_s = once(recording.close)
    return run_s, close_s


def _plant_alone(plant: PlantOnBus, counts: list[list[int]], period_us: int) -> None:
    for k, (a, b, c) in enumerate(counts):
        plant.exchange(period_us * k, (a, b, c), sample=True)


def _forget(block: NDArray[np.void]) -> None:
    pass
