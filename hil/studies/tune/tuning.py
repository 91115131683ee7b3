"""A search by Optuna: numbers are asked for here, valued by many workers, and told back here; the study lives in a
database, so it can be continued, and shared by several machines.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import tomlkit

from hil.studies.spread.cluster import Cluster
from hil.studies.spread.trials import stored_study, tell
from hil.studies.spread.workers import as_done, with_constant, worker_pool
from hil.studies.tune.search import Evaluation, Problem, evaluate, put
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.config.refused import reason

_DIGITS = 4
"""Significant digits of a tried number: what is tried is what the file will say."""
_STATE = optuna.trial.TrialState


@dataclass(frozen=True)
class Best:
    """The best trial that keeps every constraint."""

    number: int
    value: float
    numbers: dict[str, float]
    figures: dict[str, float]


def open_study(problem: Problem, storage: str, seed: int) -> optuna.Study:
    """The study of a problem in a database, made anew or continued. Raises ``ConfigError`` for a database that can't
    be had, and for a study of the same name with another problem.
    """
    study = stored_study(
        problem.search.name,
        storage,
        problem.digest(),
        [problem.start()],
        maximise=problem.maximise,
        asked=f"--storage: {storage}",
    )
    study.sampler = _sampler(seed, len(study.get_trials(deepcopy=False)))
    return study


def _sampler(seed: int, trials: int) -> optuna.samplers.BaseSampler:
    """Random numbers of its own for each continuation, or it would begin with the first run's choices again."""
    state = int(np.random.SeedSequence([seed, trials]).generate_state(1)[0])
    return optuna.samplers.TPESampler(seed=state, multivariate=True, constant_liar=True, n_startup_trials=20)


def search(
    study: optuna.Study,
    problem: Problem,
    trials: int,
    workers: int,
    cluster: Cluster | None = None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Add so many trials to the study. Interrupted, it keeps those that are done. One worker and one seed give the
    same trials again; with more, the order in which they finish decides.
    """
    asked: dict[int, optuna.Trial] = {}

    def choices() -> Iterator[tuple[int, dict[str, float]]]:
        for _ in range(trials):
            trial = study.ask()
            asked[trial.number] = trial
            yield trial.number, _numbers(trial, problem)

    try:
        with worker_pool(workers, cluster) as (pool, width):
            valued = as_done(pool, width, with_constant(_valued, problem), choices())
            for done, ((number, _), evaluation) in enumerate(valued, start=1):
                tell(study, asked.pop(number), evaluation)
                on_progress(done, trials)
    finally:
        for trial in asked.values():
            study.tell(trial, state=_STATE.FAIL)
            if trial.params:
                study.enqueue_trial(trial.params)  # the next run begins with what was not finished


def _valued(problem: Problem, item: tuple[int, dict[str, float]]) -> Evaluation:
    return evaluate(problem, item[1])


def _numbers(trial: optuna.Trial, problem: Problem) -> dict[str, float]:
    tried = {n.key: trial.suggest_float(n.key, n.low, n.high, log=n.log) for n in problem.search.number}
    return {key: rounded(value) for key, value in tried.items()}


def rounded(value: float) -> float:
    """To the digits that are tried."""
    return float(f"{value:.{_DIGITS - 1}e}")


def best(study: optuna.Study, problem: Problem) -> Best | None:
    """None as long as no trial keeps every constraint."""
    kept = [t for t in study.get_trials(deepcopy=False) if t.state == _STATE.COMPLETE and _keeps(t)]
    if not kept:
        return None
    chosen = (max if problem.maximise else min)(kept, key=lambda t: t.value)
    numbers = {key: rounded(value) for key, value in chosen.params.items()}
    return Best(
        chosen.number, float(chosen.value), numbers, {k: v for k, v in chosen.user_attrs.items() if k != "reason"}
    )


def _keeps(trial: Any) -> bool:
    return all(beyond <= 0.0 for beyond in trial.constraints.values())


def nearest(study: optuna.Study) -> dict[str, float]:
    """Constraints that the trial misses which misses least, and by which share of the goal; empty without a trial."""
    tried = [t for t in study.get_trials(deepcopy=False) if t.constraints]
    if not tried:
        return {}
    closest = min(tried, key=lambda t: max(t.constraints.values()))
    return {name: beyond for name, beyond in closest.constraints.items() if beyond > 0.0}


def write_controller(problem: Problem, found: Best, path: Path) -> None:
    """The controller file with the best numbers: its comments stay, and the first lines say where the numbers are
    from. Raises ``ConfigError`` where it can't be written.
    """
    document = tomlkit.parse(problem.source.read_text(encoding="utf-8"))
    for key, value in found.numbers.items():
        put(document, key, value)
    document["name"] = path.stem
    others = {name: value for name, value in found.figures.items() if name != problem.search.objective}
    figures = ", ".join(f"{name} {value:.4g}" for name, value in others.items())
    unit = "Hz" if problem.maximise else "nm"
    head = (
        f"# {problem.search.controller}, tuned by the search {problem.search.name!r} ({problem.digest()}).\n"
        f"# Trial {found.number}: {problem.search.objective} = {found.value:.4g} {unit}; {figures}.\n"
    )
    try:
        path.write_text(head + tomlkit.dumps(document), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: {reason(error)}; give another --out") from None


def importances(study: optuna.Study) -> dict[str, float]:
    """How much each number matters among the trials that keep every goal (PED-ANOVA);
    empty where fewer than four do.
    """
    if len(finished(study)) < 4:
        return {}
    evaluator = optuna.importance.PedAnovaImportanceEvaluator()
    found = optuna.importance.get_param_importances(study, evaluator=evaluator)
    return {name: float(value) for name, value in found.items()}


def finished(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    """The trials that keep every goal."""
    return [t for t in study.get_trials(deepcopy=False) if t.state == _STATE.COMPLETE]
