"""Scenarios: one file that says what is run, on what, and what it has to reach.

>>> scenario = load_scenario("raster")
>>> setup = scenario.setup()
"""

import difflib
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from pydantic import BaseModel, Field, field_validator

from hil.faults.fault import Fault
from hil.runs.correction import belongs, stored_for
from hil.runs.metrics import METRICS
from pkxyz_ctrl.config import files as config
from pkxyz_ctrl.config.bound import Bound
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import ConfigError, FrozenModel
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.config.triggers import TriggersConfig
from pkxyz_ctrl.learning import LearningConfig, LearningError
from pkxyz_ctrl.learning.learner import require_followed
from pkxyz_ctrl.learning.store import Stored
from pkxyz_ctrl.stage import Stage
from pkxyz_ctrl.trajectory import Segment, Trajectory, TrajectoryError
from pkxyz_ctrl.trajectory.check import DriveLimits, check_against, within_limits
from pkxyz_ctrl.trajectory.table import Table, in_folder
from sim.config import Device, PlantConfig

if TYPE_CHECKING:
    from hil.lanes.setup import Setup

Text = Annotated[str, Field(min_length=1)]

LEARNT_FROM = "learnt_from.json"
"""Name in a run's folder of the correction that it began with."""


_PARTS = ("stage", "plant", "controller", "bus")


class ScenarioConfig(FrozenModel):
    """A scenario file."""

    name: config.Name
    description: str = ""
    duration_s: Annotated[float, Field(gt=0, le=36_000)]
    """stage time from power-on, start-up and homing included"""
    seed: Annotated[int, Field(ge=0, lt=2**32)]
    stage: Text
    """each of these four: the name of a shipped file or a path, relative to this file's folder"""
    plant: Text
    controller: Text
    bus: Text
    reference: Annotated[tuple[Segment, ...], Field(min_length=1, max_length=10_000)]
    """starts when the controller starts to track"""
    faults: tuple[Fault, ...] = ()
    """what goes wrong, at times after the first tick"""
    clear_s: Annotated[float, Field(gt=0)] | None = None
    """how long after a fault decision somebody clears the fault; absent: nobody does"""
    learning: LearningConfig | None = None
    """for a reference that repeats; unset: nothing is learnt"""
    triggers: TriggersConfig | None = None
    """what goes to the node's digital outputs; absent: nothing"""
    checks: dict[str, Bound] = Field(default_factory=dict)

    @property
    def pixels(self) -> int | None:
        """Of each line, for triggers; None: the reference has none."""
        return None if self.triggers is None else self.triggers.pixels

    @field_validator("checks", mode="after")
    @classmethod
    def _metrics_exist(cls, checks: dict[str, Bound]) -> dict[str, Bound]:
        for name in checks:
            if name not in METRICS:
                near = difflib.get_close_matches(name, METRICS, n=1)
                hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(METRICS)}"
                raise ValueError(f"no metric is called {name!r}; {hint}")
        return checks


@dataclass(frozen=True)
class Scenario:
    """A scenario with everything that it names, read and checked."""

    source: Path
    config: ScenarioConfig
    stage: StageConfig
    device: Device
    plant: PlantConfig
    controller: ControllerConfig
    bus: BusConfig
    trajectory: Trajectory
    stored_file: Path | None = None
    """of a learnt correction that the run begins with"""
    held_in: Path | None = None
    """the folder of a run whose ``config.toml`` this is: its tables lie there"""

    def setup(self) -> "Setup":
        """What the lanes are handed."""
        from hil.lanes.setup import Setup  # brings the design tools, which a mistake in a file need not wait for

        return Setup(
            self.stage, self.device, self.plant, self.controller, self.bus, self.trajectory,
            self.config.duration_s, self.config.seed, faults=self.config.faults, clear_s=self.config.clear_s,
            learning=self.config.learning, stored=self.stored(), triggers=self.config.triggers,
        )  # fmt: skip

    def stored(self) -> Stored | None:
        """The correction that the run begins with. Raises ``LearningError`` for one that belongs to another run, or
        that would carry the scan beyond what the stage can follow.
        """
        if self.config.learning is None:
            return None
        here = belongs(self.trajectory, self.stage, self.controller, self.bus)
        stored = stored_for(self.config.learning, self.stored_file, here)
        if stored is not None:
            follows = partial(within_limits, Stage(self.stage), drive=DriveLimits.of(self.controller, self.bus))
            cutoff_hz, period_us = self.config.learning.cutoff_hz, self.bus.period_us
            try:
                require_followed(stored, cutoff_hz, self.trajectory, period_us, follows)
            except LearningError as error:
                raise LearningError(f"{self.stored_file}: {error}") from None
        return stored


