"""What someone may tune: the law's weights, limits, monitors. Gains are computed from these at start-up."""

from typing import Annotated, Literal

from pydantic import Field

from pkxyz_ctrl.config import FrozenModel

Positive = Annotated[float, Field(gt=0)]


class EstimatorConfig(FrozenModel):
    """What the Kalman filter believes besides the sense noise, which is a property of the stage."""

    force_noise_n_per_rthz: Positive
    """Unknown force at the platform, white: how far the model is trusted over a period."""
    disturbance_drift_n_per_rts: Positive
    """Random walk of the disturbance force, N per root second: how fast constant errors are learnt."""


class RegulatorConfig(FrozenModel):
    """Bryson weights of the linear-quadratic regulator: deviations that are equally unwelcome."""

    position_error_m: Positive
    velocity_error_m_per_s: Positive
    force_n: Positive
    authority_force_n: Positive
    """Least holding force of a comb from which the feedback has its full gain; below it fades out, as combs can't
    push.
    """


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
    stale_count: int
    sequence_count: int
    crc_count: int
    length_count: int
    range_count: int
    frozen_count: int
    innovation_count: int
    saturation_count: int
    slew_count: int
    overrun_count: int
    solver_count: int
    frame_leak_ticks: Annotated[int, Field(gt=0)]
    overrun_leak_ticks: Annotated[int, Field(gt=0)]


class ControllerConfig(FrozenModel):
    """One controller."""

    name: Annotated[str, Field(min_length=1)]
    law: Literal["lqg", "open_loop"]
    """lqg: Kalman filter and state feedback; open_loop: feed-forward alone."""
    operating_strokes_m: tuple[float, float, float]
    """Strokes about which gains are designed; the energy gradient and the kinematics are exact everywhere."""
    homing_s: Annotated[float, Field(gt=0, le=10)]
    """How long the sense offsets are averaged at 0 V."""
    estimator: EstimatorConfig
    regulator: RegulatorConfig
    limits: DriveLimitsConfig
    monitors: MonitorConfig
