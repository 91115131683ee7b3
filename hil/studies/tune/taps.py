"""A search for the taps of the Youla filter: what is asked, as data, the plants that
follow from it, and the file that comes out.

It is convex, so there is nothing to try: no trials, no database, the same taps every time.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tomlkit
from numpy.typing import NDArray
from pydantic import Field

from pkxyz_ctrl.config import files as config
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import ConfigError, FrozenModel
from pkxyz_ctrl.config.laws import Youla
from pkxyz_ctrl.config.refused import reason
from pkxyz_ctrl.design.hold_noise import rounding_force_n
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.laws.estimator_gain import measurement_noise, shaken_covariance
from pkxyz_ctrl.design.laws.youla import Bounds, InnovationLoop, Noise, youla_taps
from pkxyz_ctrl.design.lqg_equivalent import lqg_equivalent, seen_by
from pkxyz_ctrl.design.margins.margins import HALF_POWER
from pkxyz_ctrl.design.margins.tolerances import Case, Tolerances
from pkxyz_ctrl.design.model.discrete_law import LawError
from pkxyz_ctrl.design.model.loop_plant import NOMINAL, loop_plant
from pkxyz_ctrl.design.model.plant_model import LinearStage, linearise
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]
Text = Annotated[str, Field(min_length=1)]
Positive = Annotated[float, Field(gt=0)]

_DIGITS = 7
"""Significant digits of a tap in the file."""
_EDGE = 0.99 * HALF_POWER
"""|S| at the edge: a little below half the power, as the bound falls from there on."""


class TapBounds(FrozenModel):
    """What is asked of each axis."""

    edge_hz: Positive
    """|S| stays below half the power up to here, as drawn ..."""
    slope: Annotated[float, Field(ge=0, le=1)]
    """... and falls below with this power of the frequency"""
    reject_db: tuple[tuple[Positive, Positive], ...] = ()
    """besides, as drawn: [frequency in Hz, by how many dB a disturbance there is weaker than without feedback]"""
    peak_s_max: Annotated[float, Field(gt=1)]
    disk_margin_min: Annotated[float, Field(gt=0, lt=2)]
    effort_max: Positive
    """largest |K S| over the stage's stiffness, as drawn"""
    peak_s_changed_max: Annotated[float, Field(gt=1)]
    """|S| of the plants that have one thing changed"""
    peak_s_combined_max: Annotated[float, Field(gt=1)]
    """... and of those that have all changed at once"""


class QuietBounds(TapBounds):
    """What is asked of each axis in a quiet hold."""

    base_noise_m_per_s2_per_rt_hz: Positive
    """white acceleration of the base, one-sided density: what it leaves at hold counts beside the sense noise"""


class TapsSearch(FrozenModel):
    """A file of configs/searches that asks for taps."""

    name: Text
    controller: Text
    stage: Text
    bus: Text
    tolerances: Text
    taps: Annotated[int, Field(ge=2, le=40)]
    across: Annotated[int, Field(ge=2)] = 9
    """devices from soft and heavy to stiff and light that have all changed at once"""
    bounds: TapBounds
    quiet: QuietBounds | None = None
    """of a filter for quiet holds, if there is to be one"""


@dataclass(frozen=True)
class FoundTaps:
    """Taps (n,) in N/m of x and y, and of z, and the deviation of a held position in m that they leave, as drawn."""

    plane: tuple[float, ...]
    z: tuple[float, ...]
    hold_noise_m: tuple[float, float]
    quiet: "FoundTaps | None" = None
    """of quiet holds"""


def asks_for_taps(name_or_path: str | Path) -> bool:
    """Whether this search file is one of these. Raises ``ConfigError`` for a file that can't be read."""
    return "taps" in config.read_toml(config.find("searches", name_or_path))


def find_taps(search: TapsSearch, on_progress: Callable[[str], None] = lambda line: None) -> FoundTaps:
    """Taps for the stage, bus and tolerances of a search. Raises ``ConfigError`` where there are none."""
    quiet = None if search.quiet is None else _within(search, search.quiet, ", quiet", on_progress)
    return replace(_within(search, search.bounds, "", on_progress), quiet=quiet)


def _within(search: TapsSearch, asked: TapBounds, which: str, on_progress: Callable[[str], None]) -> FoundTaps:
    axes = {}
    for axis, name in ((0, f"x and y{which}"), (2, f"z{which}")):
        try:
            axes[axis] = find_axis_taps(search, asked, axis, lambda line, name=name: on_progress(f"{name}: {line}"))  # type: ignore[misc]
        except LawError as error:
            raise ConfigError(f"search {search.name!r}: {name}: {error}") from error
    return FoundTaps(_rounded(axes[0][0]), _rounded(axes[2][0]), (axes[0][1], axes[2][1]))


