"""Margins of a controller file's law: computed, over changed plants, and measured; as plain data for table and JSON."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.stats
from numpy.typing import NDArray

from hil.studies.margins.measured import MeasuredLoop
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.design.law_about import law_about, law_in_parts
from pkxyz_ctrl.design.margins.margins import LoopResponse, Margins, loop_response, margins, peak_sensitivity
from pkxyz_ctrl.design.margins.tolerances import Case
from pkxyz_ctrl.design.model.loop_plant import NOMINAL, Perturbation, loop_plant
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]

CONFIDENCE = 0.999
"""With which a loop that is as computed passes as such, all tones and entries taken together."""


@dataclass(frozen=True)
class Loop:
    """A designed law on a stage and a bus."""

    stage: Stage
    bus: BusConfig
    law: NDArray[np.void]
    """(1,) of ``cycle.LAW``"""

    def margins(self, strokes_m: Array, perturbation: Perturbation = NOMINAL) -> Margins:
        """All margins about the position of strokes (3,)."""
        plant = loop_plant(self.stage, self.bus, strokes_m, perturbation)
        return margins(plant, law_about(self.stage, self.law, strokes_m, perturbation))

    def peak_sensitivity(self, case: Case) -> float:
        """Ms of the MIMO system for one case; infinite where it is unstable."""
        plant = loop_plant(self.stage, self.bus, case.strokes_m, case.perturbation)
        return peak_sensitivity(plant, law_in_parts(self.stage, self.law, case.strokes_m, case.perturbation))

    def response(self, strokes_m: Array, frequency_hz: Array, perturbation: Perturbation = NOMINAL) -> LoopResponse:
        """L, S and T at frequencies (m,)."""
        plant = loop_plant(self.stage, self.bus, strokes_m, perturbation)
        return loop_response(plant, law_about(self.stage, self.law, strokes_m, perturbation), frequency_hz)


@dataclass(frozen=True)
class ChangedPlants:
    """Ms of each case, in the order of the cases."""

    cases: tuple[Case, ...]
    peak_s: tuple[float, ...]

    @property
    def worst(self) -> tuple[Case, float]:
        """The case with the largest Ms."""
        at = int(np.argmax(self.peak_s))
        return self.cases[at], self.peak_s[at]


def over_changed_plants(
    loop: Loop, cases: Sequence[Case], on_progress: Callable[[int, int], None] = lambda done, total: None
) -> ChangedPlants:
    """Ms for every case."""
    found = []
    for n, case in enumerate(cases):
        found.append(loop.peak_sensitivity(case))
        on_progress(n + 1, len(cases))
    return ChangedPlants(tuple(cases), tuple(found))


@dataclass(frozen=True)
class Agreement:
    """Measured and computed S side by side. A measured entry has two degrees of freedom; its standard error was
    estimated from m periods, so the squared distance in standard errors is distributed as F(2, 2 m - 2).
    """

    largest: float
    """distance in standard errors, over all tones and entries"""
    bound: float
    """that the largest stays below with ``CONFIDENCE`` if the loop is as computed"""
    mean_square: float
    expected_mean_square: float
    """(m - 1) / (m - 2)"""
    largest_difference: float
    """|S measured - S computed|"""

    @property
    def holds(self) -> bool:
        """Whether noise explains the difference."""
        return self.largest <= self.bound


def agreement(measured: MeasuredLoop, computed: LoopResponse) -> Agreement:
    """Compare S entry by entry, at the same frequencies. Needs three periods at least."""
    periods = measured.periods
    difference = np.abs(measured.s - computed.s)
    distance = difference / measured.standard_error
    each = CONFIDENCE ** (1.0 / distance.size)
    return Agreement(
        largest=float(distance.max()),
        bound=math.sqrt(float(scipy.stats.f.ppf(each, 2, 2 * periods - 2))),
        mean_square=float((distance**2).mean()),
        expected_mean_square=(periods - 1) / (periods - 2),
        largest_difference=float(difference.max()),
    )


def as_json(found: Margins) -> dict[str, Any]:
    """Plain data for JSON. None stands for no limit (an infinite margin), and for a radius that was not computed."""
    axes = {name: _numbers(vars(axis)) for name, axis in zip("xyz", found.axes, strict=True)}
    radius = found.spectral_radius if math.isfinite(found.spectral_radius) else None
    return {"stable": found.stable, "spectral_radius": radius, **axes, "mimo": _numbers(vars(found.mimo))}


def _numbers(values: dict[str, float]) -> dict[str, float | None]:
    return {name: value if math.isfinite(value) else None for name, value in values.items()}