def load_scenario(
    name_or_path: str | Path,
    *,
    seed: int | None = None,
    stage: str | None = None,
    plant: str | None = None,
    controller: str | None = None,
    bus: str | None = None,
    faults: Sequence[Fault] = (),
    learning: dict[str, str] | None = None,
    adapted: str | Path | None = None,
) -> Scenario:
    """Read a scenario and all that it names, with what the caller wants otherwise (paths from the
    working folder). ``faults`` come on top of the scenario's own; ``adapted`` names what an earlier run
    has learnt of the device. The ``config.toml`` of a run is a scenario, too, with all that it named inside.

    Raises ``ConfigError`` with one line for each thing that is wrong, over all the files; ``TrajectoryError``, which is
    one, for a reference that the stage can't follow.
    """
    source = config.find("scenarios", name_or_path)
    wanted = {"seed": seed, "stage": stage, "plant": plant, "controller": controller, "bus": bus}
    replaced = {key: value for key, value in wanted.items() if value is not None}
    written, held = _taken_apart(config.read_toml(source))
    data = {**written, **replaced}
    if learning is not None:
        own = data.get("learning", {})
        data["learning"] = {key: value for key, value in own.items() if key != "file"} | learning
    scenario = config.parse(data, ScenarioConfig, str(source))
    scenario = scenario.model_copy(update={"faults": (*scenario.faults, *faults)})
    loaded = _resolved(scenario, source, held, from_here=tuple(replaced), learning_from_here=learning is not None)
    if adapted is None:
        return loaded
    from hil.runs.adapted import begun_with  # which few runs need

    begun = begun_with(Path(adapted), loaded.stage, loaded.controller, loaded.bus, loaded.trajectory)
    return replace(loaded, controller=begun)


def build_scenario(data: Mapping[str, Any], folder: str | Path = ".") -> Scenario:
    """A scenario from plain data, with the keys of a scenario file; what it names is read from ``folder`` or shipped.

    >>> build_scenario({"name": "hold", "duration_s": 0.4, "seed": 1, "stage": "reconstructed", "plant": "nominal",
    ...                 "controller": "lqg", "bus": "fd_5k", "reference": [{"kind": "hold", "duration_s": 0.1}]})

    Raises as ``load_scenario`` does.
    """
    source = Path(folder) / f"{data.get('name', 'scenario')}.toml"
    return _resolved(config.parse(dict(data), ScenarioConfig, "the scenario"), source)


def _resolved(
    scenario: ScenarioConfig,
    source: Path,
    held: "_Held | None" = None,
    *,
    from_here: Sequence[str] = (),
    learning_from_here: bool = False,
) -> Scenario:
    """Read and check what a scenario names: from the folder of ``source`` or from what ``source`` holds itself, or from
    the working folder for parts that the caller wants otherwise.
    """
    parts: dict[str, Any] = {}
    models: dict[str, tuple[str, str, type[BaseModel]]] = {
        "stage": ("stages", scenario.stage, StageConfig),
        "device": ("stages", scenario.stage, Device),
        "plant": ("plants", scenario.plant, PlantConfig),
        "controller": ("controllers", scenario.controller, ControllerConfig),
        "bus": ("buses", scenario.bus, BusConfig),
    }
    problems: list[str] = []
    for key, (kind, name, model) in models.items():
        named = "stage" if key == "device" else key
        try:
            if held is not None and named not in from_here:
                parts[key] = config.parse(held.parts[named], model, f"{source}: {named}")
            else:
                parts[key] = _part(kind, name, model, Path() if named in from_here else source.parent)
        except ConfigError as error:
            problems += str(error).splitlines()
    if problems:
        raise ConfigError("\n".join(dict.fromkeys(problems)))
    try:
        if held is None:
            trajectory = Trajectory(in_folder(scenario.reference, source.parent), scenario.pixels)
            _check_duration(source, scenario, trajectory)  # first: to look at each instant of ten hours takes minutes
        else:
            trajectory = _held_trajectory(
                scenario, source.parent, held.sha256
            )  # its run may have been shorter, on purpose
        check_against(Stage(parts["stage"]), trajectory, DriveLimits.of(parts["controller"], parts["bus"]))
    except TrajectoryError as error:
        raise TrajectoryError(f"{source}: {error}") from None
    file = scenario.learning.file if scenario.learning is not None else None
    stored_file = None if file is None else (Path() if learning_from_here else source.parent) / file
    held_in = None if held is None else source.parent
    loaded = Scenario(source, scenario, trajectory=trajectory, stored_file=stored_file, held_in=held_in, **parts)
    loaded.stored()
    return loaded


class _Held(NamedTuple):
    """What the ``config.toml`` of a run holds besides the keys of a scenario file."""

    parts: dict[str, dict[str, Any]]
    """in place of names"""
    sha256: dict[str, str]
    """of the tables in its folder"""


