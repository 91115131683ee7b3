"""What was measured of one device, as the section [calibration] of its stage file holds it.

Every number is relative to the drawing (the rest of the file), so 1 is as drawn. Forces and stiffnesses are those that
go with the drawing's mass: in a loop that sees positions and sets voltages, only their ratios to the mass are seen.
"""

from typing import Annotated, Literal

from pydantic import Field

from pkxyz_ctrl.config.files import FrozenModel

Relative = Annotated[float, Field(gt=0.1, lt=10.0)]
EachChain = tuple[Relative, Relative, Relative]
Error = Annotated[float, Field(ge=0.0)]
EachError = tuple[Error, Error, Error]
Text = Annotated[str, Field(min_length=1)]

AS_DRAWN = (1.0, 1.0, 1.0)

SenseScale = Literal["drawing", "reciprocity", "instrument"]
"""Where the metres of the sense combs come from. By reciprocity the ratios of the chains do, their mean is drawn."""


class StandardErrors(FrozenModel):
    """Standard error of each number, in its own unit; 0: not measured, taken as drawn."""

    comb_gain: EachError
    lift: Error
    sense_gain: EachError
    slider_stiffness: EachError
    crank_stiffness: EachError
    link_stiffness: Error
    quality_factor: Error
    sense_delay_s: Error


class MeasuredBy(FrozenModel):
    """The run that measured, by what decides about its result."""

    run: Text
    """name of its folder"""
    digest: Text
    """of all that went in: equal digest, equal bits"""
    seed: Annotated[int, Field(ge=0)]
    stage: Text
    plant: Text
    controller: Text
    bus: Text
    lane: Text
    tones: Text
    strokes_um: tuple[float, float, float]
    """about which it was measured"""
    chi_square: Error
    """of the numbers against what was measured; near 1: the model says all"""
    sense_scale: SenseScale
    known: Text
    not_known: Text
    """what stays open, and how it was taken"""


class Calibration(FrozenModel):
    """One device's deviations from its drawing."""

    comb_gain: EachChain = AS_DRAWN
    """pull of each comb at a voltage asked for, amplifier included"""
    lift: Annotated[float, Field(gt=-0.5, lt=0.5)] = 0.0
    """force up the combs' fingers (levitation) by pull; 0 as drawn"""
    sense_gain: EachChain = AS_DRAWN
    """capacitance seen per stroke; the capacitance at rest is homing's affair"""
    slider_stiffness: EachChain = AS_DRAWN
    """folded springs of each chain"""
    crank_stiffness: EachChain = AS_DRAWN
    """in-plane hinges of each chain"""
    link_stiffness: Relative = 1.0
    """out-of-plane hinges, of all chains together"""
    quality_factor: Annotated[float, Field(ge=1.0)] | None = None
    """in place of that of [dynamics]"""
    sense_delay_s: Annotated[float, Field(ge=0.0, lt=1e-3)] | None = None
    """in place of that of [sense]: whatever the loop lags beyond whole periods and the drawn amplifier"""
    standard_error: StandardErrors | None = None
    measured_by: MeasuredBy | None = None
