"""A plant file: every effect with its own switch and size. SI units.

With ``on = false`` an effect's sizes change nothing. Random effects have
``seed_offset``, which moves that stream alone."""

import tomllib
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from sim.config.device import Device, Finite, Positive
from sim.config.section import Model, NotNegative, PerChain, Relative, RelativePerChain
from sim.config.structure import FingerMisalignment, FlexibleModes, TableTilt
from sim.config.surroundings import (
    Ageing,
    AmplifierNoise,
    BaseNoise,
    FloorVibration,
    Mains,
    SenseFlicker,
    Temperature,
)

__all__ = ["Device", "PlantConfig"]


def _one_file(name: str) -> str:
    if any(c in "/\\" or not c.isprintable() for c in name):
        raise ValueError("names files and folders: no slash, backslash or control character")
    return name


Name = Annotated[str, Field(min_length=1, max_length=100), AfterValidator(_one_file)]


class StiffnessMismatch(Model):
    """Relative error of each chain's flexures against the drawing: K1_i, K2_i (1 + e_i); K3 by the mean
    over the chains."""

    on: bool = False
    leaf: RelativePerChain = (0.0, 0.0, 0.0)
    crank_hinge: RelativePerChain = (0.0, 0.0, 0.0)
    link_hinge: RelativePerChain = (0.0, 0.0, 0.0)


class MassError(Model):
    """Relative error of the moving mass: m (1 + e)."""

    on: bool = False
    relative: Relative = 0.0


class Damping(Model):
    """Modal damping at the rest pose, D = Phi diag(w / Q) Phi^T. Without a ``quality_factor`` the stage file's holds;
    off means no damping at all."""

    on: bool = True
    quality_factor: Positive | None = None


class Gravity(Model):
    """Weight of the moving mass, with the stage turned by small angles about x and y. With ``level_is_rest`` the rest
    pose was measured on the level stage, so only the change by the tilt acts."""

    on: bool = False
    tilt_x_rad: Finite = 0.0
    tilt_y_rad: Finite = 0.0
    level_is_rest: bool = True
    acceleration_m_per_s2: Positive = 9.80665


class Parasitic(Model):
    """One more mode, moved by the comb forces and seen by the sense combs through the same shape (that is:
    passively), and by the table through its own. ``compliance_share``: its static compliance as a share of the
    stage's in-plane 1/K_xx. r'' + (w/Q) r' + w^2 r = w^2 share / K_xx sum u_i F_i; strokes + u_i r, table + t r."""

    on: bool = False
    frequency_hz: Positive = 2600.0
    quality_factor: Annotated[float, Field(gt=0.5)] = 50.0
    compliance_share: NotNegative = 0.002
    comb_shape: PerChain = (0.82, -0.41, -0.41)
    table_shape: PerChain = (0.0, 0.5, 0.1)


class Drift(Model):
    """Slow force on the table: an exponential that settles at ``force_n``, F (1 - exp(-t / tau)), and a
    random walk on each axis."""

    on: bool = False
    force_n: PerChain = (0.0, 0.0, 0.0)
    time_constant_s: Positive = 60.0
    walk_n_per_rt_s: NotNegative = 0.0
    seed_offset: int = 0


class Brownian(Model):
    """Thermal force that belongs to the damping: one-sided density sqrt(4 k T C)."""

    on: bool = False
    temperature_k: NotNegative = 300.0
    seed_offset: int = 0


class Stops(Model):
    """Mechanical stops, ``clearance_m`` beyond both ends of the stroke range. Force
    k d (1 + damping d'), never pulling."""

    on: bool = True
    clearance_m: NotNegative = 2e-6
    stiffness_n_per_m: Positive = 2e4
    damping_s_per_m: NotNegative = 5.0


class CombMismatch(Model):
    """Relative error of each drive comb's force gain: k_i (1 + e_i) in F_i = k_i (V_i - V_c,i)^2."""

    on: bool = False
    relative: RelativePerChain = (0.0, 0.0, 0.0)


