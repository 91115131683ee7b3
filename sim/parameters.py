"""From a device and a plant file to the record of parameters and a state at rest."""

import math

import numpy as np

from sim.config import Device, PlantConfig
from sim.motion import layout
from sim.motion.at_rest import STILL_M, linearise, settle
from sim.motion.geometry import strokes
from sim.motion.integrator import LONGEST_S
from sim.motion.kernel import kernel
from sim.motion.layout import PARAMS, STATE
from sim.motion.parasitic import rest
from sim.motion.streams import start_streams
from sim.structure.build import build_flexible_modes, build_general_response, build_misalignment, build_tilt
from sim.structure.pose import combs_seen
from sim.structure.side import balance
from sim.surroundings.build import build_surroundings, seed_offsets, start_surroundings
from sim.surroundings.slow import grow_old

EPSILON_0_F_PER_M = 8.8541878128e-12  # CODATA 2018
BOLTZMANN_J_PER_K = 1.380649e-23  # SI 2019, exact
STROKE_SCALE_M = 25e-6  # changes "over 25 um" in the plant file


def build_parameters(
    config: PlantConfig,
    device: Device,
    *,
    period_us: int,
    drive_v_per_count: float,
    sense_f_per_count: float,
    sense_zero_f: float,
) -> np.ndarray:
    """Record of parameters, one element of ``layout.PARAMS``. ``period_us`` fixes the noise bandwidth of a sample."""
    params = np.zeros(1, PARAMS)
    p = params[0]
    _mechanism(p, config, device)
    _drive_combs(p, config, device)
    _amplifier(p, config, drive_v_per_count)
    quality, stiff = config.damping.quality_factor or device.dynamics.quality_factor, np.empty((3, 3))
    linearise(params, quality if config.damping.on else 0.0, stiff)
    step_s = period_us * 1e-6
    p["regular_s"] = step_s / math.ceil(step_s / LONGEST_S)
    _modes_and_forces(p, config, stiff)
    _sense_chain(p, config, device, period_us, sense_f_per_count, sense_zero_f)
    build_flexible_modes(p, config.flexible_modes, stiff)
    build_tilt(p, config.table_tilt)
    build_surroundings(p, config)
    p["general_on"] = any(
        p[name] for name in ("mode_count", "misaligned_on", "shaken_on", "tone_count", "amplifier_noise_on")
    ) or bool(p["sense_flicker_on"])
    if p["general_on"]:
        build_general_response(p, stiff)
    if p["slow_on"]:
        grow_old(p, 0)
    return params


def _mechanism(p: np.void, config: PlantConfig, device: Device) -> None:
    f = device.flexures
    projection_m, height_m = device.geometry.link_rest_m
    p["crank_m"] = device.geometry.crank_length_m
    p["link_m"] = math.hypot(projection_m, height_m)
    p["projection_rest_m"], p["height_rest_m"] = projection_m, height_m
    # one folded spring is two clamped beams in series; a beam of length l gives E h t^3 / l^3
    # (paper Eq. 26: four of these)
    leaf = (
        4
        * f.youngs_modulus_pa
        * f.leaf_height_m
        * f.leaf_thickness_m**3
        / (f.leaf_inner_length_m**3 + f.leaf_outer_length_m**3)
    )
    crank = f.youngs_modulus_pa * f.crank_hinge_height_m * f.crank_hinge_thickness_m**3 / 12 / f.crank_hinge_length_m
    link = f.youngs_modulus_pa * f.link_hinge_width_m * f.link_hinge_thickness_m**3 / 12 / f.link_hinge_length_m
    mismatch = config.stiffness_mismatch
    leaf_error, crank_error, link_error = (
        error if mismatch.on else (0.0, 0.0, 0.0)
        for error in (mismatch.leaf, mismatch.crank_hinge, mismatch.link_hinge)
    )
    p["leaf_n_per_m"] = [4 * leaf * (1 + error) for error in leaf_error]
    p["crank_hinge_nm"] = [4 * crank * (1 + error) for error in crank_error]
    p["link_hinge_nm"] = 4 * f.out_of_plane_chains * link * (1 + sum(link_error) / 3)
    mass_kg = device.dynamics.mass_kg * (1 + (config.mass_error.relative if config.mass_error.on else 0.0))
    p["mass_kg"], p["per_kg"], p["weight_n"] = mass_kg, 1 / mass_kg, _weight(config, mass_kg)
    p["per_crank"], p["per_link2"] = 1 / device.geometry.crank_length_m, 1 / p["link_m"] ** 2
    stops = config.stops
    far_m = 1.0  # no stop
    p["stop_low_m"] = device.limits.stroke_min_m - stops.clearance_m if stops.on else -far_m
    p["stop_high_m"] = device.limits.stroke_max_m + stops.clearance_m if stops.on else far_m
    p["stop_n_per_m"], p["stop_damping_s_per_m"] = stops.stiffness_n_per_m, stops.damping_s_per_m


