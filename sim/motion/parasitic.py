"""The parasitic mode: an oscillator of its own, driven by the comb forces F_i and seen beside the rigid motion.

    r'' + d r' + w^2 r = (sum_i u_i F_i) / m_p;   stroke_i += u_i r,   table += t r

One way: the mode does not act back on the rigid motion. With each comb's gain frozen at the start of a step the right
side is a0 + a1 t + a2 t^2 + b1 E + b2 E^2, E = exp(-t / tau), whose response is known exactly for any step."""

import math

import numpy as np

from sim.motion.geometry import strokes
from sim.motion.kernel import kernel


@kernel
def parasitic_step(p: np.void, s: np.void, h: float) -> None:
    """Move the mode on by h s under the channels' base, slope and error; call before the rigid step."""
    strokes(p, s["motion"], s["strokes_m"])
    a0, a1, a2, b1, b2 = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        if s["held"][i] == 0:
            gain = p["force_gain_n_per_v2"][i] * (1.0 + p["fringe_per_m"] * s["strokes_m"][i])
            gain *= p["parasitic_comb"][i] * p["parasitic_per_kg"]
            volt = s["base_v"][i] - s["charge_v"][i]
            rise, error = s["slope_v_per_s"][i], s["error_v"][i]
            a0 += gain * volt * volt
            a1 += gain * 2.0 * volt * rise
            a2 += gain * rise * rise
            b1 += gain * 2.0 * volt * error
            b2 += gain * error * error
    w2, d = p["parasitic_rad_per_s"] ** 2, p["parasitic_damping_per_s"]
    p2 = a2 / w2
    p1 = (a1 - 2.0 * d * p2) / w2
    p0 = (a0 - d * p1 - 2.0 * p2) / w2
    k = 1.0 / p["amplifier_s"] if p["amplifier_s"] > 0.0 else 0.0
    b1 /= k * k - d * k + w2
    b2 /= 4.0 * k * k - 2.0 * d * k + w2
    e = math.exp(-k * h)
    r = s["parasitic"][0] - (p0 + b1 + b2)
    v = s["parasitic"][1] - (p1 - k * b1 - 2.0 * k * b2)
    half = 0.5 * d
    w = math.sqrt(w2 - half * half)
    fall, cosine, sine = math.exp(-half * h), math.cos(w * h), math.sin(w * h)
    s["parasitic"][0] = fall * (r * cosine + (v + half * r) / w * sine) + p0 + (p1 + p2 * h) * h + b1 * e + b2 * e * e
    s["parasitic"][1] = (
        fall * (v * cosine - (half * v + w2 * r) / w * sine) + p1 + 2.0 * p2 * h - k * (b1 * e + 2.0 * b2 * e * e)
    )


def rest(p: np.void, volt2: np.ndarray) -> float:
    """Static deflection r under squared voltages (3,)."""
    gain = p["force_gain_n_per_v2"] * p["parasitic_comb"] * p["parasitic_per_kg"]
    return float((gain * volt2).sum() / p["parasitic_rad_per_s"] ** 2)
