"""What adaptation may learn, and how fast."""

from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from pkxyz_ctrl.config.files import FrozenModel

Positive = Annotated[float, Field(gt=0)]
Spread = Annotated[float, Field(gt=0, le=0.5)]


NUMBERS = (
    "comb_gain_1", "comb_gain_2", "comb_gain_3", "slider_stiffness_1", "slider_stiffness_2", "slider_stiffness_3",
    "crank_stiffness_1", "crank_stiffness_2", "crank_stiffness_3", "link_stiffness", "fringe", "lift", "damping",
    "sense_delay_s", "sense_bend_s2",
)  # fmt: skip
"""What is learnt, in the order of ``core.adaptation``: relative errors but for the last two, fringe and lift."""
_COUNT = len(NUMBERS)
Finite = Annotated[float, Field(allow_inf_nan=False)]
Values = Annotated[tuple[Finite, ...], Field(min_length=_COUNT, max_length=_COUNT)]


class Start(FrozenModel):
    """What an earlier run has learnt, in the units of ``NUMBERS``."""

    values: Values
    covariance: Annotated[tuple[Values, ...], Field(min_length=_COUNT, max_length=_COUNT)]

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        covariance = np.array(self.covariance)
        spread = np.sqrt(np.abs(np.diag(covariance)))
        if not (spread > 0.0).all() or not np.allclose(covariance, covariance.T, rtol=1e-6, atol=0.0):
            raise ValueError("the covariance is not one: not symmetric, or without variance")
        if np.linalg.eigvalsh(covariance / np.outer(spread, spread)).min() < -1e-6:
            raise ValueError("the covariance is not one: it has a negative eigenvalue")
        return self


class Adaptation(FrozenModel):
    """How far devices differ from their stage file, one standard deviation each, and how what is learnt is used."""

    comb_gain: Spread = 0.1
    """pull of each comb"""
    stiffness: Spread = 0.1
    """springs of each chain, and the out-of-plane hinges"""
    fringe: Spread = 0.03
    """growth of a comb's pull over 25 um of stroke"""
    lift: Spread = 0.03
    """force up the fingers by pull"""
    damping: Annotated[float, Field(gt=0, le=5)] = 0.2
    sense_delay_s: Annotated[float, Field(gt=0, le=100e-6)] = 5e-6
    start: Start | None = None
    """of an earlier run; none: the stage file"""
    most_relative: Annotated[float, Field(gt=0, le=0.5)] = 0.35
    """most that is learnt of pull, springs, fringe and lift"""
    most_damping: Annotated[float, Field(gt=0, le=10)] = 4.0
    most_delay_s: Annotated[float, Field(gt=0, le=200e-6)] = 100e-6
    doubt: Annotated[float, Field(ge=0, le=1)] = 0.1
    """share of an unexpected innovation's square that counts as noise: what no number here explains teaches less,
    until a change has been named"""
    drift_per_rts: Positive = 2e-3
    """how much these numbers may change by themselves, in standard deviations per root second: more is followed faster,
    less is less noise"""
    follow_s: Positive = 0.02
    """time constant with which what acts follows what is learnt"""
    least_told: Positive = 1e-4
    """an update has to tell so much: variance of what it predicts over that of the noise"""
    near_m: Positive = 0.5e-6
    """nothing is learnt while the stage is further than this from its set-point ..."""
    calm_s: Positive = 0.01
    """... and for so long afterwards, or after a comb was at a limit"""
    base_s: Positive = 3.0
    """after learning for so long, what is known is what changes are counted from"""
    forget_s: Positive = 0.5
    """time constant with which what speaks for a change is forgotten"""
    warn_relative: Annotated[float, Field(gt=0, le=0.3)] = 0.01
    """change of a comb or of springs from which on there is a warning"""
    alone: Annotated[float, Field(gt=0, le=1)] = 0.7
    """share that one cause has to explain to be named"""

    @model_validator(mode="after")
    def _start_within_bounds(self) -> Self:
        most = [self.most_relative] * (_COUNT - 3) + [self.most_damping, self.most_delay_s]
        for name, value, bound in zip(NUMBERS, self.start.values if self.start is not None else (), most, strict=False):
            if abs(value) > bound * (1.0 + 1e-9):
                raise ValueError(f"{name} = {value:g} is beyond the {bound:g} that may be learnt")
        return self
