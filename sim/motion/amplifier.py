"""From counts to volts at the combs.

    target = counts * volt_per_count + offset
    dV/dt = clip((target - V) / tau, +-limit),   limit = min(slew, I / (C(q) + stray))

Solved piecewise: while |target - V| > limit * tau a straight ramp, then an exponential. So over a segment without a
switch every channel is  V(t) = base + slope t + error exp(-t / tau),  with slope or error zero."""

import math

import numpy as np

from sim.motion.geometry import see_sliders, strokes
from sim.motion.kernel import kernel


@kernel
def drive(params: np.ndarray, state: np.ndarray, counts: np.ndarray) -> None:
    """Put ``counts`` (3,) integers on the converters now."""
    p = params[0]
    s = state[0]
    step = p["dac_step"]
    for i in range(3):
        coarse = (int(counts[i]) + step // 2) // step * step
        s["target_v"][i] = coarse * p["volt_per_count"][i] + p["amplifier_offset_v"][i]


@kernel
def plan(p: np.void, s: np.void, remaining_s: float) -> float:
    """Set base, slope and error of all channels from now on; returns how long they hold, s, at most ``remaining_s``."""
    tau = p["amplifier_s"]
    duration = remaining_s
    if p["current_a"] > 0.0:
        strokes(p, s["motion"], s["strokes_m"])
    for i in range(3):
        gap = s["target_v"][i] - s["voltage_v"][i]
        limit = p["slew_v_per_s"]
        if p["current_a"] > 0.0:
            comb_f = 2.0 * p["force_gain_n_per_v2"][i] * (p["overlap_rest_m"] + s["strokes_m"][i])
            limit = min(limit, p["current_a"] / (comb_f + p["stray_f"]))
        beyond = abs(gap) - limit * tau
        if s["held"][i] != 0:  # shorted by snapped fingers
            s["base_v"][i], s["slope_v_per_s"][i], s["error_v"][i] = 0.0, 0.0, 0.0
        elif beyond > 1e-12 * limit:
            s["base_v"][i], s["error_v"][i] = s["voltage_v"][i], 0.0
            s["slope_v_per_s"][i] = math.copysign(limit, gap)
            duration = min(duration, beyond / limit)
        else:
            s["base_v"][i], s["slope_v_per_s"][i] = s["target_v"][i], 0.0
            s["error_v"][i] = -gap if tau > 0.0 and abs(gap) > 1e-12 else 0.0
    return duration


@kernel
def pass_time(s: np.void, h_s: float, decay: float) -> None:
    """Move the channels on by h_s, over which the exponential falls by the factor ``decay``."""
    for i in range(3):
        s["base_v"][i] += s["slope_v_per_s"][i] * h_s
        s["error_v"][i] *= decay
        s["voltage_v"][i] = s["base_v"][i] + s["error_v"][i]


@kernel
def charge(p: np.void, s: np.void, dt_s: float) -> None:
    """Dielectric charging over dt_s: the opposing voltage relaxes towards its share of the comb's voltage at the end
    of the step."""
    kept = math.exp(-dt_s / p["charging_s"])
    for i in range(3):
        goal = p["charging_fraction"] * s["voltage_v"][i]
        s["charge_v"][i] = goal + (s["charge_v"][i] - goal) * kept


@kernel
def snapped(p: np.void, s: np.void) -> int:
    """Look for lateral pull-in; snapped fingers short their comb and hold the slider. Returns the chain or -1."""
    see_sliders(p, s, s["motion"])
    stroke_m = s["slider_m"]
    for i in range(3):
        if s["held"][i] == 0:
            volt = s["voltage_v"][i] - s["charge_v"][i]
            if (p["overlap_rest_m"] + stroke_m[i]) * volt * volt > p["lateral_limit_v2m"][i]:
                s["strokes_m"][i] = stroke_m[i]
                snap(s, i)
                return i
    return -1


@kernel
def snap(s: np.void, i: int) -> None:
    """The fingers of chain i come together at its stroke s["strokes_m"]: shorted and held."""
    s["held"][i] = 1
    s["held_m"][i] = s["strokes_m"][i]
    s["voltage_v"][i] = 0.0
    s["charge_v"][i] = 0.0
