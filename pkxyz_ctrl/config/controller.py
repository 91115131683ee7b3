"""What someone may tune: the law's weights, limits, monitors. Gains are computed from these at start-up."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from pkxyz_ctrl.config.adaptation import Adaptation
from pkxyz_ctrl.config.files import FrozenModel, Name
from pkxyz_ctrl.config.laws import LAWS, SECTIONS, Hinf, Irc, Linear, Mpc, PiNotch, Youla
from pkxyz_ctrl.safety.thresholds import (
    FORCE_CHANGE_MAX_N,
    FORCE_CHANGE_SHARE,
    FORCE_TREND_S,
    INNOVATION_MEMORY_S,
    INNOVATION_SHARE_M_PER_N,
    RESIDUAL_MAX_M,
    SATURATION_SLACK_N,
    UNEXPLAINED_FORCE_MAX_N,
)

Positive = Annotated[float, Field(gt=0)]


class EstimatorConfig(FrozenModel):
    """What the Kalman filter believes besides the sense noise, which is a property of the stage."""

    force_noise_n_per_rthz: Positive
    """Unknown force at the platform, white: how far the model is trusted over a period."""
    disturbance_drift_n_per_rts: Positive
    """Random walk of the disturbance force, N per root second: how fast constant errors are learnt."""


class RegulatorConfig(FrozenModel):
    """Bryson weights of the linear-quadratic regulator (lqg and mpc): deviations that are equally unwelcome. And the
    authority, which limits the feedback of every law.
    """

    position_error_m: Positive
    velocity_error_m_per_s: Positive
    force_n: Positive
    authority_force_n: Positive
    """Least holding force of a comb from which the feedback has its full gain; below it fades out, as combs can't push.
    """


class SetPointsConfig(FrozenModel):
    """How every law but mpc answers to set-points: Bryson weights of the regulator that leads the model along them, the
    same whatever feeds back.
    """

    position_error_m: Positive = 10.0e-9
    velocity_error_m_per_s: Positive = 100.0e-6
    force_n: Positive = 6.0e-6
    """1 um to 10 nm in 1.2 ms, 3 % beyond it"""
    jump_speed_m_per_s: Positive = 15.0e-3
    """where the reference jumps; faster, and the voltages' slew limit makes a far jump swing over"""


class DriveLimitsConfig(FrozenModel):
    """What the controller allows itself at the combs."""

    voltage_max_v: Annotated[float, Field(gt=0, le=1000)]
    slew_max_v_per_s: Positive
    """Most that a commanded voltage may change, as a rate; a tick gets its share."""
    noise_shaping: bool = True


class MonitorConfig(FrozenModel):
    """When something has been wrong for too long. Counts are ticks; 0 trips at once, a negative count switches off."""

    stroke_min_m: float
    stroke_max_m: float
    innovation_max_m: Positive
    residual_max_m: Positive = RESIDUAL_MAX_M
    """Most that a stroke may be from where it was expected; beyond it the measurement is not used."""
    innovation_share_m_per_n: Annotated[float, Field(ge=0)] = INNOVATION_SHARE_M_PER_N
    """More of both while the commanded forces change."""
    innovation_memory_s: Positive = INNOVATION_MEMORY_S
    """So long a change counts."""
    unexplained_force_max_n: Positive = UNEXPLAINED_FORCE_MAX_N
    """Most that a comb's force may be off; where the defaults of this and the next three come from is said there."""
    force_change_max_n: Positive = FORCE_CHANGE_MAX_N
    force_change_share: Annotated[float, Field(ge=0)] = FORCE_CHANGE_SHARE
    """Most that what a force is off may change: so much, and this share of the change that was commanded."""
    force_trend_s: Positive = FORCE_TREND_S
    """Changes are counted from a mean over so long."""
    saturation_slack_n: Annotated[float, Field(ge=0)] = SATURATION_SLACK_N
    """Least force that is withheld by the limits for a tick to count as saturated."""
    stale_count: int
    sequence_count: int
    crc_count: int
    length_count: int
    range_count: int
    frozen_count: int
    innovation_count: int
    residual_count: int = 3
    unexplained_force_count: int = 5
    saturation_count: int
    slew_count: int
    overrun_count: int
    solver_count: int
    frame_leak_ticks: Annotated[int, Field(gt=0)]
    overrun_leak_ticks: Annotated[int, Field(gt=0)]
    safe_cycles: Annotated[int, Field(ge=0)] = 10
    """Ticks in a row at 0 V, with good sense frames, before the loop is closed or a fault cleared."""


class ControllerConfig(FrozenModel):
    """One controller."""

    name: Name
    law: LAWS
    """lqg: Kalman filter and state feedback; youla: lqg and a filter of its innovations; open_loop: feed-forward alone;
    mpc: lqg that plans ahead inside limits; pi_notch, irc, hinf: linear laws, designed; linear: one of the user's own.
    """
    operating_strokes_m: tuple[float, float, float]
    """Strokes about which gains are designed; the energy gradient and the kinematics are exact everywhere."""
    homing_s: Annotated[float, Field(gt=0, le=10)]
    """How long the sense offsets are averaged at 0 V."""
    stop_s: Annotated[float, Field(gt=0, le=10)] = 0.004
    """How long the path takes to stop when it is held, and to be taken up again."""
    landing_s: Annotated[float, Field(gt=0, le=0.05)] = 0.005
    """How long a stop leads the stage down to rest, where combs and sensors can be trusted; then 0 V in any case."""
    learn: Literal["off", "online"] = "off"
    """online: what this device differs in from its stage file is learnt while the loop works"""
    adaptation: Adaptation = Adaptation()
    estimator: EstimatorConfig
    regulator: RegulatorConfig
    set_points: SetPointsConfig = SetPointsConfig()
    limits: DriveLimitsConfig
    monitors: MonitorConfig
    youla: Youla | None = None
    pi_notch: PiNotch | None = None
    irc: Irc | None = None
    hinf: Hinf | None = None
    linear: Linear | None = None
    mpc: Mpc | None = None

    @model_validator(mode="after")
    def _section_of_this_law_alone(self) -> Self:
        for name in SECTIONS:
            is_there = getattr(self, name) is not None
            if is_there and name != self.law:
                raise ValueError(f'section [{name}] belongs to law = "{name}", not to "{self.law}"; remove it')
            if not is_there and name == self.law:
                raise ValueError(f'law = "{name}" needs a section [{name}]; add it')
        return self
