"""A drawing whose numbers are open, and what a choice of them is worth: the paper's inequalities first, devices then.

Open are crank and link, widths of leaves and hinges, the leaves' lengths by one factor, and the gap of all combs. A
comb keeps the length that it has in the template, so wider gaps leave fewer fingers. Of the laws that are offered a
drawing gets the one that leaves it the lowest Ms.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.runs.scenario import Scenario, resolve
from hil.studies.wafer.closed_loop import PART_DEVICES, ClosedLoops
from hil.studies.wafer.study import WaferStudy
from pkxyz_ctrl.config import files as config
from pkxyz_ctrl.config.bound import Bound
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.design.model.design_error import DesignError
from pkxyz_ctrl.design.model.discrete_law import LawError
from pkxyz_ctrl.fabrication.process import Process
from pkxyz_ctrl.mechanics.inscribed import standing_cube_m
from pkxyz_ctrl.mechanics.selection import MARGINS, Requirements, candidate, margins
from pkxyz_ctrl.stage import Stage
from sim.config import Device

Array = NDArray[np.float64]
Choice = dict[str, float]
"""Of each name of ``OPEN`` a number."""

FINGER_M = 5.0e-6
"""Width of a comb's fingers, which the paper does not print: as wide as its gaps."""
OWN_WAFERS = 8
"""Wafers whose devices are all looked at without a loop."""
OWN_LEAST = 0.5
"""Share of them below which no loop is closed."""
_FAR = 1e6
"""What stands for a figure that is infinite, in bounds."""


class Open(NamedTuple):
    """Range of a number, as factors of the template's, and the grid that it lies on."""

    low: float
    high: float
    step: float


OPEN: dict[str, Open] = {
    "crank_um": Open(0.6, 1.4, 0.1),
    "projection_um": Open(0.9, 1.1, 0.1),
    "leaf_um": Open(0.8, 1.3, 0.1),
    "leaf_length": Open(0.8, 1.3, 0.001),
    "crank_hinge_um": Open(0.7, 1.4, 0.1),
    "link_hinge_um": Open(0.7, 1.3, 0.1),
    "gap_um": Open(0.8, 1.6, 0.1),
}
"""Lengths in um, drawn to 0.1 um; ``leaf_length`` is a factor of the template's."""


@dataclass(frozen=True)
class Verdict:
    """Of a choice. Constraints are kept where they are 0 or less; without a value no device was looked at."""

    constraints: dict[str, float]
    value: float | None = None
    figures: dict[str, float] | None = None
    reason: str = ""
    """why there is no value"""


@dataclass(frozen=True)
class DrawingProblem:
    """What is searched: the drawing of most devices that work."""

    need: Requirements
    template: StageConfig
    process: Process
    scenario: Scenario
    laws: tuple[ControllerConfig, ...]
    seed: int
    loops: int
    """devices in a closed loop, one a wafer, of each choice"""

    def digest(self) -> str:
        """Of all that decides about a choice's value."""
        return config.digest({
            "need": vars(self.need), "template": config.plain(self.template), "process": config.plain(self.process),
            "scenario": resolve(self.scenario)["digest"], "laws": [config.plain(law) for law in self.laws],
            "seed": self.seed, "loops": self.loops, "open": {k: list(v) for k, v in OPEN.items()},
        })  # fmt: skip

    def nearest_choice(self, stage: StageConfig) -> Choice:
        """The choice that comes nearest to a stage of the template's kind."""
        start, numbers = self._numbers(self.template), self._numbers(stage)
        return {k: float(np.clip(v, *self.range_of(k, start))) for k, v in numbers.items()}

    def range_of(self, name: str, start: Choice | None = None) -> tuple[float, float]:
        """Of a number, in its own unit."""
        drawn = float((start or self._numbers(self.template))[name])
        return OPEN[name].low * drawn, OPEN[name].high * drawn

    def _numbers(self, stage: StageConfig) -> Choice:
        f, g = stage.flexures, stage.geometry
        return {
            "crank_um": g.crank_length_m * 1e6,
            "projection_um": g.projection_rest_m * 1e6,
            "leaf_um": f.leaf_thickness_m * 1e6,
            "leaf_length": f.leaf_outer_length_m / self.template.flexures.leaf_outer_length_m,
            "crank_hinge_um": f.crank_hinge_thickness_m * 1e6,
            "link_hinge_um": f.link_hinge_thickness_m * 1e6,
            "gap_um": stage.drive_comb.finger_gap_m * 1e6,
        }

    def flexed(self, choice: Choice) -> StageConfig:
        """The template with the chosen flexures and combs, cranks and links as they were."""
        number = {name: choice[name] for name in OPEN}
        f, factor = self.template.flexures, number["leaf_length"]
        flexures = f.model_copy(
            update={
                "leaf_thickness_m": number["leaf_um"] / 1e6,
                "leaf_inner_length_m": f.leaf_inner_length_m * factor,
                "leaf_outer_length_m": f.leaf_outer_length_m * factor,
                "crank_hinge_thickness_m": number["crank_hinge_um"] / 1e6,
                "link_hinge_thickness_m": number["link_hinge_um"] / 1e6,
            }
        )
        combs = {}
        for name in ("drive_comb", "sense_comb"):
            comb, gap = getattr(self.template, name), number["gap_um"] / 1e6
            count = math.floor(comb.finger_count * (comb.finger_gap_m + FINGER_M) / (gap + FINGER_M) + 1e-9)
            combs[name] = comb.model_copy(update={"finger_count": count, "finger_gap_m": gap})
        return self.template.model_copy(update={"flexures": flexures, **combs})

    def law(self, stage: StageConfig) -> ControllerConfig:
        """That of the laws under which a drawing, as drawn, has the lowest Ms."""
        asked = [self.closed(stage, law, self.seed) for law in self.laws]
        return min(asked, key=ClosedLoops.drawn_peak_s).scenario.controller

    def stage(self, choice: Choice, name: str) -> StageConfig:
        """The drawing of a choice that keeps the inequalities."""
        crank, projection = (choice[key] / 1e6 for key in ("crank_um", "projection_um"))
        return candidate(self.need, self.flexed(choice), crank, projection, name)

    def margins(self, choice: Choice) -> Array:
        """The paper's inequalities as ``selection.margins`` has them, the cube's exact where all others are kept."""
        crank, projection = (choice[key] / 1e6 for key in ("crank_um", "projection_um"))
        out = margins(self.need, self.flexed(choice), crank, projection)
        if (out > 0.0).all():
            out[MARGINS.index("cube")] = (
                standing_cube_m(Stage(self.stage(choice, "candidate"))) / self.need.cube_side_m - 1
            )
        return out

    def closed(self, stage: StageConfig, law: ControllerConfig, seed: int, *, identified: bool = False) -> ClosedLoops:
        """Devices of a drawing under a law."""
        device = Device.model_validate(config.plain(stage))
        scenario = replace(self.scenario, stage=stage, device=device, controller=law)
        return ClosedLoops(WaferStudy(self.process, stage, seed), scenario, known=True, identified=identified)


