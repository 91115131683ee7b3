"""A law against plants that were sampled from tolerances: one closed-loop run and one Ms each, kept line by line.

Plant n is sampled by seed n, which also seeds its noise, so any of them runs again alone and gives the same bits.
"""

import dataclasses
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hil.lanes import in_process as lanes
from hil.lanes.lane import Lane
from hil.runs.metrics import Metrics
from hil.runs.scenario import Scenario, resolve
from hil.studies.margins.loop import Loop
from hil.studies.spread.cluster import Cluster
from hil.studies.spread.workers import as_done, with_constant, worker_pool
from pkxyz_ctrl.config import files as config
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.config.refused import reason
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.design.model.loop_plant import Perturbation
from pkxyz_ctrl.stage import Stage
from sim.config import PlantConfig

FIGURES = {"rms_error_nm": "nm", "hold_noise_nm": "nm", "peak_s": ""}
"""Figures of a plant that distributions are shown of, with their units. Of axes, the worst one."""


@dataclass(frozen=True)
class Study:
    """What is run."""

    scenario: Scenario
    tolerances: Tolerances

    def digest(self) -> str:
        """Of all that decides about a result, seed and count apart."""
        data = resolve(self.scenario)
        return config.digest({"scenario": data, "tolerances": config.plain(self.tolerances)})

    def sampled(self, seed: int) -> Scenario:
        """The scenario on the plant of a seed."""
        case = self.tolerances.sample(seed)
        return replace(
            self.scenario,
            config=self.scenario.config.model_copy(update={"seed": seed}),
            plant=changed_plant(self.scenario.plant, case.perturbation),
        )


def changed_plant(plant: PlantConfig, change: Perturbation) -> PlantConfig:
    """The software plant with the perturbation of the linear one, in place of its own errors of these kinds.

    A delay is the sense chain's; nothing can be seen before it happens, so one below 0 is none. Of parasitic modes the
    first is simulated, one way, on a plant without ``flexible_modes`` of its own; the others count in Ms alone. A sense
    chain whose noise passes its filter keeps that filter.
    """
    data = plant.model_dump()
    chains = (change.stiffness,) * 3
    data["stiffness_mismatch"] |= {"on": True, "leaf": chains, "crank_hinge": chains, "link_hinge": chains}
    data["mass_error"] |= {"on": True, "relative": change.mass}
    data["comb_mismatch"] |= {"on": True, "relative": change.comb_gain}
    if change.quality_factor is not None:
        data["damping"] |= {"on": True, "quality_factor": change.quality_factor}
    if change.delay_s > 0.0:
        own_s = plant.sense_delay.delay_s if plant.sense_delay.on else 0.0
        data["sense_delay"] |= {"on": True, "delay_s": own_s + change.delay_s}
    data["amplifier_bandwidth"]["corner_hz"] *= 1.0 + change.amplifier_bandwidth
    if change.sense_bandwidth_hz is not None and plant.sense_noise.sampled == "per_sample":
        data["sense_bandwidth"] |= {"on": True, "corner_hz": change.sense_bandwidth_hz}
    if change.parasitic and not plant.flexible_modes.on:
        data["parasitic"] |= {"on": True} | dataclasses.asdict(change.parasitic[0])
    return PlantConfig.model_validate(data)


@dataclass(frozen=True)
class Result:
    """Of one plant. A figure is None where the run ended in a fault, or where the loop is unstable (peak_s)."""

    seed: int
    rms_error_nm: float | None
    hold_noise_nm: float | None
    peak_s: float | None
    saturated_ticks: int
    fault: str | None

    @property
    def ok(self) -> bool:
        """Whether the loop held."""
        return self.fault is None and self.peak_s is not None


def run_one(study: Study, seed: int) -> Result:
    """Run the plant of a seed on the fast lane; its Ms is that of the linear loop at the point that was sampled."""
    scenario = study.sampled(seed)
    setup = scenario.setup()
    metrics = Metrics(setup.trajectory, setup.bus.period_us)
    result = lanes.run(setup, Lane.FAST, on_block=metrics.update)
    figures = metrics.figures()
    case = study.tolerances.sample(seed)
    peak = Loop(Stage(setup.stage), setup.bus, setup.law).peak_sensitivity(case)

    def worst(values: Mapping[str, float] | None) -> float | None:
        return None if values is None or result.faults else max(values.values())

    return Result(
        seed,
        worst(figures.rms_error_nm),
        worst(figures.hold_noise_nm),
        peak if math.isfinite(peak) else None,
        figures.saturated_ticks,
        result.faults[0] if result.faults else None,
    )


class Results:
    """The file of results: a line of JSON for each plant, after one that says what study it is."""

    def __init__(self, path: Path, study: Study) -> None:
        """Read what is there. Raises ``ConfigError`` for another study's file; a line cut off at the end is dropped."""
        self._path = path
        self.found: dict[int, Result] = {}
        head = {"digest": study.digest(), "scenario": study.scenario.config.name, "tolerances": study.tolerances.name}
        try:
            lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if path.exists() else []
            complete = [line for line in lines if line.endswith("\n")]
            if complete and json.loads(complete[0]).get("digest") != head["digest"]:
                raise ConfigError(
                    f"{path}: holds results of another study (a file of it has changed since); give another --out"
                )
            for line in complete[1:]:
                result = Result(**json.loads(line))
                self.found[result.seed] = result
            path.write_text("".join(complete) or json.dumps(head) + "\n", encoding="utf-8")
        except (ValueError, TypeError, AttributeError) as error:
            if isinstance(error, ConfigError):
                raise
            raise ConfigError(f"{path}: is not a file of results: {error}; give another --out") from None
        except OSError as error:
            raise ConfigError(f"{path}: {reason(error)}; give another --out") from None

    def add(self, result: Result) -> None:
        """Keep a result, at once."""
        self.found[result.seed] = result
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(vars(result), allow_nan=False) + "\n")


def run_study(
    study: Study,
    seeds: Sequence[int],
    results: Results,
    workers: int,
    cluster: Cluster | None = None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Run the seeds that have no result yet. Interrupted, it keeps those that are done."""
    left = [seed for seed in seeds if seed not in results.found]
    done = len(seeds) - len(left)
    on_progress(done, len(seeds))
    if not left:
        return
    with worker_pool(workers, cluster) as (pool, width):
        for n, (_, result) in enumerate(_all_done(pool, width, study, left), start=1):
            results.add(result)
            on_progress(done + n, len(seeds))


def _all_done(pool: Any, width: int, study: Study, seeds: list[int]) -> Iterator[tuple[int, Result]]:
    return as_done(pool, width, with_constant(run_one, study), seeds, ahead=width)


def summary(results: Sequence[Result]) -> dict[str, Any]:
    """Distributions (median, 95 %, largest), how many loops did not hold, and the worst plant's seed: one that did not
    hold if there is one, else that with the largest error.
    """
    found: dict[str, Any] = {"plants": len(results), "not_held": sum(not r.ok for r in results)}
    for name in FIGURES:
        values = np.array([v for r in results if (v := getattr(r, name)) is not None], dtype=np.float64)
        found[name] = (
            {
                "median": float(np.median(values)),
                "p95": float(np.percentile(values, 95)),
                "max": float(values.max()),
                "max_seed": next(r.seed for r in results if getattr(r, name) == values.max()),
            }
            if len(values)
            else None
        )
    return found | {"worst_seed": worst(results).seed}


def worst(results: Sequence[Result]) -> Result:
    """The plant to look at first."""
    return max(results, key=lambda r: (r.fault is not None, r.peak_s is None, r.rms_error_nm or 0.0, -r.seed))
