"""How far devices may differ from the drawing, as data, and the plants that follow: at the ends, or drawn by a seed."""

import itertools
from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pkxyz_ctrl.config.files import FrozenModel
from pkxyz_ctrl.design.model.loop_plant import NOMINAL, Perturbation

Array = NDArray[np.float64]
Relative = Annotated[float, Field(ge=0, lt=1)]
Stroke = Annotated[float, Field(ge=0, le=25e-6)]


@dataclass(frozen=True)
class Case:
    """One plant at one point."""

    name: str
    strokes_m: Array
    """(3,) about which it is held"""
    perturbation: Perturbation


class Tolerances(FrozenModel):
    """A file of configs/tolerances. Relative numbers are the largest deviation to either side."""

    name: Annotated[str, Field(min_length=1)]
    stiffness: Relative
    """of all springs alike"""
    mass: Relative
    quality_factor: tuple[Annotated[float, Field(gt=0.5)], Annotated[float, Field(gt=0.5)]]
    """least and greatest"""
    comb_gain: Relative
    """of each comb by itself"""
    stroke_low_m: Stroke
    """points of the workspace: the middle of the strokes, and the eight corners of a cube of strokes from this ..."""
    stroke_high_m: Stroke
    """... to this"""

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.stroke_low_m >= self.stroke_high_m:
            raise ValueError("stroke_low_m must be below stroke_high_m")
        if self.quality_factor[0] > self.quality_factor[1]:
            raise ValueError("quality_factor must be [least, greatest]")
        return self

    def points_m(self) -> dict[str, Array]:
        """Strokes (3,) by name: the middle, and eight corners."""
        middle = np.full(3, 0.5 * (self.stroke_low_m + self.stroke_high_m))
        corners = itertools.product((self.stroke_low_m, self.stroke_high_m), repeat=3)
        named = {f"{'/'.join(f'{q * 1e6:g}' for q in corner)} um": np.array(corner) for corner in corners}
        return {"middle": middle} | named

    def perturbations(self) -> dict[str, Perturbation]:
        """Nothing, then one thing at a time at the end of its range; combs singly and together."""
        g = self.comb_gain
        single = {f"comb {i + 1} {s:+.0%}": tuple(np.eye(3)[i] * s) for i in range(3) for s in (g, -g)}
        single |= {f"combs {s:+.0%}": (s, s, s) for s in (g, -g)}
        return (
            {"as drawn": NOMINAL}
            | {f"stiffness {s:+.0%}": Perturbation(stiffness=s) for s in (self.stiffness, -self.stiffness)}
            | {f"mass {s:+.0%}": Perturbation(mass=s) for s in (self.mass, -self.mass)}
            | {f"Q {q:g}": Perturbation(quality_factor=q) for q in self.quality_factor}
            | {name: Perturbation(comb_gain=(float(c[0]), float(c[1]), float(c[2]))) for name, c in single.items()}
        )

    def cases(self) -> list[Case]:
        """Every perturbation at every point."""
        return [
            Case(f"{change}, {point}", strokes, perturbation)
            for point, strokes in self.points_m().items()
            for change, perturbation in self.perturbations().items()
        ]

    def draw(self, seed: int) -> Case:
        """A plant drawn by a seed: everything at once, evenly within its range (the quality factor by ratio)."""
        rng = np.random.default_rng(seed)
        low, high = np.log(self.quality_factor)
        stiffness, mass = rng.uniform(-1, 1, 2) * (self.stiffness, self.mass)
        quality_factor = float(np.exp(rng.uniform(low, high)))
        comb = rng.uniform(-self.comb_gain, self.comb_gain, 3)
        strokes = rng.uniform(self.stroke_low_m, self.stroke_high_m, 3)
        drawn = Perturbation(
            float(stiffness), float(mass), quality_factor, (float(comb[0]), float(comb[1]), float(comb[2]))
        )
        return Case(f"seed {seed}", strokes, drawn)
