"""From configuration to the numbers that the cycle runs on: everything that can be computed before the first tick."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig, RegulatorConfig
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.config.laws import Mpc, Youla
from pkxyz_ctrl.core.demand import LINEAR, OPEN_LOOP, PREDICTIVE, STATE_FEEDBACK
from pkxyz_ctrl.design.adaptation import fill_adaptation
from pkxyz_ctrl.design.drive_limits import count_max, slew_counts
from pkxyz_ctrl.design.laws.chosen_law import chosen_law, unwinding
from pkxyz_ctrl.design.laws.estimator_gain import measurement_matrix, measurement_noise, process_noise, steady_filter
from pkxyz_ctrl.design.laws.regulator import cost_to_go, regulator_gain
from pkxyz_ctrl.design.model.discrete_law import LawError
from pkxyz_ctrl.design.model.loop_plant import held_force_softening, loop_plant
from pkxyz_ctrl.design.model.plant_model import LinearStage, SampledStage, amplifier_time_constant_s, linearise, sample
from pkxyz_ctrl.design.noise_shaping import FIRST_ORDER, shaping_between_modes
from pkxyz_ctrl.loop import cycle
from pkxyz_ctrl.safety.thresholds import FORCE_CHANGE_SLOW_N
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]

KINDS = {"open_loop": OPEN_LOOP, "lqg": STATE_FEEDBACK, "youla": STATE_FEEDBACK, "mpc": PREDICTIVE}
"""What the tick calls the laws that are not linear ones."""
RECORDED = ("lqg", "mpc")
"""Laws that keep the bits of their recordings: a filter with K_0 alone, and the ripple of the smooth feed-forward."""
USUAL_PERIOD_US = 200
"""Up to which the monitors' thresholds are those of their file."""
LANDING_TICKS_LEAST = 12
"""A way down in fewer steps shakes the stage: at 1 kHz under lqg 147 of 268 stops of a circle's sampled devices met
their ends with 5, and 5 of 247 with 10.
"""
UNBRAKED_MAX_US, BRAKING_US = 10_000, 5_000
"""The speed v at which a stop meets the stage leads the way down of a time T up to 0.22 v T astray: a circle of 4 um at
100 Hz by 2.8 um in 5 ms, by 5.5 in 10 ms, and by 11 in 20 ms into a stop. So a longer one takes away the speed first,
in this time, and goes down from there, at rest.
"""
BRAKED_TICKS_LEAST = 7, 21
"""Of the two parts. A step of a millisecond gives a device's resonance at 700 Hz a third of what the path has at 300
Hz. In 6 and 16 two of 473 stops out of moves at 2 mm/s met their ends, in 10 and 18 27 of 3900 out of a sweep. In 7 and
21 none of 60 devices that are led down does, out of any motion; of 500 one in moves, 20 % stiffer, at the edge of what
200 V hold.
"""


def design_law(stage: Stage, controller: ControllerConfig, bus: BusConfig, *, autostart: bool) -> NDArray[np.void]:
    """One-element array of ``cycle.LAW``, read-only. Raises ``ConfigError`` for limits that contradict each other and
    for a law that would not be stable with this stage and bus, ``DesignError`` where a cross-check of the gains fails.
    """
    _check_limits(stage, controller, bus)
    model = linearise(stage, np.array(controller.operating_strokes_m))
    if controller.law not in RECORDED:
        model = replace(model, stiffness_n_per_m=_felt_stiffness(stage, model))
    sampled = sample(model, bus.period_s, amplifier_time_constant_s(stage))
    law = np.zeros(1, cycle.LAW)
    _fill_stage(law["tick"], stage, bus)
    variance_m2 = _fill_estimator(law["tick"]["estimator"], stage, controller, bus, model, sampled)
    _fill_feedback(law["tick"]["feedback"], stage, controller, bus, model, sampled)
    _fill_set_points(law["tick"]["set_points"], controller, sampled)
    _fill_drive(law["tick"]["drive"], stage, controller, bus, model)
    fill_adaptation(law["tick"], stage, controller, bus, variance_m2)
    _fill_monitors(law["limits"], controller, bus)
    if controller.law in KINDS:
        law["tick"]["kind"] = KINDS[controller.law]
    else:
        law["tick"]["kind"] = LINEAR
        _fill_linear(law["tick"]["linear"], stage, controller, bus)
    if controller.youla is not None:
        _fill_youla(law["tick"]["youla"], controller.youla, stage, bus)
        law["quiet_holds"] = controller.youla.quiet_holds
    if controller.mpc is not None:
        _fill_predictive(law["tick"], controller.mpc, controller.regulator)
    law["tick"]["delay_periods"] = bus.delay_periods
    law["period_us"] = bus.period_us
    law["homing_ticks"] = max(1, round(controller.homing_s / bus.period_s))
    law["feed_hold_ticks"] = 2 * max(1, round(0.5 * controller.stop_s / bus.period_s))
    law["braking_ticks"], law["landing_ticks"] = way_down_ticks(controller.landing_s, bus.period_us)
    law["autostart"] = autostart
    law.flags.writeable = False
    return law


