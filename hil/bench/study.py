"""The fast lane in a study: how many closed-loop seconds two worker processes get through in a second, as `pkxyz
montecarlo` and `pkxyz tune` use them; what a device of `pkxyz yield` costs; and what it costs to spread the work.
"""

import gc
import statistics
import time
from importlib.util import find_spec

import numpy as np

from hil.abreast import batch
from hil.bench.rigs.figure import Figure
from hil.runs.scenario import Scenario, build_scenario, load_scenario
from hil.studies.montecarlo import Study, run_one
from hil.studies.spread.cluster import Cluster
from hil.studies.spread.workers import Pool, as_done, packed_bytes, with_constant, worker_pool
from hil.studies.tune.search import evaluate, load_problem
from hil.studies.wafer.closed_loop import PART_DEVICES, PARTS_TOGETHER, ClosedLoops
from hil.studies.wafer.study import Columns, WaferStudy, work_at
from pkxyz_ctrl.config.files import load, plain
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.fabrication.process import Process

WORKERS = 2
ROUNDS = 5
PLANTS = 60
"""Of a round."""
SPREAD_PLANTS = 400
"""Of a round that compares two workers with one: at its end one waits for the other, for up to a plant's time."""
TRIALS = 12
"""The first ones read files and load kernels."""
SCAN_LINES, SCAN_LAYERS, SCAN_HOLD_S, SCAN_RUN_S = 9, 2, 0.05, 0.5
"""A scan of 0.3 s at 60 lines/s; the holds before and after it; the run, start-up and the way there included."""
PARTS = 8
"""Of ``PART_DEVICES`` each."""
PIECE_DEVICES = PARTS_TOGETHER * PART_DEVICES
"""Of a large yield."""
PIECES = 1000
"""That take no time."""
HELD_PIECES = 4


def study() -> list[Figure]:
    """Plants of a Monte Carlo study, from drawing one to its figures and its Ms; starting the two processes and the
    first plant of each are left out. Beside it a trial of a tuning, in the same processes.
    """
    batch.prepare(own_laws=False)  # as a yield of so many devices has it
    plants = Study(load_scenario("raster", controller="lqg"), load("tolerances", "wide", Tolerances))
    stage_s = plants.scenario.config.duration_s
    walls, busy = [], []
    with worker_pool(WORKERS) as (pool, width):
        list(as_done(pool, width, with_constant(_timed, plants), range(4 * WORKERS)))
        for n in range(ROUNDS):
            gc.collect()
            begin = time.perf_counter()
            seeds = range(1000 * (n + 1), 1000 * (n + 1) + PLANTS)
            busy.append(
                sum(cpu_s for _, cpu_s in as_done(pool, width, with_constant(_timed, plants), seeds, ahead=width))
            )
            walls.append(time.perf_counter() - begin)
        list(as_done(pool, width, _trial, range(2 * WORKERS)))
        trial_s = [cpu_s for _, cpu_s in as_done(pool, width, _trial, range(2 * WORKERS, TRIALS))]
        device_ms = _device_ms(pool, width)
    by_clock = [PLANTS * stage_s / wall for wall in walls]
    by_processor = [WORKERS * PLANTS * stage_s / cpu for cpu in busy]
    each_ms = min(busy) / PLANTS * 1e3
    return [
        Figure("study.realtime", max(by_processor), "times", 100.0, "at least", statistics.median(by_processor),
               f"{WORKERS} cores with nothing else to do, by processor time; {PLANTS} plants a round, {stage_s:g} s of "
               "stage time each"),
        Figure("study.realtime_clock", max(by_clock), "times", None, None, statistics.median(by_clock),
               "the same by the clock on the wall, with whatever else the machine does"),
        Figure("study.plant", each_ms, "ms", None, None, statistics.median(busy) / PLANTS * 1e3,
               "processor time of a plant: sampled, run, its figures, Ms of its linear loop"),
        Figure("study.trial", min(trial_s) * 1e3, "ms", None, None, statistics.median(trial_s) * 1e3,
               "processor time of a trial of `pkxyz tune lqg`: designed, margins, Ms of 135 changed plants, two runs"),
        Figure("study.device", min(device_ms), "ms", 9.6, "at most", statistics.median(device_ms),
               f"processor time of a device of `pkxyz yield`, {PART_DEVICES} at once: made, its figures, Ms under the "
               "shipped law, a run of 0.5 s with a scan of 0.3 s; 9.6 ms are 10^6 devices in 80 min on 2 cores"),
    ]  # fmt: skip


