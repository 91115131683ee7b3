"""Search for the weights of a law, or for the taps of its filter."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import optuna

from hil.studies.spread.cluster import cluster_at
from hil.studies.spread.trials import judged
from hil.studies.tune.search import Problem, load_problem
from hil.studies.tune.taps import FoundTaps, TapsSearch, asks_for_taps, find_taps, write_taps
from hil.studies.tune.tuning import Best, best, importances, nearest, open_study, search, write_controller
from pkxyz_ctrl.config.files import ConfigError, load
from pkxyz_ctrl.io.realtime import cores

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Tuned:
    """The best numbers that a search has found so far."""

    best: Best | None
    """None: none of those that were tried keeps every constraint"""
    controller: Path | None
    """the controller file with them, which runs"""
    problem: Problem
    """what was asked"""
    study: optuna.Study
    """all that was tried"""
    interrupted: bool = False
    """ended early by Ctrl-C: what was done is kept"""

    @property
    def trials(self) -> int:
        """Trials of the study that have been judged."""
        return len(judged(self.study))

    @property
    def missed(self) -> dict[str, float]:
        """By what share the nearest trial misses each constraint; empty once one keeps them all."""
        return {} if self.best is not None else nearest(self.study)

    @cached_property
    def importance(self) -> dict[str, float]:
        """How much each number matters, 0 to 1; empty for few trials."""
        return importances(self.study)


@dataclass(frozen=True)
class TunedTaps:
    """The taps of a filter, for which nothing had to be tried."""

    search: str
    found: FoundTaps
    controller: Path
    """the controller file with them, which runs"""


def tune(
    search_file: str | Path,
    *,
    trials: int = 100,
    out: str | Path = "tuned",
    workers: int | None = None,
    seed: int = 1,
    cluster: str | None = None,
    cluster_tls: str | Path | None = None,
    storage: str | None = None,
    on_progress: Progress = lambda done, total: None,
) -> Tuned:
    """Add trials to a search for a law's weights, with margins as constraints, and write the best controller file.

    ``search_file``: a shipped search's name or a TOML file. The study is kept in ``out``/study.db, or the database at
    the URL ``storage``: called again it goes on. ``workers``: processes, by default as many as cores; ``cluster``:
    address of a scheduler to work on instead; ``cluster_tls``: folder of its certificates, as ``cluster_at`` wants.
    Raises ``ConfigError``, also for a search of taps.
    """
    spread = cluster_at(cluster, cluster_tls)
    if asks_for_taps(str(search_file)):
        raise ConfigError(f"{search_file}: asks for taps, which are found at once, without trials: hil.tune_taps")
    problem = load_problem(str(search_file))
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    study = open_study(problem, storage or f"sqlite:///{(folder / 'study.db').absolute()}", seed)
    interrupted = False
    if trials:
        try:
            search(study, problem, trials, workers or cores(), spread, on_progress)
        except KeyboardInterrupt:
            interrupted = True
    found = best(study, problem)
    path = None if found is None else folder / f"{problem.search.name}_tuned.toml"
    if found is not None and path is not None:
        write_controller(problem, found, path)
    return Tuned(found, path, problem, study, interrupted)


def tune_taps(
    search_file: str | Path,
    *,
    stage: str | None = None,
    out: str | Path = "tuned",
    on_progress: Callable[[str], None] = lambda line: None,
) -> TunedTaps:
    """Find the taps of the law youla that a search asks for, a convex problem, and write the controller file.

    ``stage``: name or file in place of the search's own, one that an identification wrote, say. Raises ``ConfigError``.
    """
    asked = load("searches", search_file, TapsSearch)
    if stage is not None:
        asked = asked.model_copy(update={"stage": stage})
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    found = find_taps(asked, on_progress=on_progress)
    path = folder / f"{asked.name}_tuned.toml"
    write_taps(asked, found, path)
    return TunedTaps(asked.name, found, path)