def way_down_ticks(landing_s: float, period_us: int) -> tuple[int, int]:
    """Ticks in which a stop takes the stage's speed away, and of the whole way down."""
    ticks = max(LANDING_TICKS_LEAST, round(1e6 * landing_s / period_us))
    if ticks * period_us <= UNBRAKED_MAX_US:
        return 0, ticks
    least, least_down = BRAKED_TICKS_LEAST
    braking = max(least, round(BRAKING_US / period_us))
    return braking, max(ticks, braking + least_down)


def _felt_stiffness(stage: Stage, model: LinearStage) -> Array:
    """K_0 - G (3,3) in N/m: what a displacement meets while the combs hold the point. With it in the filter's matrices
    the net input hardly changes along the way of a period; with K_0 alone a circle of 4 um at 100 Hz is predicted wrong
    by 0.4 nm a period, and the feedback makes 3 nm of that.
    """
    return model.stiffness_n_per_m - held_force_softening(stage, model.position_m)


def _check_limits(stage: Stage, controller: ControllerConfig, bus: BusConfig) -> None:
    if controller.limits.voltage_max_v > stage.voltage_max_v:
        raise ConfigError(
            f"controller {controller.name!r}: limits.voltage_max_v = {controller.limits.voltage_max_v:g} V is beyond "
            f"the {stage.voltage_max_v:g} V of stage {stage.config.name!r}; lower it"
        )
    if slew_counts(controller, bus) < 1:
        raise ConfigError(
            f"controller {controller.name!r}: limits.slew_max_v_per_s allows less than one count a tick; raise it"
        )


def _fill_stage(law: Any, stage: Stage, bus: BusConfig) -> None:
    law["geometry"] = stage.geometry
    law["elasticity"] = stage.elasticity
    law["sense"]["farad_per_count"] = bus.analog.sense_farad_per_count
    law["sense"]["offset_f"] = bus.analog.sense_offset_f
    law["sense"]["rest_f"] = stage.sense_rest_f
    law["sense"]["metre_per_farad"] = 1.0 / stage.sense_gradient_f_per_m


def _fill_estimator(
    law: Any, stage: Stage, controller: ControllerConfig, bus: BusConfig, model: LinearStage, sampled: SampledStage
) -> Array:
    """Variance (3,3) in m^2 of the innovations."""
    _, q = process_noise(model, controller.estimator, bus.period_s)
    r = measurement_noise(stage, model, bus)
    law["transition"] = sampled.phi[:6]
    law["input"] = sampled.gamma[:6]
    law["input_lag"] = sampled.gamma_lag[:6]
    law["gain"], variance_m2 = steady_filter(sampled, q, measurement_matrix(stage), r)
    law["stiffness_n_per_m"] = model.stiffness_n_per_m
    law["operating_point_m"] = model.position_m
    law["sense_delay_s"] = stage.sense_delay_s
    law["half_period_s"] = 0.5 * bus.period_s
    law["decoupled"] = _are_diagonal(
        *(law[name][0] for name in ("transition", "input", "input_lag", "stiffness_n_per_m"))
    )
    return variance_m2


