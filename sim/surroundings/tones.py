"""Lines of floor and mains: phasors that turn, one for each axis or channel, so that any time is met exactly."""

import math

import numpy as np

from sim.motion.kernel import kernel


@kernel
def turn_tones(p: np.void, s: np.void, dt_us: int) -> None:
    """Turn all phasors on by dt_us."""
    turn, phase = s["tone_turn"], s["tone_phase"]
    if s["tone_turn_dt_us"] != dt_us:
        s["tone_turn_dt_us"] = dt_us
        for k in range(p["tone_count"]):
            angle = p["tone_rad_per_s"][k] * 1e-6 * dt_us
            turn[k, 0], turn[k, 1] = math.cos(angle), math.sin(angle)
    for k in range(p["tone_count"]):
        c, q = turn[k, 0], turn[k, 1]
        for j in range(3):
            a, b = phase[k, j, 0], phase[k, j, 1]
            phase[k, j, 0], phase[k, j, 1] = a * c - b * q, b * c + a * q


@kernel
def sum_tones(p: np.void, s: np.void) -> None:
    """s["tone_sum"] (2, 2, 3): base acceleration and ripple, each value and rate, by axis or channel."""
    out, phase = s["tone_sum"], s["tone_phase"]
    for j in range(3):
        shake, shake_rate, ripple, ripple_rate = 0.0, 0.0, 0.0, 0.0
        for k in range(p["tone_count"]):
            value, rate = phase[k, j, 1], phase[k, j, 0] * p["tone_rad_per_s"][k]
            shake += p["tone_m_per_s2"][k] * value
            shake_rate += p["tone_m_per_s2"][k] * rate
            ripple += p["tone_v"][k] * value
            ripple_rate += p["tone_v"][k] * rate
        out[0, 0, j], out[0, 1, j], out[1, 0, j], out[1, 1, j] = shake, shake_rate, ripple, ripple_rate


@kernel
def hum(p: np.void, s: np.void, channel: int) -> float:
    """What the lines show in a sense channel now, F."""
    total = 0.0
    for k in range(p["tone_count"]):
        total += p["tone_f"][k] * s["tone_phase"][k, channel, 1]
    return total
