"""Sections of a plant file about what bends. SI units."""

from typing import Annotated

from pydantic import Field

from sim.config.device import Positive
from sim.config.section import Model, PerAxis, PerChain

MODES_MAX = 3


class FlexibleMode(Model):
    """A part between mechanism and table that gives: coordinate r, which the mechanism lags behind the table by
    ``table_shape`` r, and which moves the combs by ``comb_shape`` r beside their strokes.

    ``frequency_hz`` and ``quality_factor`` are those of r with the table held fast; ``compliance_share``: its static
    compliance as a share of the stage's in-plane 1/K_xx.
    """

    frequency_hz: Annotated[float, Field(ge=500.0, le=20e3)]
    quality_factor: Annotated[float, Field(gt=0.5, allow_inf_nan=False)]
    compliance_share: Positive
    comb_shape: PerChain
    table_shape: PerAxis


class FlexibleModes(Model):
    """Modes in both directions: combs, weight and shaking of the base drive them,
    and they push table and mechanism back."""

    on: bool = False
    modes: Annotated[tuple[FlexibleMode, ...], Field(max_length=MODES_MAX)] = ()


class FingerMisalignment(Model):
    """Moving fingers that stand aside of the middle of their gaps. The voltage pulls them further; against it stand the
    springs, whose lateral stiffness (that of ``pull_in``) halves at ``softening_stroke_m``. The force along the stroke
    grows as 1 / (1 - (d / gap)^2); where no balance is left the fingers snap."""

    on: bool = False
    offset_m: PerChain = (0.0, 0.0, 0.0)
    softening_stroke_m: Positive = 1.0


class TableTilt(Model):
    """Rotation of the table by its position, and the arm from the point that the mechanism moves to the point of
    interest: position += (T position) x arm. No comb sees it."""

    on: bool = False
    about_x_rad_per_m: PerAxis = (0.0, 0.0, 0.0)
    about_y_rad_per_m: PerAxis = (0.0, 0.0, 0.0)
    arm_m: PerAxis = (0.0, 0.0, 0.0)
