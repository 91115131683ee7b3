"""What adaptation may learn, and how fast."""

from typing import Annotated

from pydantic import Field

from pkxyz_ctrl.config.files import FrozenModel

Positive = Annotated[float, Field(gt=0)]
Spread = Annotated[float, Field(gt=0, le=0.5)]


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
    most_relative: Annotated[float, Field(gt=0, le=0.5)] = 0.35
    """most that is learnt of pull, springs, fringe and lift"""
    most_damping: Annotated[float, Field(gt=0, le=10)] = 4.0
    most_delay_s: Annotated[float, Field(gt=0, le=200e-6)] = 100e-6
    doubt: Annotated[float, Field(ge=0, le=1)] = 0.1
    """share of an unexpected innovation's square that counts as noise: what no number here explains teaches less"""
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
    forget_s: Positive = 2.0
    """time constant with which what speaks for a change is forgotten"""
    warn_relative: Annotated[float, Field(gt=0, le=0.3)] = 0.01
    """change of a comb or of springs from which on there is a warning"""
    alone: Annotated[float, Field(gt=0, le=1)] = 0.7
    """share that one cause has to explain to be named"""
