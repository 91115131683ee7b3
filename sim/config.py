"""A plant file: every effect with its own switch and size. SI units.

With ``on = false`` an effect's sizes change nothing. Random effects have ``seed_offset``, which moves that stream
alone."""

import tomllib
from pathlib import Path
from typing import Annotated, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from sim.device import Device, Finite, Positive

__all__ = ["Device", "PlantConfig"]


def _one_file(name: str) -> str:
    if any(c in "/\\" or not c.isprintable() for c in name):
        raise ValueError("names files and folders: no slash, backslash or control character")
    return name


Name = Annotated[str, Field(min_length=1, max_length=100), AfterValidator(_one_file)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Relative = Annotated[float, Field(gt=-0.9, lt=9.0)]
PerChain = tuple[Finite, Finite, Finite]
RelativePerChain = tuple[Relative, Relative, Relative]


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class StiffnessMismatch(_Model):
    """Relative error of each chain's flexures against the drawing."""

    on: bool = False
    leaf: RelativePerChain = (0.0, 0.0, 0.0)
    crank_hinge: RelativePerChain = (0.0, 0.0, 0.0)
    link_hinge: RelativePerChain = (0.0, 0.0, 0.0)


class MassError(_Model):
    on: bool = False
    relative: Relative = 0.0


class Damping(_Model):
    """Modal damping. Without a ``quality_factor`` the stage file's holds; off means no damping at all."""

    on: bool = True
    quality_factor: Positive | None = None


class Gravity(_Model):
    """Weight of the moving mass, with the stage turned by small angles about x and y. With ``level_is_rest`` the rest
    pose was measured on the level stage, so only the change by the tilt acts."""

    on: bool = False
    tilt_x_rad: Finite = 0.0
    tilt_y_rad: Finite = 0.0
    level_is_rest: bool = True
    acceleration_m_per_s2: Positive = 9.80665


class Parasitic(_Model):
    """One more mode, moved by the comb forces and seen by the sense combs through the same shape (that is:
    passively), and by the table through its own. ``compliance_share``: its static compliance as a share of the
    stage's in-plane 1/K_xx."""

    on: bool = False
    frequency_hz: Positive = 2600.0
    quality_factor: Annotated[float, Field(gt=0.5)] = 50.0
    compliance_share: NotNegative = 0.002
    comb_shape: PerChain = (0.82, -0.41, -0.41)
    table_shape: PerChain = (0.0, 0.5, 0.1)


class Drift(_Model):
    """Slow force on the table: an exponential that settles at ``force_n``, and a random walk on each axis."""

    on: bool = False
    force_n: PerChain = (0.0, 0.0, 0.0)
    time_constant_s: Positive = 60.0
    walk_n_per_rt_s: NotNegative = 0.0
    seed_offset: int = 0


class Brownian(_Model):
    """Thermal force that belongs to the damping: one-sided density sqrt(4 k T C)."""

    on: bool = False
    temperature_k: NotNegative = 300.0
    seed_offset: int = 0


class Stops(_Model):
    """Mechanical stops, ``clearance_m`` beyond both ends of the stroke range. Force k d (1 + damping d'), never
    pulling."""

    on: bool = True
    clearance_m: NotNegative = 2e-6
    stiffness_n_per_m: Positive = 2e4
    damping_s_per_m: NotNegative = 5.0


class CombMismatch(_Model):
    """Relative error of each drive comb's force gain."""

    on: bool = False
    relative: RelativePerChain = (0.0, 0.0, 0.0)


class Fringe(_Model):
    """Change of the drive combs' force gain with overlap, relative, over 25 um of stroke."""

    on: bool = False
    relative_per_25um: Annotated[float, Field(gt=-0.5, lt=0.5)] = 0.0


class Levitation(_Model):
    """Out-of-plane force of a comb as a share of its in-plane force; the ground plane below lifts the fingers."""

    on: bool = False
    ratio: Finite = 0.0


class PullIn(_Model):
    """Lateral instability of the drive combs: once 2 n eps0 h (y0 + q) V^2 / g^3 passes ``lateral_stiffness_ratio``
    times the springs' lateral stiffness, the fingers snap together, short the comb and hold the slider where it is."""

    on: bool = True
    lateral_stiffness_ratio: Positive = 1.0


class Charging(_Model):
    """Dielectric charging: an opposing voltage that creeps towards ``fraction`` of the comb voltage."""

    on: bool = False
    fraction: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    time_constant_s: Positive = 5.0


class AmplifierBandwidth(_Model):
    on: bool = True
    corner_hz: Positive = 30e3


class Slew(_Model):
    on: bool = True
    limit_v_per_s: Positive = 20e6


class CurrentLimit(_Model):
    """Output current into the comb and its wiring: |dV/dt| <= I / (C(q) + stray)."""

    on: bool = False
    limit_a: Positive = 1e-3
    stray_f: NotNegative = 20e-12


class AmplifierGain(_Model):
    on: bool = False
    relative: RelativePerChain = (0.0, 0.0, 0.0)


class AmplifierOffset(_Model):
    on: bool = False
    offset_v: PerChain = (0.0, 0.0, 0.0)


class Dac(_Model):
    """A converter coarser than the counts on the wire. Off: as fine as the counts, which are themselves a
    quantisation."""

    on: bool = False
    step_counts: Annotated[int, Field(ge=1, le=4096)] = 1


class SenseNoise(_Model):
    """White noise, one-sided density. A sample's deviation is density * sqrt(f_sample / 2)."""

    on: bool = True
    density_f_per_rt_hz: NotNegative = 5e-18
    seed_offset: int = 0


class SenseBandwidth(_Model):
    on: bool = False
    corner_hz: Positive = 100e3


class SenseDelay(_Model):
    """A sample shows the strokes this long before it was asked for."""

    on: bool = False
    delay_s: Annotated[float, Field(ge=0, le=1e-3)] = 0.0


class SenseGain(_Model):
    """Relative error of each sense comb's gradient and, as curvature, its change over 25 um."""

    on: bool = False
    relative: RelativePerChain = (0.0, 0.0, 0.0)
    curvature_per_25um: Annotated[float, Field(gt=-0.5, lt=0.5)] = 0.0


class SenseOffset(_Model):
    on: bool = False
    offset_f: PerChain = (0.0, 0.0, 0.0)


class SenseDrift(_Model):
    """Random walk of each sense channel's offset."""

    on: bool = False
    walk_f_per_rt_s: NotNegative = 0.0
    seed_offset: int = 0


class SenseAdc(_Model):
    """A converter coarser than the counts on the wire."""

    on: bool = False
    step_counts: Annotated[int, Field(ge=1, le=4096)] = 1


class Feedthrough(_Model):
    """What a sense channel shows of its own drive comb's voltage."""

    on: bool = False
    f_per_v: Finite = 0.0


class PlantConfig(_Model):
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

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read a plant file. Raises OSError, tomllib.TOMLDecodeError or pydantic.ValidationError."""
        return cls.model_validate(tomllib.loads(Path(path).read_text(encoding="utf-8")))
