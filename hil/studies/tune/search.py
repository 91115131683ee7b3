"""What a tuning searches, as data, and how one choice of numbers is valued: margins first, runs only if they hold.

>>> problem = load_problem("lqg")
>>> evaluate(problem, {"regulator.force_n": 1e-6, ...})
"""

import copy
import math
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from pkxyz_ctrl.config import files as config
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import ConfigError, FrozenModel
from pkxyz_ctrl.design.hold_noise import hold_noise_m
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.law_about import law_about, law_in_parts
from pkxyz_ctrl.design.margins.margins import margins, peak_sensitivity
from pkxyz_ctrl.design.margins.tolerances import Case, Tolerances
from pkxyz_ctrl.design.model.design_error import DesignError
from pkxyz_ctrl.design.model.discrete_law import LawError
from pkxyz_ctrl.design.model.loop_plant import loop_plant
from pkxyz_ctrl.stage import Stage

if TYPE_CHECKING:
    from hil.lanes.setup import Setup

Text = Annotated[str, Field(min_length=1)]
Positive = Annotated[float, Field(gt=0)]

UNUSABLE = 1e3
"""Value of every constraint, in multiples of its limit, for numbers with which there is no stable loop."""


class Number(FrozenModel):
    """One number of a controller file that may be changed."""

    key: Text
    """path in the file, as in ``regulator.force_n``"""
    low: float
    high: float
    log: bool = False

    @model_validator(mode="after")
    def _a_range(self) -> Self:
        if self.low >= self.high:
            raise ValueError("low must be below high")
        if self.log and self.low <= 0.0:
            raise ValueError("a search by ratio (log) needs a low above 0")
        return self


class Goals(FrozenModel):
    """Constraints: of the nominal plant at mid-workspace as a MIMO system, and of the changed plants."""

    peak_s_max: Positive
    disk_margin_min: Positive
    bandwidth_min_hz: Positive
    hold_noise_max_nm: Positive
    peak_s_changed_max: Positive


class SearchConfig(FrozenModel):
    """A file of configs/searches."""

    name: config.Name
    controller: Text
    stage: Text
    bus: Text
    tolerances: Text
    scenario: Text
    plants: Annotated[tuple[Text, ...], Field(min_length=1)]
    points: Literal["middle", "all"] = "middle"
    """where the changed plants are looked at: at mid-workspace, or, where all goals are kept there, at every point"""
    objective: Literal["rms_error_nm", "bandwidth_hz"]
    """rms_error_nm: least error, worst axis, mean over the plants, by runs; bandwidth_hz: widest, without a run"""
    goals: Goals
    number: Annotated[tuple[Number, ...], Field(min_length=1)]


@dataclass(frozen=True)
class Problem:
    """A search with the controller file that it starts from, as plain data."""

    search: SearchConfig
    source: Path
    """of the controller file"""
    controller: dict[str, Any]

    @property
    def maximise(self) -> bool:
        """Whether more is better."""
        return self.search.objective == "bandwidth_hz"

    def with_numbers(self, numbers: dict[str, float]) -> ControllerConfig:
        """The controller with other numbers. Raises ``ConfigError`` for what it refuses."""
        data = copy.deepcopy(self.controller)
        for key, value in numbers.items():
            put(data, key, value)
        return config.parse(data, ControllerConfig, str(self.source))

    def start(self) -> dict[str, float]:
        """The numbers that the controller file has, those within their ranges."""
        found = {number.key: float(_at(self.controller, number.key)) for number in self.search.number}
        return {n.key: found[n.key] for n in self.search.number if n.low <= found[n.key] <= n.high}

    def digest(self) -> str:
        """Of all that decides about the value of numbers: a study may only be continued by its own problem."""
        search = config.plain(self.search)
        parts = {
            kind: config.read_toml(config.find(kind, name))
            for kind, name in (
                ("stages", self.search.stage), ("buses", self.search.bus), ("tolerances", self.search.tolerances),
                ("scenarios", self.search.scenario),
            )
        }  # fmt: skip
        plants = {name: config.read_toml(config.find("plants", name)) for name in self.search.plants}
        return config.digest({"search": search, "controller": self.controller, **parts, "plant": plants})


@dataclass(frozen=True)
class Evaluation:
    """How good numbers are. Constraints are kept where they are 0 or less; without a value nothing was run."""

    constraints: dict[str, float]
    """each how far beyond its goal, as a share of the goal"""
    figures: dict[str, float]
    value: float | None
    reason: str = ""
    """why there is no value"""


def load_problem(name_or_path: str | Path) -> Problem:
    """Read a search and its controller; raises ``ConfigError``, also for keys that the controller doesn't have."""
    search = config.load("searches", name_or_path, SearchConfig)
    source = config.find("controllers", search.controller)
    problem = Problem(search, source, config.read_toml(source))
    for number in search.number:
        _at(problem.controller, number.key)
    problem.with_numbers({})
    return problem


