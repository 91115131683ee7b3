"""Periodic scans about where the stage stands: sine, circle, Lissajous figure, rosette.

The amplitude grows from nothing and goes back to nothing, so each starts and ends at rest at its centre.
"""

import math
from fractions import Fraction
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from pkxyz_ctrl.config.files import FrozenModel
from pkxyz_ctrl.trajectory.motion import Array
from pkxyz_ctrl.trajectory.segments import Plan, Position, Positive, far_from_underflow
from pkxyz_ctrl.trajectory.tones import Tones

Axis = Literal["x", "y", "z"]
Angle = Annotated[float, Field(ge=-1e6, le=1e6)]
Angles = tuple[Angle, Angle, Angle]
Frequency = Annotated[float, Field(ge=0), AfterValidator(far_from_underflow)]
Frequencies = tuple[Frequency, Frequency, Frequency]
Lead = Annotated[float, Field(gt=0, le=10)]

LEAD_S = 0.02
"""Default time in which the amplitude grows: 12 periods of the first resonance, which it hardly excites."""


class Sine(FrozenModel):
    """One axis to and fro."""

    kind: Literal["sine"]
    axis: Axis
    amplitude_m: Positive
    frequency_hz: Positive
    cycles: Positive
    """at full amplitude"""
    lead_s: Lead = LEAD_S

    def plan(self, start_m: Array) -> Plan:
        """One tone, in sine phase at the start of the full amplitude."""
        amplitude, frequency = (unit(self.axis) * v for v in (self.amplitude_m, self.frequency_hz))
        tones = Tones(
            start_m, amplitude[None], frequency[None], np.zeros((1, 3)), self.lead_s, self.cycles / self.frequency_hz
        )
        return planned(tones)


class Circle(FrozenModel):
    """A circle in the plane, counter-clockwise seen from above; it grows out of its centre and shrinks back."""

    kind: Literal["circle"]
    radius_m: Positive
    frequency_hz: Positive
    turns: Positive
    """at full radius"""
    lead_s: Lead = LEAD_S

    def plan(self, start_m: Array) -> Plan:
        """Two tones a quarter apart; the full radius begins at positive x."""
        amplitude, frequency = (np.array([[v, v, 0.0]]) for v in (self.radius_m, self.frequency_hz))
        phase = np.array([[math.pi / 2, 0.0, 0.0]])
        return planned(Tones(start_m, amplitude, frequency, phase, self.lead_s, self.turns / self.frequency_hz))


class Lissajous(FrozenModel):
    """A sine for each axis, each with its own frequency and phase."""

    kind: Literal["lissajous"]
    amplitude_m: Position
    """0 for an axis that stands still"""
    frequency_hz: Frequencies
    phase_rad: Angles = (0.0, 0.0, 0.0)
    """of each sine at the start of the full amplitude"""
    duration_s: Positive
    """at full amplitude"""
    lead_s: Lead = LEAD_S

    @model_validator(mode="after")
    def _moves(self) -> Self:
        if not any(a and f for a, f in zip(self.amplitude_m, self.frequency_hz, strict=True)):
            raise ValueError("no axis has both an amplitude and a frequency, so nothing would move")
        return self

    def plan(self, start_m: Array) -> Plan:
        """One tone for each axis."""
        amplitude, frequency, phase = (np.array([v]) for v in (self.amplitude_m, self.frequency_hz, self.phase_rad))
        return planned(Tones(start_m, amplitude, frequency, phase, self.lead_s, self.duration_s))


class Rosette(FrozenModel):
    """Petals in the plane: ``r = radius sin(2 pi petal_hz t)`` at the angle ``2 pi rotation_hz t``.

    Every half period of the petal draws one, from the centre out and back.
    """

    kind: Literal["rosette"]
    radius_m: Positive
    petal_hz: Positive
    rotation_hz: Positive
    duration_s: Positive
    """at full radius"""
    lead_s: Lead = LEAD_S

    def plan(self, start_m: Array) -> Plan:
        """Two circles of half the radius against each other: sum and difference of the two frequencies."""
        half, quarter = self.radius_m / 2, math.pi / 2
        both, apart = self.petal_hz + self.rotation_hz, self.petal_hz - self.rotation_hz
        amplitude = np.array([[half, -half, 0.0], [half, half, 0.0]])
        frequency = np.array([[both, both, 0.0], [apart, apart, 0.0]])
        phase = np.array([[0.0, quarter, 0.0], [0.0, quarter, 0.0]])
        return planned(Tones(start_m, amplitude, frequency, phase, self.lead_s, self.duration_s))


def unit(axis: Axis) -> Array:
    """Unit vector (3,) of an axis."""
    return np.array([float(axis == name) for name in ("x", "y", "z")])


def planned(tones: Tones) -> Plan:
    """The scan is the full amplitude."""
    scan_s = (tones.lead_s, tones.lead_s + tones.full_s)
    highest_hz = float(np.abs(tones.frequency_hz).max())
    return Plan((tones,), tones.centre_m, scan_s=scan_s, highest_hz=highest_hz, period_s=common_period_s(tones))


def common_period_s(tones: Tones) -> float | None:
    """The shortest time in which every tone, its frequency as it is written in decimals, does whole periods."""
    moving = (tones.amplitude_m != 0) & (tones.frequency_hz != 0)
    written = [Fraction(repr(abs(f))) for f in tones.frequency_hz[moving].tolist()]
    if not written:
        return None
    denominator = math.lcm(*(f.denominator for f in written))
    return float(denominator / math.gcd(*(int(f * denominator) for f in written)))
