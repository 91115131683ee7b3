"""Sample plants from tolerances and run a law on each."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil.runs.scenario import Scenario, load_scenario
from hil.studies.montecarlo import Result, Results, Study, run_study, summary
from hil.studies.spread.cluster import cluster_at
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.io.realtime import cores

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SampledPlants:
    """What a law does on plants sampled from tolerances."""

    study: Study
    results: tuple[Result, ...]
    """in the order of their seeds"""
    interrupted: bool = False
    """ended early by Ctrl-C: these are what was done"""

    @property
    def summary(self) -> dict[str, Any]:
        """Plain data: distributions (median, 95 %, largest), how many did not hold, the worst plant's seed."""
        return summary(self.results)

    def scenario_of(self, seed: int) -> Scenario:
        """The scenario on the plant of a seed, to be run alone; its figures come out the same, bit for bit."""
        return self.study.sampled(seed)


def montecarlo(
    scenario: Scenario | str | Path,
    *,
    plants: int = 100,
    first_seed: int = 1,
    tolerances: str = "wide",
    out: str | Path,
    workers: int | None = None,
    cluster: str | None = None,
    cluster_tls: str | Path | None = None,
    on_progress: Progress = lambda done, total: None,
) -> SampledPlants:
    """Run a scenario on ``plants`` plants sampled from a tolerances file, each seeded by its own number.

    Results are kept in ``out``/results.jsonl at once: called again it goes on, also after an interruption, which is
    passed on only where nothing is done yet. ``workers``: processes, by default as many as cores; a program that uses
    more than one starts under ``if __name__ == "__main__":``. ``cluster``: address of a cluster's scheduler to work on
    instead; ``cluster_tls``: folder of its certificates, as ``cluster_at`` wants them. Raises ``ConfigError``.
    """
    spread = cluster_at(cluster, cluster_tls)
    loaded = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    study = Study(loaded, load("tolerances", tolerances, Tolerances))
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    results = Results(folder / "results.jsonl", study)
    seeds, interrupted = range(first_seed, first_seed + plants), False
    try:
        run_study(study, seeds, results, workers or cores(), spread, on_progress)
    except KeyboardInterrupt:
        interrupted = True
    found = tuple(results.found[seed] for seed in seeds if seed in results.found)
    if not found and interrupted:
        raise KeyboardInterrupt
    return SampledPlants(study, found, interrupted)
