"""How far devices may differ from the drawing, as data; the plants that follow: at the ends, or sampled by a seed."""

import itertools
from dataclasses import dataclass
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from pkxyz_ctrl.config.files import FrozenModel
from pkxyz_ctrl.design.model.loop_plant import NOMINAL, ParasiticMode, Perturbation

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


class ParasiticRange(FrozenModel):
    """What a parasitic mode of a sampled device may be, each from least to greatest."""

    frequency_hz: tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]]
    quality_factor: tuple[Annotated[float, Field(gt=0.5)], Annotated[float, Field(gt=0.5)]]
    compliance_share: tuple[Annotated[float, Field(ge=0, lt=1)], Annotated[float, Field(ge=0, lt=1)]]

    def sample(self, rng: np.random.Generator) -> ParasiticMode:
        """One mode; frequency and quality factor evenly by ratio."""
        frequency_hz, quality_factor = (
            np.exp(rng.uniform(*np.log(r))) for r in (self.frequency_hz, self.quality_factor)
        )
        return ParasiticMode(float(frequency_hz), float(quality_factor), float(rng.uniform(*self.compliance_share)))


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
    delay_s: Annotated[float, Field(ge=0, lt=1e-3)] = 0.0
    """between sample and action, more or less; of sampled devices, like all that follows"""
    amplifier_bandwidth: Relative = 0.0
    sense_bandwidth_hz: tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]] | None = None
    """least and greatest corner of the sense chain"""
    parasitic: tuple[ParasiticRange, ...] = ()
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

    def combined(self, across: int = 9) -> list[Case]:
        """Everything changed at once, in the middle: ``across`` stages from the softest and heaviest to the stiffest
        and lightest, hardly damped, with combs and delay at their ends; and three that are damped well, acting late.

        Ends alone do not do: a resonance that is hardly damped is dangerous where its frequency meets a bad phase.
        """
        middle, g, late_s = self.points_m()["middle"], self.comb_gain, self.delay_s
        ends = [(comb, delay_s) for comb in (g, -g) for delay_s in ((late_s, -late_s) if late_s > 0.0 else (0.0,))]
        found: list[Case] = []
        for quality_factor, count, at in (
            (self.quality_factor[1], across, ends), (self.quality_factor[0], 3, [(g, late_s), (-g, late_s)])
        ):  # fmt: skip
            for stiff in np.linspace(-1.0, 1.0, count):
                for comb, delay_s in at:
                    change = Perturbation(
                        float(stiff) * self.stiffness,
                        -float(stiff) * self.mass,
                        quality_factor,
                        (comb, comb, comb),
                        delay_s,
                    )
                    found.append(Case(f"combined {len(found) + 1}", middle, change))
        return found

    def sample(self, seed: int) -> Case:
        """A plant sampled by a seed: everything at once, evenly within its range (the quality factor by ratio)."""
        rng = np.random.default_rng(seed)
        low, high = np.log(self.quality_factor)
        stiffness, mass = rng.uniform(-1, 1, 2) * (self.stiffness, self.mass)
        quality_factor = float(np.exp(rng.uniform(low, high)))
        comb = rng.uniform(-self.comb_gain, self.comb_gain, 3)
        strokes = rng.uniform(self.stroke_low_m, self.stroke_high_m, 3)
        sampled = Perturbation(
            float(stiffness), float(mass), quality_factor, (float(comb[0]), float(comb[1]), float(comb[2])),
            delay_s=float(rng.uniform(-self.delay_s, self.delay_s)),
            amplifier_bandwidth=float(rng.uniform(-self.amplifier_bandwidth, self.amplifier_bandwidth)),
            sense_bandwidth_hz=None if self.sense_bandwidth_hz is None
            else float(np.exp(rng.uniform(*np.log(self.sense_bandwidth_hz)))),
            parasitic=tuple(mode.sample(rng) for mode in self.parasitic),
        )  # fmt: skip
        return Case(f"seed {seed}", strokes, sampled)
