"""The fast lane in a study: how many closed-loop seconds two worker processes get through in a second, as `pkxyz
montecarlo` and `pkxyz tune` use them.
"""

import gc
import statistics
import time

from hil.bench.figure import Figure
from hil.runs.scenario import load_scenario
from hil.studies.montecarlo import Study, run_one
from hil.studies.spread.workers import as_done, with_constant, worker_pool
from hil.studies.tune.search import evaluate, load_problem
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.design.margins.tolerances import Tolerances

WORKERS = 2
ROUNDS = 5
PLANTS = 60
"""Of a round."""
TRIALS = 12
"""The first ones read files and load kernels."""


def study() -> list[Figure]:
    """Plants of a Monte Carlo study, from drawing one to its figures and its Ms; starting the two processes and the
    first plant of each are left out. Beside it a trial of a tuning, in the same processes.
    """
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
    ]  # fmt: skip


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