def evaluate(problem: DrawingProblem, choice: Choice) -> Verdict:
    """The paper's inequalities; where they are kept the share of devices that work, and how much room they have.

    A device works if it meets its own requirements, runs under the law as shipped (or nobody could identify it) and
    keeps its bounds under the law for the device as it is. Among choices of equal shares their devices' own
    requirements and room decide, which together are worth less than one device.
    """
    kept = problem.margins(choice)
    beyond = dict(zip(MARGINS, (-np.clip(kept, -1e3, 1e3)).tolist(), strict=True))
    if not (kept > 0.0).all():
        return Verdict(beyond, reason=f"misses {', '.join(name for name, v in beyond.items() if v >= 0.0)}")
    try:
        stage = problem.stage(choice, "candidate")
        asked = problem.closed(stage, problem.law(stage), problem.seed)
        share = float(asked.wafers.columns(range(OWN_WAFERS))["ok"].mean())
        if share < OWN_LEAST:
            return Verdict(beyond, share - 1.0, {"own": share})
        rows = [row for some in _devices(asked, problem.loops) for row in asked.devices(some)]
    except (ConfigError, DesignError, LawError) as error:
        return Verdict(beyond, reason=str(error))
    found = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    works = float(working(asked, found).mean())
    room = float(least_room(found, problem.process.closed_loop).mean())
    value = works + 0.5 * (share + 0.5 + 0.5 * room) / problem.loops
    return Verdict(beyond, value, {"own": share, "works": works, "room": room})


def working(asked: ClosedLoops, found: Mapping[str, Array]) -> NDArray[np.bool_]:
    """Which devices work, of figures in the loop: as shipped, and under the law for the device as it is."""
    ok = asked.verdicts(found)
    return np.asarray(ok["ok.shipped"] & ok["ok.known"])


def least_room(found: Mapping[str, NDArray[np.generic]], bounds: Mapping[str, Bound]) -> Array:
    """Of each device (n,) the distance r from the bound that it is nearest to, or farthest beyond, as a share of that
    bound: r / (1 + |r|), so -1 to 1 and negative beyond. Figures that were not found are passed over.
    """
    rooms = []
    for name, bound in bounds.items():
        for limit, sign in ((bound.min, 1.0), (bound.max, -1.0)):
            if name in found and limit:
                far = np.clip(sign * (np.asarray(found[name], dtype=np.float64) - limit) / abs(limit), -_FAR, _FAR)
                rooms.append(far / (1.0 + np.abs(far)))
    return np.asarray(np.min(rooms, axis=0))


def _devices(asked: ClosedLoops, count: int) -> list[NDArray[np.int64]]:
    """Numbers of so many devices, as many at once as in a part of a study."""
    return [asked.numbers(part)[: count - part * PART_DEVICES] for part in range(-(-count // PART_DEVICES))]