class Fringe(Model):
    """Change of the drive combs' force gain with overlap, relative, over 25 um of stroke: k_i (1 + phi q_i)."""

    on: bool = False
    relative_per_25um: Annotated[float, Field(gt=-0.5, lt=0.5)] = 0.0


class Levitation(Model):
    """Out-of-plane force of a comb as a share of its in-plane force; the ground plane below lifts the fingers:
    F_z += ratio sum F_i."""

    on: bool = False
    ratio: Finite = 0.0


class PullIn(Model):
    """Lateral instability of the drive combs: once 2 n eps0 h (y0 + q) V^2 / g^3 passes ``lateral_stiffness_ratio``
    times the springs' lateral stiffness, the fingers snap together, short the comb and hold the slider where it is."""

    on: bool = True
    lateral_stiffness_ratio: Positive = 1.0


class Charging(Model):
    """Dielectric charging: an opposing voltage that creeps towards ``fraction`` of the comb voltage:
    V_c' = (fraction V - V_c) / tau, once a call of ``advance``."""

    on: bool = False
    fraction: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    time_constant_s: Positive = 5.0


class AmplifierBandwidth(Model):
    """First-order lag of each output: V' = 2 pi corner_hz (target - V)."""

    on: bool = True
    corner_hz: Positive = 30e3


class Slew(Model):
    """Bound on the rate of each output, |V'|."""

    on: bool = True
    limit_v_per_s: Positive = 20e6


class CurrentLimit(Model):
    """Output current into the comb and its wiring: |dV/dt| <= I / (C(q) + stray)."""

    on: bool = False
    limit_a: Positive = 1e-3
    stray_f: NotNegative = 20e-12


class AmplifierGain(Model):
    """Relative error of each output: target = counts scale (1 + e_i) + offset_i."""

    on: bool = False
    relative: RelativePerChain = (0.0, 0.0, 0.0)


class AmplifierOffset(Model):
    """Offset of each output."""

    on: bool = False
    offset_v: PerChain = (0.0, 0.0, 0.0)


class Dac(Model):
    """A converter coarser than the counts on the wire. Off: as fine as the counts,
    which are themselves a quantisation."""

    on: bool = False
    step_counts: Annotated[int, Field(ge=1, le=4096)] = 1


class SenseNoise(Model):
    """White noise, one-sided density, of each channel.

    ``per_sample``: a deviate for each sample of deviation density * sqrt(f_sample / 2), whatever the bandwidth.
    ``through_chain``: the noise passes the low-pass of ``sense_bandwidth`` as the strokes do, and is sampled as it is:
    deviation density * sqrt(pi / 2 * corner), with what folds, and correlated from sample to sample."""

    on: bool = True
    density_f_per_rt_hz: NotNegative = 5e-18
    sampled: Literal["per_sample", "through_chain"] = "per_sample"
    seed_offset: int = 0


class SenseBandwidth(Model):
    """First-order low-pass of each channel. It lags 1 / (2 pi corner_hz)."""

    on: bool = False
    corner_hz: Positive = 100e3


class SenseDelay(Model):
    """A sample shows the strokes this long before it was asked for."""

    on: bool = False
    delay_s: Annotated[float, Field(ge=0, le=1e-3)] = 0.0


class SenseGain(Model):
    """Relative error of each sense comb's gradient and, as curvature, its change over 25 um: g (1 + e_i),
    q (1 + c q / 2)."""

    on: bool = False
    relative: RelativePerChain = (0.0, 0.0, 0.0)
    curvature_per_25um: Annotated[float, Field(gt=-0.5, lt=0.5)] = 0.0


class SenseOffset(Model):
    """Constant offset of each sense channel."""

    on: bool = False
    offset_f: PerChain = (0.0, 0.0, 0.0)