def _taken_apart(data: dict[str, Any]) -> tuple[dict[str, Any], _Held | None]:
    """The keys of a scenario file, and what else a run's ``config.toml`` holds; None for a scenario file."""
    inside = {key: data[key] for key in _PARTS if isinstance(data.get(key), dict)}
    if len(inside) < len(_PARTS):
        return data, None
    own = {key: value for key, value in data.items() if key not in ("sha256", "digest")}
    names = {key: str(part.get("name", key)) for key, part in inside.items()}
    sha256 = data.get("sha256")
    return own | names, _Held(inside, sha256 if isinstance(sha256, dict) else {})


def _held_trajectory(scenario: ScenarioConfig, folder: Path, sha256: dict[str, str]) -> Trajectory:
    """The reference of a run from its folder. Raises ``ConfigError`` for a table that is not the one of then."""
    held = [
        segment.model_copy(update={"file": table_name(n)}) if isinstance(segment, Table) else segment
        for n, segment in enumerate(scenario.reference)
    ]
    trajectory = Trajectory(in_folder(held, folder), scenario.pixels)
    for n, segment in enumerate(trajectory.segments):
        if segment.source_sha256 != sha256.get(f"reference.{n}"):
            raise ConfigError(f"{folder}: reference.{n}: its table is not the one of the run")
    return trajectory


def _part(kind: str, name_or_path: str, model: type[BaseModel], folder: Path) -> BaseModel:
    """One file that a scenario names; a path is taken from ``folder``."""
    is_path = name_or_path.endswith(".toml") or "/" in name_or_path
    path = config.find(kind, folder / name_or_path if is_path else name_or_path)
    return config.parse(config.read_toml(path), model, str(path))


def resolve(scenario: Scenario) -> dict[str, Any]:
    """Everything that decides about the run as plain data, files inlined, with its ``digest``."""
    data = config.plain(scenario.config)
    for key in ("stage", "plant", "controller", "bus"):
        data[key] = config.plain(getattr(scenario, key))
    tables = {f"reference.{n}": s.source_sha256 for n, s in enumerate(scenario.trajectory.segments) if s.source_sha256}
    if scenario.stored_file is not None:
        data["learning"]["file"] = LEARNT_FROM
        tables["learning"] = hashlib.sha256(scenario.stored_file.read_bytes()).hexdigest()
    if tables:
        data["sha256"] = tables
    return {**data, "digest": config.digest(data)}


def table_name(n: int) -> str:
    """What the file of table ``reference.n`` is called in a run's folder."""
    return f"reference.{n}.csv"


def tables(scenario: Scenario) -> dict[str, Path]:
    """The files that the reference and its correction are read from, by their names in a run's folder."""
    learnt = {} if scenario.stored_file is None else {LEARNT_FROM: scenario.stored_file}
    held, beside = scenario.held_in, scenario.source.parent
    return learnt | {
        table_name(n): beside / s.file if held is None else held / table_name(n)
        for n, s in enumerate(scenario.config.reference)
        if isinstance(s, Table)
    }


def restore(resolved: dict[str, Any], folder: Path) -> Scenario:
    """The scenario that ``resolve`` was given, from its plain data; ``folder`` is that of the run.

    Raises ``ConfigError`` for data of another version of this program, and for a table that is not the one of then.
    """
    source = str(folder)
    written, held = _taken_apart(resolved)
    if held is None:
        raise ConfigError(f"{source}: is not the configuration of a run: it lacks its {', '.join(_PARTS)}")
    scenario = config.parse(written, ScenarioConfig, source)
    models: dict[str, type[BaseModel]] = {
        "stage": StageConfig, "plant": PlantConfig, "controller": ControllerConfig, "bus": BusConfig,
    }  # fmt: skip
    parts: dict[str, Any] = {key: config.parse(held.parts[key], model, source) for key, model in models.items()}
    trajectory = _held_trajectory(scenario, folder, held.sha256)
    device = config.parse(held.parts["stage"], Device, source)
    begins_with = folder / LEARNT_FROM if scenario.learning is not None and scenario.learning.file else None
    return Scenario(
        folder, scenario, device=device, trajectory=trajectory, stored_file=begins_with, held_in=folder, **parts
    )


def _check_duration(source: Path, scenario: ScenarioConfig, trajectory: Trajectory) -> None:
    if trajectory.duration_us * 1e-6 > scenario.duration_s:
        raise ConfigError(
            f"{source}: duration_s: {scenario.duration_s:g} s are over before the reference, which alone takes "
            f"{trajectory.duration_us * 1e-6:.4g} s; give more, start-up included, or a shorter reference"
        )
