"""The fast lane in a study: how many closed-loop seconds two worker processes get through in a second, as `pkxyz
montecarlo` and `pkxyz tune` use them.
"""

import gc
import statistics
import time
from functools import partial

from hil.bench.figure import Figure
from hil.montecarlo import Study, run_one
from hil.scenario import load_scenario
from hil.search import evaluate, load_problem
from hil.workers import as_done, hands
from pkxyz_ctrl.config import load
from pkxyz_ctrl.design.tolerances import Tolerances

WORKERS = 2
ROUNDS = 5
PLANTS = 60
"""Of a round."""
TRIALS = 12


def study() -> list[Figure]:
    """Plants of a Monte Carlo study, from drawing one to its figures and its Ms; starting the two processes and the
    first plant of each are left out. Beside it a trial of a tuning, all in one process.
    """
    plants = Study(load_scenario("raster", controller="lqg"), load("tolerances", "wide", Tolerances))
    stage_s = plants.scenario.config.duration_s
    walls, busy = [], []
    with hands(WORKERS) as (pool, width):
        list(as_done(pool, width, partial(_timed, plants), range(4 * WORKERS)))
        for n in range(ROUNDS):
            gc.collect()
            begin = time.perf_counter()
            seeds = range(1000 * (n + 1), 1000 * (n + 1) + PLANTS)
            busy.append(sum(cpu_s for _, cpu_s in as_done(pool, width, partial(_timed, plants), seeds)))
            walls.append(time.perf_counter() - begin)
    by_clock = [PLANTS * stage_s / wall for wall in walls]
    by_processor = [WORKERS * PLANTS * stage_s / cpu for cpu in busy]
    trial_s = _trials()
    each_ms = min(busy) / PLANTS * 1e3
    return [
        Figure("study.realtime", max(by_clock), "times", 100.0, "at least", statistics.median(by_clock),
               f"{WORKERS} processes, {PLANTS} plants a round, {stage_s:g} s of stage time each; clock on the wall"),
        Figure("study.realtime_processor", max(by_processor), "times", None, None, statistics.median(by_processor),
               f"the same by processor time: what {WORKERS} cores without other work would do"),
        Figure("study.plant", each_ms, "ms", None, None, statistics.median(busy) / PLANTS * 1e3,
               "processor time of a plant: drawn, run, its figures, Ms of its linear loop"),
        Figure("study.trial", min(trial_s) * 1e3, "ms", None, None, statistics.median(trial_s) * 1e3,
               "processor time of a trial of `pkxyz tune lqg`: designed, margins, Ms of 135 changed plants, two runs"),
    ]  # fmt: skip


def _timed(plants: Study, seed: int) -> float:
    """Processor time of one plant in s, in the process that runs it."""
    begin = time.process_time()
    run_one(plants, seed)
    return time.process_time() - begin


def _trials() -> list[float]:
    """Of numbers next to the shipped ones, each designed anew."""
    problem = load_problem("lqg")
    start = problem.start()
    seconds = []
    for n in range(TRIALS):
        numbers = {key: value * (1.0 + 1e-3 * n) for key, value in start.items()}
        begin = time.process_time()
        evaluate(problem, numbers)
        seconds.append(time.process_time() - begin)
    return seconds