def _weight(config: PlantConfig, mass_kg: float) -> np.ndarray:
    g = config.gravity
    if not g.on:
        return np.zeros(3)
    # the stage turned by tilt_x about x, then tilt_y about y: 'down' as the stage sees it
    down = np.array(
        [
            math.cos(g.tilt_x_rad) * math.sin(g.tilt_y_rad),
            -math.sin(g.tilt_x_rad),
            -math.cos(g.tilt_x_rad) * math.cos(g.tilt_y_rad),
        ]
    )
    if g.level_is_rest:
        down[2] += 1.0
    return mass_kg * g.acceleration_m_per_s2 * down


def _drive_combs(p: np.void, config: PlantConfig, device: Device) -> None:
    comb, f = device.drive_comb, device.flexures
    gain = comb.finger_count * EPSILON_0_F_PER_M * comb.finger_height_m / comb.finger_gap_m
    error = np.array(config.comb_mismatch.relative) if config.comb_mismatch.on else np.zeros(3)
    p["force_gain_n_per_v2"] = gain * (1 + error)
    p["fringe_per_m"] = config.fringe.relative_per_25um / STROKE_SCALE_M if config.fringe.on else 0.0
    p["levitation"] = config.levitation.ratio if config.levitation.on else 0.0
    p["overlap_rest_m"] = comb.overlap_rest_m
    # lateral stiffness of a slider: its four folded springs across the motion,
    # each two leaves in series along their length
    lateral = (
        16
        * f.youngs_modulus_pa
        * f.leaf_height_m
        * f.leaf_thickness_m
        / (f.leaf_inner_length_m + f.leaf_outer_length_m)
    )
    per_volt2_m = 2 * gain / comb.finger_gap_m**2
    p["lateral_limit_v2m"] = (
        config.pull_in.lateral_stiffness_ratio * lateral / per_volt2_m if config.pull_in.on else np.inf
    )
    build_misalignment(p, config.finger_misalignment, device, config.pull_in.lateral_stiffness_ratio * lateral)
    p["charging_on"] = config.charging.on
    p["charging_fraction"], p["charging_s"] = config.charging.fraction, config.charging.time_constant_s


def _amplifier(p: np.void, config: PlantConfig, v_per_count: float) -> None:
    unlimited_v_per_s = 1e18
    p["amplifier_s"] = (
        1 / (2 * math.pi * config.amplifier_bandwidth.corner_hz) if config.amplifier_bandwidth.on else 0.0
    )
    p["slew_v_per_s"] = config.slew.limit_v_per_s if config.slew.on else unlimited_v_per_s
    p["current_a"] = config.current_limit.limit_a if config.current_limit.on else 0.0
    p["stray_f"] = config.current_limit.stray_f
    p["volt_per_count"] = v_per_count * (1 + np.array(config.amplifier_gain.relative) * config.amplifier_gain.on)
    p["amplifier_offset_v"] = np.array(config.amplifier_offset.offset_v) * config.amplifier_offset.on
    p["dac_step"] = config.dac.step_counts if config.dac.on else 1


def _modes_and_forces(p: np.void, config: PlantConfig, rest_n_per_m: np.ndarray) -> None:
    mode = config.parasitic
    p["parasitic_on"] = mode.on
    w = 2 * math.pi * mode.frequency_hz
    p["parasitic_rad_per_s"], p["parasitic_damping_per_s"] = w, w / mode.quality_factor
    p["parasitic_per_kg"] = mode.compliance_share * w**2 / rest_n_per_m[0, 0]
    p["parasitic_comb"], p["parasitic_table"] = mode.comb_shape, mode.table_shape
    p["drift_on"] = config.drift.on
    p["drift_n"], p["drift_s"] = config.drift.force_n, config.drift.time_constant_s
    p["drift_walk_n_per_rt_s"] = config.drift.walk_n_per_rt_s
    if config.brownian.on:  # two-sided density 2 k T C, held over a step dt: variance 2 k T C / dt
        damping = np.diag(p["damping_per_s"]) * p["mass_kg"]
        p["brownian_n_rt_s"] = np.sqrt(2 * BOLTZMANN_J_PER_K * config.brownian.temperature_k * damping)