def spread() -> list[Figure]:
    """What it takes to work in several processes: plants on two against one; of a large `pkxyz yield` what a worker
    holds and what a piece is made of, and the time of the process in which a Dask scheduler and its client are for
    pieces as large that take no time (where distributed is installed).
    """
    plants = Study(load_scenario("raster", controller="lqg"), load("tolerances", "wide", Tolerances))
    alone: list[float] = []
    both: list[float] = []
    with worker_pool(1) as (one, _), worker_pool(WORKERS) as (two, _):
        for pool, width in ((one, 1), (two, WORKERS)):
            list(as_done(pool, width, with_constant(_timed, plants), range(4 * width)))
        for n in range(ROUNDS):
            seeds = range(1000 * (n + 1), 1000 * (n + 1) + SPREAD_PLANTS)
            for pool, width, walls in ((one, 1, alone), (two, WORKERS, both)):
                begin = time.perf_counter()
                list(as_done(pool, width, with_constant(_timed, plants), seeds, ahead=width))
                walls.append(time.perf_counter() - begin)
    loops = _loops()
    with worker_pool(1) as (one, _):
        held = [mb for _, mb in as_done(one, 1, with_constant(_held_mb, loops), _yield_pieces(HELD_PIECES))]
    sent, back = _carried_bytes(loops)
    ratios = [a / b for a, b in zip(alone, both, strict=True)]
    found = [
        Figure("spread.two_workers", min(alone) / min(both), "times", 1.8, "at least", statistics.median(ratios),
               f"{SPREAD_PLANTS} plants on two local workers against one, by the clock on the wall, in turn"),
        Figure("spread.worker_memory", max(held), "MB", None, None, None,
               f"most that a worker held, libraries and kernels included, after {HELD_PIECES} pieces of `pkxyz yield`, "
               f"{PIECE_DEVICES} devices each"),
        Figure("spread.piece_sent", sent * 1e-3, "kB", None, None, None,
               "what goes to a worker with each such piece: the study, and which devices"),
        Figure("spread.piece_back", back * 1e-3, "kB", None, None, None, "what comes back: all columns of its devices"),
    ]  # fmt: skip
    if find_spec("distributed") is None:
        return found
    piece_ms = _piece_ms(loops)
    return [
        *found,
        Figure("spread.piece", min(piece_ms), "ms", None, None, statistics.median(piece_ms),
               "processor time of a Dask scheduler and its client for a piece that carries as much"),
    ]  # fmt: skip


def _loops() -> ClosedLoops:
    """Devices as ``study.device`` has them."""
    scenario = short_scan()
    return ClosedLoops(WaferStudy(load("processes", "oreo_drie", Process), scenario.stage, 1), scenario, known=False)


def _yield_pieces(count: int) -> list[range]:
    return [range(first, first + PARTS_TOGETHER) for first in range(0, count * PARTS_TOGETHER, PARTS_TOGETHER)]


def _held_mb(loops: ClosedLoops, parts: range) -> float:
    """Most memory that this process has had, in MB, a piece later."""
    import resource  # which not every system has

    work_at(loops, parts)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024e-6


def _carried_bytes(loops: ClosedLoops) -> tuple[int, int]:
    """Of a piece: to a worker and back."""
    piece = range(PARTS_TOGETHER)
    return packed_bytes((with_constant(work_at, loops), piece)), packed_bytes(_as_many(loops.part(0), piece))


def _as_many(columns: Columns, parts: range) -> Columns:
    """Columns of a part as often as there are parts."""
    return {name: np.tile(values, len(parts)) for name, values in columns.items()}


def _carried(study: tuple[ClosedLoops, Columns], parts: range) -> Columns:
    return _as_many(study[1], parts)


def _piece_ms(loops: ClosedLoops) -> list[float]:
    from distributed import LocalCluster

    found = []
    with (
        LocalCluster(
            n_workers=WORKERS, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
        ) as cluster,
        worker_pool(1, Cluster(cluster.scheduler_address)) as (pool, width),
    ):
        work = with_constant(_carried, (loops, loops.part(0)))
        list(as_done(pool, width, work, _yield_pieces(100), ahead=width))
        for _ in range(ROUNDS):
            begin = time.process_time()
            for _, columns in as_done(pool, width, work, _yield_pieces(PIECES), ahead=width):
                assert len(columns["device"]) == PIECE_DEVICES
            found.append((time.process_time() - begin) / PIECES * 1e3)
    return found


def short_scan() -> Scenario:
    """The default scenario with a scan of 0.3 s."""
    data = plain(load_scenario("raster").config)
    data["reference"][3] |= {"lines": SCAN_LINES, "layers": SCAN_LAYERS}
    for hold in (2, 4):
        data["reference"][hold] |= {"duration_s": SCAN_HOLD_S}
    return build_scenario(data | {"duration_s": SCAN_RUN_S})


def _device_ms(pool: Pool, width: int) -> list[float]:
    timed = with_constant(_timed_part, _loops())
    list(as_done(pool, width, timed, range(2 * WORKERS)))
    return [cpu_s / PART_DEVICES * 1e3 for _, cpu_s in as_done(pool, width, timed, range(4, 4 + PARTS))]


def _timed_part(loops: ClosedLoops, number: int) -> float:
    """Processor time of a part in s."""
    begin = time.process_time()
    loops.part(number)
    return time.process_time() - begin


def _timed(plants: Study, seed: int) -> float:
    """Processor time of one plant in s, in the process that runs it."""
    begin = time.process_time()
    run_one(plants, seed)
    return time.process_time() - begin


def _trial(n: int) -> float:
    """Processor time in s of one trial, of numbers next to the shipped ones, designed anew."""
    problem = load_problem("lqg")
    numbers = {key: value * (1.0 + 1e-3 * n) for key, value in problem.start().items()}
    begin = time.process_time()
    evaluate(problem, numbers)
    return time.process_time() - begin
