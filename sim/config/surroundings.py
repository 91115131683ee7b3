"""Sections of a plant file about the room and the amplifier's noise. SI units; levels of lines and bands are rms."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from sim.config.device import Finite, Positive
from sim.config.section import Model, NotNegative, RelativePerChain

Level = NotNegative


class Temperature(Model):
    """Distance in K from where the device was measured: a constant, a warming-up that settles, and the slow swing of
    an air conditioning; and what springs, drive combs and sense combs make of it, relative per K."""

    on: bool = False
    offset_k: Finite = 0.0
    settling_k: Finite = 0.0
    settling_s: Positive = 600.0
    swing_k: Finite = 0.0
    swing_period_s: Positive = 1200.0
    stiffness_per_k: Annotated[float, Field(gt=-1e-2, lt=1e-2)] = -60e-6
    comb_gain_per_k: Annotated[float, Field(gt=-1e-2, lt=1e-2)] = 0.0
    sense_gain_per_k: Annotated[float, Field(gt=-1e-2, lt=1e-2)] = 0.0


class Ageing(Model):
    """Springs and drive combs of each chain that change from ``start_s`` on, relative, towards the given value as
    1 - exp(-t / time_constant_s). Of a chain's springs the leaf and the crank's hinge."""

    on: bool = False
    start_s: NotNegative = 0.0
    time_constant_s: Positive = 1.0
    springs: RelativePerChain = (0.0, 0.0, 0.0)
    combs: RelativePerChain = (0.0, 0.0, 0.0)


class BaseNoise(Model):
    """White acceleration of the base on each axis, one-sided density: what sound and machines on the table leave."""

    on: bool = False
    density_m_per_s2_per_rt_hz: tuple[Level, Level, Level] = (0.0, 0.0, 0.0)
    seed_offset: int = 0


class FloorVibration(Model):
    """A floor with the same rms velocity in each one-third octave band between two frequencies, which is what a VC
    curve bounds, under a table on legs of one resonance (none: the table stands on the floor). Each axis has it.

    Each band holds three tones of random phase."""

    on: bool = False
    velocity_m_per_s: Level = 0.0
    lowest_hz: Annotated[float, Field(ge=1.0)] = 1.0
    highest_hz: Annotated[float, Field(le=100.0)] = 80.0
    isolator_hz: Positive | None = None
    isolator_quality: Annotated[float, Field(gt=0.3)] = 3.0
    seed_offset: int = 0


class Harmonic(Model):
    """One line of the mains, rms, of random phase on each axis and channel: shaking of the base, ripple of the
    amplifier, and hum in the sense chain."""

    order: Annotated[int, Field(ge=1, le=20)]
    acceleration_m_per_s2: Level = 0.0
    voltage_v: Level = 0.0
    sense_f: Level = 0.0


class Mains(Model):
    """Lines of the mains: shaking of the base, ripple of the amplifier, hum of the sense chain."""

    on: bool = False
    frequency_hz: Annotated[float, Field(ge=10.0, le=100.0)] = 50.0
    harmonics: Annotated[tuple[Harmonic, ...], Field(max_length=8)] = ()
    seed_offset: int = 0


class Flicker(Model):
    """White noise of one-sided density D and 1/f noise D^2 corner / f from ``lowest_hz`` up."""

    corner_hz: Positive = 1.0
    lowest_hz: Positive = 0.01

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.lowest_hz >= self.corner_hz:
            raise ValueError("lowest_hz must be below corner_hz")
        return self


class AmplifierNoise(Flicker):
    """Noise of each output, white within the amplifier's bandwidth and 1/f below the corner."""

    on: bool = False
    density_v_per_rt_hz: Level = 0.0
    seed_offset: int = 0


class SenseFlicker(Flicker):
    """1/f noise of each sense channel: D^2 corner / f, where D is the density of the white part beside it."""

    on: bool = False
    density_f_per_rt_hz: Level = 0.0
    seed_offset: int = 0