class SenseDrift(Model):
    """Random walk of each sense channel's offset."""

    on: bool = False
    walk_f_per_rt_s: NotNegative = 0.0
    seed_offset: int = 0


class SenseAdc(Model):
    """A converter coarser than the counts on the wire."""

    on: bool = False
    step_counts: Annotated[int, Field(ge=1, le=4096)] = 1


class Feedthrough(Model):
    """What a sense channel shows of its own drive comb's voltage, past the chain's filter."""

    on: bool = False
    f_per_v: Finite = 0.0


class Crosstalk(Model):
    """What reaches a sense channel's input from the drive: its own comb's voltage, those of the other two, and the
    current through what couples them, of its own comb's dV/dt. All of it through the chain's filter."""

    on: bool = False
    own_f_per_v: Finite = 0.0
    others_f_per_v: Finite = 0.0
    rate_f_per_v_per_s: Finite = 0.0


class PlantConfig(Model):
    """All effects of one plant. The defaults are the nominal plant."""

    name: Name = "nominal"
    stiffness_mismatch: StiffnessMismatch = StiffnessMismatch()
    mass_error: MassError = MassError()
    damping: Damping = Damping()
    gravity: Gravity = Gravity()
    parasitic: Parasitic = Parasitic()
    drift: Drift = Drift()
    brownian: Brownian = Brownian()
    stops: Stops = Stops()
    comb_mismatch: CombMismatch = CombMismatch()
    fringe: Fringe = Fringe()
    levitation: Levitation = Levitation()
    pull_in: PullIn = PullIn()
    charging: Charging = Charging()
    amplifier_bandwidth: AmplifierBandwidth = AmplifierBandwidth()
    slew: Slew = Slew()
    current_limit: CurrentLimit = CurrentLimit()
    amplifier_gain: AmplifierGain = AmplifierGain()
    amplifier_offset: AmplifierOffset = AmplifierOffset()
    dac: Dac = Dac()
    sense_noise: SenseNoise = SenseNoise()
    sense_bandwidth: SenseBandwidth = SenseBandwidth()
    sense_delay: SenseDelay = SenseDelay()
    sense_gain: SenseGain = SenseGain()
    sense_offset: SenseOffset = SenseOffset()
    sense_drift: SenseDrift = SenseDrift()
    sense_adc: SenseAdc = SenseAdc()
    feedthrough: Feedthrough = Feedthrough()
    crosstalk: Crosstalk = Crosstalk()
    sense_flicker: SenseFlicker = SenseFlicker()
    amplifier_noise: AmplifierNoise = AmplifierNoise()
    flexible_modes: FlexibleModes = FlexibleModes()
    finger_misalignment: FingerMisalignment = FingerMisalignment()
    table_tilt: TableTilt = TableTilt()
    base_noise: BaseNoise = BaseNoise()
    floor_vibration: FloorVibration = FloorVibration()
    mains: Mains = Mains()
    temperature: Temperature = Temperature()
    ageing: Ageing = Ageing()

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if self.sense_noise.on and self.sense_noise.sampled == "through_chain" and not self.sense_bandwidth.on:
            raise ValueError('sense_noise.sampled = "through_chain" needs sense_bandwidth on: it is what it passes')
        if self.crosstalk.on and self.crosstalk.rate_f_per_v_per_s != 0.0 and not self.sense_bandwidth.on:
            raise ValueError("crosstalk.rate_f_per_v_per_s needs sense_bandwidth on: a step's rate has no end without")
        if self.parasitic.on and (self.flexible_modes.on or self.amplifier_noise.on):
            raise ValueError(
                "parasitic is a one-way mode for plants without amplifier_noise and flexible_modes; give it as one of "
                "flexible_modes.modes"
            )
        return self

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read a plant file. Raises OSError, tomllib.TOMLDecodeError or pydantic.ValidationError."""
        return cls.model_validate(tomllib.loads(Path(path).read_text(encoding="utf-8")))
