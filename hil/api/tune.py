"""Search for the weights of a law."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from hil.studies.spread.workers import cores
from hil.studies.tune.search import load_problem
from hil.studies.tune.tuning import Best, best, open_study, search, write_controller

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Tuned:
    """The best numbers that a search has found so far."""

    best: Best | None
    """None: none of those that were tried keeps every constraint"""
    controller: Path | None
    """the controller file with them, which runs"""


def tune(
    search_file: str | Path,
    *,
    trials: int = 100,
    out: str | Path = "tuned",
    workers: int | None = None,
    seed: int = 1,
    on_progress: Progress = lambda done, total: None,
) -> Tuned:
    """Add trials to a search for a law's weights, with margins as constraints, and write the best controller file.

    ``search_file``: a shipped search's name or a TOML file. The study is kept in ``out``/study.db: called again it goes
    on. Raises ``ConfigError``.
    """
    problem = load_problem(str(search_file))
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    study = open_study(problem, f"sqlite:///{(folder / 'study.db').absolute()}", seed)
    search(study, problem, trials, workers or cores(), None, on_progress)
    found = best(study, problem)
    if found is None:
        return Tuned(None, None)
    path = folder / f"{problem.search.name}_tuned.toml"
    write_controller(problem, found, path)
    return Tuned(found, path)
