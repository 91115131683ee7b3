"""A law against plants that were sampled from tolerances: one closed-loop run and one Ms each, kept line by line.

Plant n is sampled by seed n, which also seeds its noise, so any of them runs again alone and gives the same bits.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
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
from hil.studies.spread.kept import Kept
from hil.studies.spread.missing import work_out_missing
from pkxyz_ctrl.config import files as config
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.design.model.loop_plant import Perturbation
from pkxyz_ctrl.stage import Stage
from sim.config import PlantConfig

FIGURES = {"rms_error_nm": "nm", "hold_noise_nm": "nm", "peak_s": ""}
"""Figures of a plant that distributions are shown of, with their units. Of axes, the worst one."""

PLANTS_AT_ONCE = 64
"""That a worker is handed, at most: a second of work."""


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


class Results(Kept[int, Result]):
    """The file of results, by the plants' seeds."""

    def __init__(self, path: Path, study: Study) -> None:
        """Raises ``ConfigError``, as ``Kept`` does."""
        head = {"digest": study.digest(), "scenario": study.scenario.config.name, "tolerances": study.tolerances.name}
        super().__init__(path, head, lambda result: result.seed, lambda data: Result(**data), vars)


def run_study(
    study: Study,
    seeds: Sequence[int],
    results: Results,
    workers: int,
    cluster: Cluster | None = None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Run the seeds that have no result yet. Interrupted, it keeps those that are done."""
    work_out_missing(run_one, study, seeds, results, workers, cluster, on_progress, at_once=PLANTS_AT_ONCE)


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
