"""Studies from a program: identify a stage, draw plants, search weights."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from hil.lanes.lane import Lane
from hil.lanes.setup import bare_setup
from hil.runs.scenario import Scenario, load_scenario
from hil.studies.identify.identification import Identification
from hil.studies.identify.identification import identify as excite_and_fit
from hil.studies.montecarlo import Result, Results, Study, run_study, summary
from hil.studies.operating_point import operating_strokes
from hil.studies.spread.workers import cores
from hil.studies.tune.search import load_problem
from hil.studies.tune.tuning import Best, best, open_study, search, write_controller
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import ConfigError, load
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.stage import Stage

Progress = Callable[[int, int], None]
Kind = Literal["multisine", "stepped"]

AMPLITUDE_NM: dict[str, float] = {"multisine": 5.0, "stepped": 25.0}
"""Of each tone, by default: one alone may be larger than a hundred at once."""


def identify(
    *,
    stage: str = "reconstructed",
    plant: str = "nominal",
    controller: str = "lqg",
    bus: str = "fd_5k",
    lane: Lane | str = Lane.FAST,
    tones: Kind = "multisine",
    amplitude_nm: float | None = None,
    periods: int = 6,
    at_um: tuple[float, float, float] | None = None,
    seed: int = 1,
    on_progress: Progress = lambda done, total: None,
) -> Identification:
    """Excite the running loop on each axis and fit modes, gains and offsets, with standard errors.

    Configurations by name or file. ``amplitude_nm``: of each tone, by default 5 (all at once) or 25 (one after
    another); ``periods``: measured on each axis, of 1 s or 0.1 s; ``at_um``: strokes, by default mid-workspace. Raises
    ``ConfigError`` for what can't be excited, ``MeasurementError`` where the loop opens, ``FitError`` where the
    response doesn't tell the modes.
    """
    on_bus, law = load("buses", bus, BusConfig), load("controllers", controller, ControllerConfig)
    if lane == Lane.LOCKSTEP and on_bus.can is None:
        raise ConfigError(f"bus {on_bus.name!r} has no [can] and carries no frames; use --lane fast")
    if law.law == "open_loop":
        raise ConfigError(
            f"controller {law.name!r} only feeds forward: what is added to the measurement never reaches its combs; "
            "choose another --controller"
        )
    strokes = operating_strokes(Stage.load(stage), at_um)
    return excite_and_fit(
        bare_setup(stage, plant, law, on_bus, seed), strokes, Lane(lane), kind=tones,
        amplitude_m=1e-9 * (AMPLITUDE_NM[tones] if amplitude_nm is None else amplitude_nm), periods=periods,
        on_progress=on_progress,
    )  # fmt: skip


@dataclass(frozen=True)
class DrawnPlants:
    """What a law does on plants drawn from tolerances."""

    study: Study
    results: tuple[Result, ...]
    """in the order of their seeds"""

    @property
    def summary(self) -> dict[str, Any]:
        """Plain data: distributions (median, 95 %, largest), how many did not hold, the worst plant's seed."""
        return summary(self.results)

    def scenario_of(self, seed: int) -> Scenario:
        """The scenario on the plant of a seed, to be run alone; its figures come out the same, bit for bit."""
        return self.study.drawn(seed)


def montecarlo(
    scenario: Scenario | str | Path,
    *,
    plants: int = 100,
    first_seed: int = 1,
    tolerances: str = "wide",
    out: str | Path,
    workers: int | None = None,
    on_progress: Progress = lambda done, total: None,
) -> DrawnPlants:
    """Run a scenario on ``plants`` plants drawn from a tolerances file, each seeded by its own number.

    Results are kept in ``out``/results.jsonl at once: called again it goes on, also after an interruption. ``workers``:
    processes, by default as many as cores; a program that uses more than one starts under ``if __name__ ==
    "__main__":``. Raises ``ConfigError``.
    """
    loaded = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    study = Study(loaded, load("tolerances", tolerances, Tolerances))
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    results = Results(folder / "results.jsonl", study)
    seeds = range(first_seed, first_seed + plants)
    run_study(study, seeds, results, workers or cores(), None, on_progress)
    return DrawnPlants(study, tuple(results.found[seed] for seed in seeds))


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
