"""From strokes to sense counts.

    C_i = C_rest + g_i (q_i + c q_i^2 / 2) + offset_i + walk_i + feedthrough V_i + crosstalk_i + noise
    counts = round((C_i - zero) / scale), saturated to int16

q_i is the slider's stroke with the modes' part, after a first-order filter and a delay where these are on. Filter and
delay see the strokes as a cubic through value and rate at both ends of each step. Crosstalk and the noise of a chain
``through_chain`` pass the same filter: with tau its time constant and D the one-sided density,

    n' = (white - n) / tau:  deviation D / (2 sqrt(tau)), correlated as exp(-t / tau) from sample to sample."""

import math

import numpy as np

from sim.motion.geometry import see_sliders
from sim.motion.kernel import kernel
from sim.motion.layout import KNOTS, SENSE_DRIFT_STREAM, SENSE_STREAM
from sim.motion.noise import normal, total
from sim.structure.pose import combs_seen
from sim.surroundings.tones import hum


@kernel
def _filtered(tau: float, h: float, q0: float, v0: float, q1: float, v1: float, f0: float) -> float:
    """End value of f' = (q - f) / tau over h s, for the cubic q(t) with these values and rates at its ends, from f0."""
    a3 = (2.0 * (q0 - q1) / h + v0 + v1) / (h * h)
    a2 = (3.0 * (q1 - q0) / h - 2.0 * v0 - v1) / h
    c3 = a3
    c2 = a2 - 3.0 * tau * c3
    c1 = v0 - 2.0 * tau * c2
    c0 = q0 - tau * c1
    return c0 + h * (c1 + h * (c2 + h * c3)) + (f0 - c0) * math.exp(-h / tau)


@kernel
def follow(p: np.void, s: np.void, h: float, t_us: float) -> None:
    """Move filter and memory of the sense chain on over the step of h s that just ended at t_us. s["before_m"] and
    s["before_m_per_s"] are the strokes and rates at its start."""
    q, v = s["strokes_m"], s["rates_m_per_s"]
    combs_seen(p, s, q, v)
    n = s["knot_count"] % KNOTS
    s["knot_count"] += 1
    s["knot_t_us"][n] = t_us
    tau = p["sense_filter_s"]
    for i in range(3):
        if tau > 0.0:
            f = _filtered(tau, h, s["before_m"][i], s["before_m_per_s"][i], q[i], v[i], s["filtered_m"][i])
            s["knot_m_per_s"][n, i] = (q[i] - f) / tau
        else:
            f = q[i]
            s["knot_m_per_s"][n, i] = v[i]
        s["filtered_m"][i] = f
        s["knot_m"][n, i] = f


@kernel
def _remembered(p: np.void, s: np.void, out_m: np.ndarray) -> None:
    """Filtered strokes (3,) at the delay before now, by the cubic between the knots around that time; at most as old
    as the oldest knot."""
    wanted_us = s["t_us"] - p["sense_delay_us"]
    newest = s["knot_count"] - 1
    oldest = max(0, s["knot_count"] - KNOTS)
    late = newest
    while late > oldest and s["knot_t_us"][(late - 1) % KNOTS] >= wanted_us:
        late -= 1
    if late == oldest:
        for i in range(3):
            out_m[i] = s["knot_m"][late % KNOTS, i]
        return
    a, b = (late - 1) % KNOTS, late % KNOTS
    h = (s["knot_t_us"][b] - s["knot_t_us"][a]) * 1e-6
    u = (wanted_us - s["knot_t_us"][a]) * 1e-6 / h
    for i in range(3):
        rise = s["knot_m"][b, i] - s["knot_m"][a, i]
        v0, v1 = s["knot_m_per_s"][a, i] * h, s["knot_m_per_s"][b, i] * h
        out_m[i] = s["knot_m"][a, i] + u * (v0 + u * (3.0 * rise - 2.0 * v0 - v1 + u * (v0 + v1 - 2.0 * rise)))