def _sense_chain(
    p: np.void, config: PlantConfig, device: Device, period_us: int, f_per_count: float, zero_f: float
) -> None:
    comb = device.sense_comb
    gradient = 2 * comb.finger_count * EPSILON_0_F_PER_M * comb.finger_height_m / comb.finger_gap_m
    gain = config.sense_gain
    p["sense_f_per_m"] = gradient * (1 + np.array(gain.relative) * gain.on)
    p["sense_curvature_per_m"] = gain.curvature_per_25um / STROKE_SCALE_M * gain.on
    p["sense_rest_f"] = gradient * comb.overlap_rest_m
    p["sense_offset_f"] = np.array(config.sense_offset.offset_f) * config.sense_offset.on
    noise = config.sense_noise
    sample_hz = 1e6 / period_us
    if noise.sampled == "per_sample":
        p["sense_noise_f"] = noise.density_f_per_rt_hz * math.sqrt(sample_hz / 2) * noise.on
    else:  # variance D^2 / (4 tau)
        p["sense_chain_noise_f"] = (
            noise.density_f_per_rt_hz * math.sqrt(0.5 * math.pi * config.sense_bandwidth.corner_hz) * noise.on
        )
    talk = config.crosstalk
    p["crosstalk_on"] = talk.on
    p["crosstalk_own_f_per_v"], p["crosstalk_others_f_per_v"] = talk.own_f_per_v, talk.others_f_per_v
    p["crosstalk_rate_f_per_v_per_s"] = talk.rate_f_per_v_per_s
    p["sense_filter_s"] = 1 / (2 * math.pi * config.sense_bandwidth.corner_hz) if config.sense_bandwidth.on else 0.0
    p["sense_delay_us"] = config.sense_delay.delay_s * 1e6 * config.sense_delay.on
    p["sense_walk_f_per_rt_s"] = config.sense_drift.walk_f_per_rt_s * config.sense_drift.on
    p["feedthrough_f_per_v"] = config.feedthrough.f_per_v * config.feedthrough.on
    p["count_f"], p["count_zero_f"] = f_per_count, zero_f
    p["adc_step"] = config.sense_adc.step_counts if config.sense_adc.on else 1


def state_at_rest(params: np.ndarray, config: PlantConfig, seed: int) -> np.ndarray:
    """State, one element of ``layout.STATE``, in static equilibrium with zero counts on the converters."""
    state = np.zeros(1, STATE)
    p, s = params[0], state[0]
    s["target_v"] = s["voltage_v"] = p["amplifier_offset_v"]
    s["force_n"] = p["weight_n"]
    s["slider_at_m"] = np.inf  # nowhere yet
    volt2 = s["voltage_v"] ** 2
    s["motion"][:3] = equilibrium(params, state, volt2)
    if p["parasitic_on"]:
        s["parasitic"][0] = rest(p, volt2)
    bend(p, s, volt2)
    if p["misaligned_on"]:
        balance(p, s)
    _see(params, state)
    s["knot_m"][0] = s["filtered_m"]
    s["knot_count"] = 1
    s["filtered_v"] = s["voltage_v"]
    s["comb_rise"] = np.where(s["comb_rise"] > 0.0, s["comb_rise"], 1.0)
    offsets = {
        layout.BROWNIAN_STREAM: config.brownian.seed_offset,
        layout.DRIFT_STREAM: config.drift.seed_offset,
        **{layout.SENSE_STREAM + i: config.sense_noise.seed_offset for i in range(3)},
        **{layout.SENSE_DRIFT_STREAM + i: config.sense_drift.seed_offset for i in range(3)},
        **seed_offsets(config),
    }
    start_streams(s["random"], seed, offsets)
    start_surroundings(p, s, config)
    return state


def bend(p: np.void, s: np.void, volt2: np.ndarray) -> None:
    """Static flexible modes under squared voltages (3,) and the constant force, from a mechanism at rest in
    s["motion"], which becomes the table's."""
    if not p["mode_count"]:
        return
    strokes(p, s["motion"], s["strokes_m"])
    force_n = p["force_gain_n_per_v2"] * (1 + p["fringe_per_m"] * s["strokes_m"]) * volt2
    for k in range(p["mode_count"]):  # the mechanism's own forces carry the constant one
        push = p["mode_comb"][k] @ force_n + p["mode_table"][k] @ s["force_n"]
        s["modes"][0, k] = push * p["mode_per_kg"][k] / p["mode_w2_per_s2"][k]
        s["motion"][:3] += p["mode_table"][k] * s["modes"][0, k]


@kernel
def _see(params: np.ndarray, state: np.ndarray) -> None:
    """What the sense chain starts from. Records in arrays: numba takes twenty times as long to tell the type of one
    alone."""
    s = state[0]
    combs_seen(params[0], s, s["filtered_m"], s["rates_m_per_s"])


def equilibrium(params: np.ndarray, state: np.ndarray, volt2: np.ndarray) -> np.ndarray:
    """Position (3,), m, where elastic, comb and constant forces balance, by Newton's method from rest.

    Raises ArithmeticError if it does not settle, which needs forces far beyond the stage's own."""
    x = np.zeros(3)
    moves_m = settle(params, state, volt2, x, np.empty(3), np.empty((3, 3)))
    if not moves_m < STILL_M:
        raise ArithmeticError(f"no static equilibrium near rest: the table still moves by {moves_m:.1e} m")
    return x