def _at(data: dict[str, Any], key: str) -> Any:
    here: Any = data
    for part in key.split("."):
        if not isinstance(here, dict) or part not in here:
            known = ", ".join(here) if isinstance(here, dict) else "nothing below it"
            raise ConfigError(f"number: the controller file has no {key!r}; at {part!r} it has: {known}")
        here = here[part]
    if isinstance(here, bool) or not isinstance(here, int | float):
        raise ConfigError(f"number: {key!r} of the controller file is not a number")
    return here


def put(data: Any, key: str, value: float) -> None:
    """Replace the number at a path, in plain data or in a document of tomlkit."""
    *parents, last = key.split(".")
    for part in parents:
        data = data[part]
    data[last] = value


def evaluate(problem: Problem, numbers: dict[str, float]) -> Evaluation:
    """Margins and noise, and, where they keep the goals, the objective."""
    search = problem.search
    stage, bus = Stage.load(search.stage), config.load("buses", search.bus, BusConfig)
    try:
        controller = problem.with_numbers(numbers)
        evaluation = _computed(search, stage, bus, controller)
    except (ConfigError, DesignError, LawError) as error:
        return Evaluation(dict.fromkeys(Goals.model_fields, UNUSABLE), {}, None, str(error))
    missed = [name for name, value in evaluation.constraints.items() if value > 0.0]
    if missed:
        return Evaluation(evaluation.constraints, evaluation.figures, None, f"misses {', '.join(missed)}")
    if search.objective == "bandwidth_hz":
        return Evaluation(evaluation.constraints, evaluation.figures, evaluation.figures["bandwidth_hz"])
    errors = [_run(search, controller, plant) for plant in search.plants]
    if any(math.isnan(error) for error in errors):
        return Evaluation(evaluation.constraints, evaluation.figures, None, "a run ended in a fault")
    return Evaluation(evaluation.constraints, evaluation.figures, float(np.mean(errors)))


def _computed(search: SearchConfig, stage: Stage, bus: BusConfig, controller: ControllerConfig) -> Evaluation:
    """Without a run. The cheap ones first: what is unstable as drawn is not looked at any further."""
    tolerances = config.load("tolerances", search.tolerances, Tolerances)
    law = design_law(stage, controller, bus, autostart=True)
    middle, goals = tolerances.points_m()["middle"], search.goals
    plant, about = loop_plant(stage, bus, middle), law_about(stage, law, middle)
    found = margins(plant, about)
    if not found.stable:
        raise LawError("unstable as drawn")
    noise_nm = 1e9 * float(hold_noise_m(stage, bus, plant, about, noise_shaping=controller.limits.noise_shaping).max())

    def largest_peak(cases: list[Case]) -> float:
        return max(
            peak_sensitivity(
                loop_plant(stage, bus, case.strokes_m, case.perturbation),
                law_in_parts(stage, law, case.strokes_m, case.perturbation),
            )
            for case in cases
        )

    cases = tolerances.cases()
    here = [case for case in cases if np.array_equal(case.strokes_m, middle)]
    figures = {
        "peak_s": found.mimo.peak_s, "disk_margin": found.mimo.disk_margin, "bandwidth_hz": found.mimo.bandwidth_hz,
        "hold_noise_nm": noise_nm, "peak_s_changed": largest_peak(here),
    }  # fmt: skip
    beyond = _beyond(goals, figures)
    if search.points == "all" and max(beyond.values()) <= 0.0:
        rest = [case for case in cases if not np.array_equal(case.strokes_m, middle)]
        figures["peak_s_changed"] = max(figures["peak_s_changed"], largest_peak(rest))
        beyond = _beyond(goals, figures)
    return Evaluation(beyond, figures, None)


def _beyond(goals: Goals, figures: dict[str, float]) -> dict[str, float]:
    """How far each goal is missed, as a share of it; 0 or less where it is kept."""
    beyond = {
        "peak_s_max": figures["peak_s"] / goals.peak_s_max - 1.0,
        "disk_margin_min": 1.0 - figures["disk_margin"] / goals.disk_margin_min,
        "bandwidth_min_hz": 1.0 - figures["bandwidth_hz"] / goals.bandwidth_min_hz,
        "hold_noise_max_nm": figures["hold_noise_nm"] / goals.hold_noise_max_nm - 1.0,
        "peak_s_changed_max": figures["peak_s_changed"] / goals.peak_s_changed_max - 1.0,
    }
    return {name: min(value, UNUSABLE) for name, value in beyond.items()}


def _run(search: SearchConfig, controller: ControllerConfig, plant: str) -> float:
    """RMS error in nm of the worst axis while scanning; NaN after a fault."""
    from hil.lanes import in_process as lanes
    from hil.lanes.lane import Lane
    from hil.runs.metrics import Metrics

    setup = replace(_setup(search.scenario, search.stage, plant, search.bus), controller=controller)
    metrics = Metrics(setup.trajectory, setup.bus.period_us)
    result = lanes.run(setup, Lane.FAST, on_block=metrics.update)
    error = metrics.figures().rms_error_nm
    return math.nan if result.faults or error is None else max(error.values())


@cache
def _setup(scenario: str, stage: str, plant: str, bus: str) -> "Setup":
    """Read and checked once in a process; trials differ by their controller."""
    from hil.runs.scenario import load_scenario

    return load_scenario(scenario, stage=stage, plant=plant, bus=bus).setup()