@kernel
def follow_voltages(p: np.void, s: np.void, h: float) -> None:
    """Move the filtered voltages on over the coming h s, in which V = base + slope t + error exp(-t / tau_a)."""
    tau, lag = p["sense_filter_s"], p["amplifier_s"]
    kept = math.exp(-h / tau)
    for i in range(3):
        ramp = s["base_v"][i] - s["slope_v_per_s"][i] * tau
        start, end = ramp, ramp + s["slope_v_per_s"][i] * h
        if lag > 0.0 and s["error_v"][i] != 0.0:
            part = s["error_v"][i] / (1.0 - tau / lag if tau != lag else 1e-9)
            start, end = start + part, end + part * math.exp(-h / lag)
        s["filtered_v"][i] = end + (s["filtered_v"][i] - start) * kept


@kernel
def pass_noise(p: np.void, s: np.void, dt_s: float) -> None:
    """Move the filtered noise of the channels on over dt_s, in deviations."""
    kept = math.exp(-dt_s / p["sense_filter_s"])
    fresh = math.sqrt(1.0 - kept * kept)
    for i in range(3):
        n = SENSE_STREAM + i
        s["sense_chain_noise"][i] = s["sense_chain_noise"][i] * kept + fresh * normal(s["random"][n], s["spare"][n])


@kernel
def _crosstalk(p: np.void, s: np.void, i: int) -> float:
    """What channel i shows of the drive, F."""
    volt, tau = s["filtered_v"] if p["sense_filter_s"] > 0.0 else s["voltage_v"], p["sense_filter_s"]
    farad = p["crosstalk_own_f_per_v"] * volt[i]
    for j in range(3):
        if j != i:
            farad += p["crosstalk_others_f_per_v"] * volt[j]
    if tau > 0.0:  # of a filter, what it shows of the rate is what it lags by, over tau
        farad += p["crosstalk_rate_f_per_v_per_s"] * (s["voltage_v"][i] - volt[i]) / tau
    return float(farad)


@kernel
def walk(p: np.void, s: np.void, dt_s: float) -> None:
    """Random walk of the channels' offsets over dt_s."""
    size = p["sense_walk_f_per_rt_s"] * math.sqrt(dt_s)
    for i in range(3):
        s["sense_walk_f"][i] += size * normal(s["random"][SENSE_DRIFT_STREAM + i], s["spare"][SENSE_DRIFT_STREAM + i])


@kernel
def sample(params: np.ndarray, state: np.ndarray, counts: np.ndarray) -> None:
    """Sample the three channels now into ``counts`` (3,) integers; draws their noise."""
    p = params[0]
    s = state[0]
    q = s["strokes_m"]
    if p["sense_delay_us"] > 0.0:
        _remembered(p, s, q)
    elif p["sense_filter_s"] > 0.0:
        for i in range(3):
            q[i] = s["filtered_m"][i]
    else:
        if p["mode_count"] > 0:
            combs_seen(p, s, q, s["rates_m_per_s"])
        else:
            see_sliders(p, s, s["motion"])
            for i in range(3):
                q[i] = s["slider_m"][i]
        if p["parasitic_on"] != 0:
            for i in range(3):
                q[i] += p["parasitic_comb"][i] * s["parasitic"][0]
    step, white = p["adc_step"], s["sense_white"]
    per_count, per_step = 1.0 / p["count_f"], 1.0 / step
    for i in range(3):  # by themselves: which way a draw goes nobody foresees, and what is under way then is lost
        n = SENSE_STREAM + i
        white[i] = normal(s["random"][n], s["spare"][n]) if p["sense_noise_f"] > 0.0 else 0.0
    for i in range(3):
        farad = p["sense_rest_f"] + p["sense_f_per_m"][i] * q[i] * (1.0 + 0.5 * p["sense_curvature_per_m"] * q[i])
        farad += p["sense_offset_f"][i] + s["sense_walk_f"][i] + p["feedthrough_f_per_v"] * s["voltage_v"][i]
        farad += p["sense_noise_f"] * white[i]
        if p["sense_chain_noise_f"] > 0.0:
            farad += p["sense_chain_noise_f"] * s["sense_chain_noise"][i]
        if p["crosstalk_on"] != 0:
            farad += _crosstalk(p, s, i)
        if p["sense_flicker_on"] != 0:
            farad += p["sense_flicker_f"] * total(s["sense_flicker"][i])
        if p["tone_count"] > 0:
            farad += hum(p, s, i)
        fine = max(-40000.0, min(40000.0, (farad - p["count_zero_f"]) * per_count))  # before floor: it makes an int
        counts[i] = min(32767, max(-32768, math.floor(fine * per_step + 0.5) * step))