def _are_diagonal(*matrices: Array) -> bool:
    """Whether all of these are, block of (3,3) by block: then the tick leaves out what is multiplied by 0."""
    blocks = (np.moveaxis(m.reshape(m.shape[0] // 3, 3, m.shape[1] // 3, 3), 2, 1) for m in matrices)
    return all(not block[..., ~np.eye(3, dtype=bool)].any() for block in blocks)


def _fill_feedback(
    law: Any, stage: Stage, controller: ControllerConfig, bus: BusConfig, model: LinearStage, sampled: SampledStage
) -> None:
    law["position_gain_n_per_m"], law["velocity_gain_n_s_per_m"] = regulator_gain(sampled, controller.regulator)
    law["damping_n_s_per_m"] = model.damping_n_s_per_m
    gains = (law["position_gain_n_per_m"][0], law["velocity_gain_n_s_per_m"][0])
    law["decoupled"] = _are_diagonal(*gains, model.damping_n_s_per_m)
    law["mass_kg"] = model.mass_kg
    law["period_s"] = bus.period_s
    law["ripple_s_per_kg"] = bus.period_s / (12.0 * model.mass_kg)
    law["lead_s"] = 0.5 * bus.period_s + amplifier_time_constant_s(stage)
    if controller.law not in RECORDED:
        law["ripple_s_per_kg"], law["ripple_of_held"] = _ripple_s_per_kg(model, sampled, float(law["lead_s"][0])), 1
    law["authority_force_n"] = controller.regulator.authority_force_n


def _fill_set_points(law: Any, controller: ControllerConfig, sampled: SampledStage) -> None:
    config = controller.set_points
    law["position_gain_n_per_m"], law["velocity_gain_n_s_per_m"] = regulator_gain(sampled, config)
    law["decoupled"] = _are_diagonal(law["position_gain_n_per_m"][0], law["velocity_gain_n_s_per_m"][0])
    finds_its_way = controller.law == "mpc"  # plans inside the limits
    law["jump_step_m"] = math.inf if finds_its_way else config.jump_speed_m_per_s * sampled.period_s


def _ripple_s_per_kg(model: LinearStage, sampled: SampledStage, lead_s: float) -> float:
    """What the velocity along x lacks at the samples for each newton that a held force grows by in a tick, on a ramp.

    The states of the sampled stage are then a + b k, with forces K (k T + lead) + C that the amplifier approaches.
    """
    phi, gamma, lag = sampled.phi[:6, :6], sampled.gamma[:6], sampled.gamma_lag[:6]
    along, rest = np.array([1.0, 0.0, 0.0]), np.eye(6) - phi
    growth = model.stiffness_n_per_m @ along * sampled.period_s
    first = model.stiffness_n_per_m @ along * lead_s + model.damping_n_s_per_m @ along
    b = np.linalg.solve(rest, gamma @ growth)
    a = np.linalg.solve(rest, gamma @ first - lag @ growth - b)
    return float((1.0 - a[3]) / growth[0])


def _fill_linear(record: Any, stage: Stage, controller: ControllerConfig, bus: BusConfig) -> None:
    try:
        law, _ = chosen_law(stage, controller, bus)
        unwind = unwinding(law, loop_plant(stage, bus, controller.operating_strokes_m))
    except LawError as error:
        raise ConfigError(f"controller {controller.name!r}: law {controller.law!r}: {error}") from error
    n = law.order
    record["a"][:, :n, :n], record["b"][:, :n], record["c"][:, :, :n] = law.a, law.b, law.c
    record["d"], record["unwind"][:, :n], record["order"] = law.d, unwind, n


def _fill_youla(record: Any, youla: Youla, stage: Stage, bus: BusConfig) -> None:
    place = youla.place_of_filter(bus.period_us, bus.delay_periods, 1e6 * stage.sense_delay_s)
    if place is not None:
        taps = youla.filter[place]
        quiet_plane, quiet_z = taps.quiet_plane or taps.plane, taps.quiet_z or taps.z
        record["tap_n_per_m"][:, : len(taps.z)] = np.stack([taps.plane, taps.plane, taps.z], axis=1)
        record["quiet_tap_n_per_m"][:, : len(taps.z)] = np.stack([quiet_plane, quiet_plane, quiet_z], axis=1)
        record["taps"] = len(taps.z)
    record["fade_ticks"] = max(1, round(youla.fade_s / bus.period_s))


def _fill_predictive(law: Any, mpc: Mpc, regulator: RegulatorConfig) -> None:
    record, filter_, feedback = law["predictive"], law["estimator"][0], law["feedback"][0]
    position_weight = (regulator.force_n / regulator.position_error_m) ** 2
    velocity_weight = (regulator.force_n / regulator.velocity_error_m_per_s) ** 2
    gain = np.hstack([feedback["position_gain_n_per_m"], feedback["velocity_gain_n_s_per_m"]])
    record["position_weight"], record["velocity_weight"] = position_weight, velocity_weight
    record["cost_to_go"], record["closed"], record["answer"] = cost_to_go(
        filter_["transition"][:, :6], filter_["input"], gain, position_weight, velocity_weight
    )
    for name, value in mpc.model_dump().items():
        record[name] = value


def _fill_drive(law: Any, stage: Stage, controller: ControllerConfig, bus: BusConfig, model: LinearStage) -> None:
    law["force_gain_n_per_v2"] = stage.force_gain_n_per_v2
    law["volt_per_count"] = bus.analog.drive_volt_per_count
    law["count_max"] = count_max(stage, controller, bus)
    law["count_slew_max"] = slew_counts(controller, bus)
    law["noise_shaping"] = controller.limits.noise_shaping
    open_loop = controller.law == "open_loop"  # with feedback, sense noise leaves no tones, and less noise is better
    law["shaping"] = shaping_between_modes(model, bus.period_s) if open_loop else FIRST_ORDER


def _fill_monitors(limits: Any, controller: ControllerConfig, bus: BusConfig) -> None:
    for name, value in controller.monitors.model_dump(exclude={"force_trend_s", "innovation_memory_s"}).items():
        limits[name] = value
    if bus.period_us > USUAL_PERIOD_US:
        limits["force_change_max_n"] += FORCE_CHANGE_SLOW_N
    limits["force_forget_share"] = min(1.0, bus.period_s / controller.monitors.innovation_memory_s)
    limits["force_trend_share"] = min(1.0, bus.period_s / controller.monitors.force_trend_s)
    limits["sense_count_min"], limits["sense_count_max"] = -32768, 32767
    limits["voltage_step_max_v"] = (slew_counts(controller, bus) + 0.5) * bus.analog.drive_volt_per_count