def find_axis_taps(
    search: TapsSearch, asked: TapBounds, axis: int, on_progress: Callable[[str], None]
) -> tuple[Array, float]:
    """Taps (n,) in N/m of an axis within bounds of its own, and the deviation at hold in m. Raises ``LawError`` where
    there are none.
    """
    stage, bus = Stage.load(search.stage), config.load("buses", search.bus, BusConfig)
    controller = config.load("controllers", search.controller, ControllerConfig)
    tolerances = config.load("tolerances", search.tolerances, Tolerances)
    alone = design_law(stage, without_filter(controller), bus, autostart=True)
    seen = seen_by(alone["tick"][0]["estimator"])

    def loop(case: Case, peak_s: float) -> InnovationLoop:
        plant = loop_plant(stage, bus, case.strokes_m, case.perturbation)
        return InnovationLoop(
            plant, lqg_equivalent(stage, alone, case.strokes_m, case.perturbation), seen, axis, peak_s
        )

    middle = np.array(controller.operating_strokes_m)
    # a comb alone couples the axes, and where the stage stands matters little: both are in the margins' own table
    single = [c for c in tolerances.cases() if np.allclose(c.strokes_m, middle, atol=1e-9) and "comb " not in c.name]
    changed = [loop(case, asked.peak_s_changed_max) for case in single if case.perturbation != NOMINAL]
    changed += [loop(case, asked.peak_s_combined_max) for case in tolerances.combined(search.across)]
    model = linearise(stage, middle)
    noise = Noise(
        float(np.sqrt(np.diag(measurement_noise(stage, model, bus)))[axis]),
        float(rounding_force_n(stage, bus, model)[axis]),
        _shaken(model, asked, bus.period_s, axis),
    )
    bounds = Bounds(
        asked.edge_hz, _EDGE, asked.slope, asked.peak_s_max, asked.disk_margin_min, asked.effort_max,
        tuple((hz, 10.0 ** (-0.05 * db)) for hz, db in asked.reject_db),
    )  # fmt: skip
    return youla_taps(
        loop(Case("as drawn", middle, NOMINAL), asked.peak_s_max), changed, bounds, noise, search.taps, on_progress
    )


def _shaken(model: LinearStage, asked: TapBounds, period_s: float, axis: int) -> Array:
    """(2,2) factor of the covariance that the base adds to position and velocity of an axis in a period."""
    if not isinstance(asked, QuietBounds):
        return np.zeros((2, 2))
    covariance = shaken_covariance(model, model.mass_kg * asked.base_noise_m_per_s2_per_rt_hz, period_s)
    return np.asarray(np.linalg.cholesky(covariance[axis::3, axis::3]))


def without_filter(controller: ControllerConfig) -> ControllerConfig:
    """The controller with its state feedback alone. Raises ``ConfigError`` for one of another law."""
    if controller.youla is None:
        raise ConfigError(
            f'controller {controller.name!r}: law = "{controller.law}" has no taps; give one with "youla"'
        )
    return controller.model_copy(update={"youla": controller.youla.model_copy(update={"filter": ()})})


def _rounded(taps: Array) -> tuple[float, ...]:
    return tuple(float(f"{tap:.{_DIGITS}g}") for tap in taps)


def write_taps(search: TapsSearch, found: FoundTaps, path: Path) -> None:
    """The search's controller file with these taps in place of those that its stage would have on this bus. Raises
    ``ConfigError`` where it can't be written.
    """
    document = tomlkit.parse(config.find("controllers", search.controller).read_text(encoding="utf-8"))
    bus, delay_us = config.load("buses", search.bus, BusConfig), 1e6 * Stage.load(search.stage).sense_delay_s
    section: Any = document["youla"]
    youla = Youla.model_validate_json(json.dumps(section.unwrap()))
    place = youla.place_of_filter(bus.period_us, bus.delay_periods, delay_us)
    tables, table = list(section.get("filter", [])), _table(search, found, bus)
    if place is None:
        tables.append(table)
    else:
        if "sense_delay_max_us" in tables[place]:
            table.add("sense_delay_max_us", tables[place]["sense_delay_max_us"])
        tables[place] = table
    section["filter"] = tomlkit.aot()
    for each in tables:
        section["filter"].append(each)
    document["name"] = path.stem
    try:
        path.write_text(tomlkit.dumps(document), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: {reason(error)}; give another --out") from None


def _table(search: TapsSearch, found: FoundTaps, bus: BusConfig) -> Any:
    table = tomlkit.table()
    table.add("period_us", bus.period_us)
    table.add("delay_periods", bus.delay_periods)
    table.add("plane", _array(found.plane))
    table.add("z", _array(found.z))
    if found.quiet is not None:
        table.add("quiet_plane", _array(found.quiet.plane))
        table.add("quiet_z", _array(found.quiet.z))
    x, z = (1e9 * value for value in found.hold_noise_m)
    table.comment(f"pkxyz tune {search.name}: stage {search.stage}, {x:.2f} nm of noise in x and y, {z:.2f} in z")
    return table


def _array(taps: tuple[float, ...]) -> Any:
    return tomlkit.item(list(taps)).multiline(True)
