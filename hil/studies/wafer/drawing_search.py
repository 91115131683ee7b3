"""The search for a drawing by Optuna, kept in a database as it goes on; and its best ones against others, on devices
that the search has not seen.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from numpy.typing import NDArray

from hil.studies.spread.cluster import Cluster
from hil.studies.spread.trials import judged, stored_study, tell
from hil.studies.spread.workers import as_done, with_constant, worker_pool
from hil.studies.wafer.closed_loop import PART_DEVICES, ClosedLoops
from hil.studies.wafer.drawing import OPEN, Choice, DrawingProblem, Verdict, evaluate, working
from hil.studies.wafer.shares import Share, share_of
from hil.studies.wafer.study import run_study
from hil.studies.wafer.table import Table

Tell = Callable[[int, int], None]

_STATE = optuna.trial.TrialState
_NAME = "design-for-yield"
_TOGETHER = 4
"""Choices that are asked for at once, however many workers there are: so their number decides nothing."""
_START = 12
"""Choices at random before the model of the good ones begins."""


def open_study(problem: DrawingProblem, path: Path, first: list[Choice]) -> optuna.Study:
    """The study in a file, made anew, with ``first`` to begin with, or continued. Raises ``ConfigError`` for a file
    that can't be had, and for another problem's.
    """
    study = stored_study(_NAME, f"sqlite:///{path}", problem.digest(), first, maximise=True, asked=f"--out: {path}")
    for trial in study.get_trials(deepcopy=False, states=(_STATE.RUNNING,)):  # of a search that was killed
        study.tell(trial.number, state=_STATE.FAIL)
    return study


def search(
    study: optuna.Study,
    problem: DrawingProblem,
    trials: int,
    workers: int,
    cluster: Cluster | None = None,
    on_progress: Tell = lambda done, total: None,
) -> None:
    """Go on until there are ``trials`` verdicts. Interrupted, it keeps those that are there."""
    on_progress(min(len(judged(study)), trials), trials)
    if len(judged(study)) >= trials:
        return
    with worker_pool(workers, cluster) as (pool, width):
        while (there := len(judged(study))) < trials:
            state = int(np.random.SeedSequence([problem.seed, there]).generate_state(1)[0])
            study.sampler = optuna.samplers.TPESampler(
                seed=state, multivariate=True, constant_liar=True, n_startup_trials=_START
            )
            asked = [study.ask() for _ in range(min(_TOGETHER, trials - there))]
            try:
                choices = [(t.number, _choice(t, problem)) for t in asked]
                done = {
                    item[0]: verdict for item, verdict in as_done(pool, width, with_constant(_valued, problem), choices)
                }
            except BaseException:
                for trial in asked:
                    study.tell(trial, state=_STATE.FAIL)
                raise
            for trial in asked:
                tell(study, trial, done[trial.number])
            on_progress(there + len(asked), trials)


def best(study: optuna.Study, count: int) -> list[Choice]:
    """The best choices of which devices were run, best first."""
    found = [t for t in study.get_trials(deepcopy=False, states=(_STATE.COMPLETE,)) if "works" in t.user_attrs]
    unlike = {tuple(t.params.values()): t for t in sorted(found, key=lambda t: t.value or 0.0)}
    order = sorted(unlike.values(), key=lambda t: (-(t.value or 0.0), t.number))
    return [_rounded(t.params) for t in order[:count]]


def nearest(study: optuna.Study) -> dict[str, float]:
    """Inequalities that the trial misses which misses least, and by how much; empty where one keeps all."""
    tried = [t for t in judged(study) if t.constraints]
    closest = min(tried, key=lambda t: max(t.constraints.values()), default=None)
    return {} if closest is None else {name: v for name, v in closest.constraints.items() if v >= 0.0}


def _choice(trial: optuna.Trial, problem: DrawingProblem) -> Choice:
    return _rounded({name: trial.suggest_float(name, *problem.range_of(name)) for name in OPEN})


def _rounded(params: Mapping[str, Any]) -> Choice:
    """To the mask's grid: what is tried is what the file will say."""
    return {name: round(round(value / OPEN[name].step) * OPEN[name].step, 6) for name, value in params.items()}


def _valued(problem: DrawingProblem, item: tuple[int, Choice]) -> Verdict:
    return evaluate(problem, item[1])


@dataclass(frozen=True)
class Confirmed:
    """A drawing's devices of fresh wafers."""

    columns: dict[str, NDArray[Any]]
    """of their table"""
    works: NDArray[np.bool_]
    """(n,) one a wafer"""

    @property
    def share(self) -> Share:
        """That work."""
        return share_of(self.works, self.columns["device"])


def confirmed(
    asked: ClosedLoops, devices: int, folder: Path, workers: int, cluster: Cluster | None, tell: Tell
) -> Confirmed:
    """Devices in a closed loop, those that are in the folder already taken from there."""
    table = Table(folder, asked.digest())
    if asked.identified:
        _ = asked.mean_modes  # once here, not in each worker
    run_study(asked, -(-devices // PART_DEVICES), table, workers, cluster, tell)
    columns = table.read(["device", "own", *asked.columns, *asked.verdict_columns], devices)
    return Confirmed(columns, working(asked, columns))


def gained(by: Confirmed, over: Confirmed) -> tuple[float, float]:
    """By how much more of the same wafers' devices work, and the half width of its interval (95 %)."""
    difference = by.works.astype(np.float64) - over.works
    return float(difference.mean()), float(1.96 * difference.std(ddof=1) / np.sqrt(len(difference)))
