"""How the base shakes and the voltages ripple over one call of ``advance``, as cubics of the time into the call.

White noise of one-sided density D over a call of h s is laid out in Legendre polynomials of the time, whose
coefficients are independent with variance (2 l + 1) D^2 / (2 h); those of degree 0, 1 and 2 are kept, which leaves 99 %
of the density at 0.52 / h (2.6 kHz at 5 kHz). 1/f noise is a sum of relaxations, each drawn exactly, and straight
within a call. Lines are cubics through value and rate at both ends."""

import math

import numpy as np

from sim.motion.kernel import kernel
from sim.motion.layout import (
    AMPLIFIER_FLICKER_STREAM,
    AMPLIFIER_STREAM,
    BASE_STREAM,
    CUBIC,
    FLICKERS,
    SENSE_FLICKER_STREAM,
)
from sim.motion.noise import normal, total
from sim.surroundings.tones import sum_tones, turn_tones


@kernel
def _add_white(p_density: float, h: float, words: np.ndarray, spare: np.ndarray, out: np.ndarray, j: int) -> None:
    """Add a draw of white noise over h s to column j of coefficients (4, 3)."""
    size = p_density * math.sqrt(0.5 / h)
    a0 = size * normal(words, spare)
    a1 = size * math.sqrt(3.0) * normal(words, spare)
    a2 = size * math.sqrt(5.0) * normal(words, spare)
    out[0, j] += a0 - a1 + a2
    out[1, j] += (2.0 * a1 - 6.0 * a2) / h
    out[2, j] += 6.0 * a2 / (h * h)


@kernel
def _add_between(f0: float, r0: float, f1: float, r1: float, h: float, out: np.ndarray, j: int) -> None:
    """Add the cubic through value and rate at 0 and at h to column j."""
    out[0, j] += f0
    out[1, j] += r0
    out[2, j] += (3.0 * (f1 - f0) / h - 2.0 * r0 - r1) / h
    out[3, j] += (2.0 * (f0 - f1) / h + r0 + r1) / (h * h)


@kernel
def relax(rates_per_s: np.ndarray, h: float, words: np.ndarray, spare: np.ndarray, out: np.ndarray) -> None:
    """Move relaxations (3, FLICKERS) of unit deviation on over h s."""
    for k in range(FLICKERS):
        kept = math.exp(-rates_per_s[k] * h)
        fresh = math.sqrt(1.0 - kept * kept)
        for i in range(3):
            out[i, k] = out[i, k] * kept + fresh * normal(words, spare)


@kernel
def surround(p: np.void, s: np.void, dt_us: int) -> None:
    """Draw and lay out what the coming call of ``dt_us`` will see, in s["shake_m_per_s2"] and s["ripple_v"] (4, 3)."""
    h = 1e-6 * dt_us
    s["call_s"] = 0.0
    shake, ripple = s["shake_m_per_s2"], s["ripple_v"]
    for n in range(CUBIC):
        for j in range(3):
            shake[n, j], ripple[n, j] = 0.0, 0.0
    if p["shaken_on"] != 0:
        for j in range(3):
            if p["base_m_per_s2_per_rt_hz"][j] > 0.0:
                words, spare = s["random"][BASE_STREAM], s["spare"][BASE_STREAM]
                _add_white(p["base_m_per_s2_per_rt_hz"][j], h, words, spare, shake, j)
    if p["tone_count"] > 0:
        before = s["tone_sum"]
        for j in range(3):
            _add_half(before, h, shake, ripple, j, 0.0)
        turn_tones(p, s, dt_us)
        sum_tones(p, s)
        for j in range(3):
            _add_half(s["tone_sum"], h, shake, ripple, j, h)
    if p["amplifier_noise_on"] != 0:
        for j in range(3):
            words, spare = s["random"][AMPLIFIER_STREAM], s["spare"][AMPLIFIER_STREAM]
            _add_white(p["amplifier_v_per_rt_hz"], h, words, spare, ripple, j)
            ripple[0, j] += p["amplifier_flicker_v"] * total(s["amplifier_flicker"][j])
            ripple[1, j] -= p["amplifier_flicker_v"] * total(s["amplifier_flicker"][j]) / h
        words, spare = s["random"][AMPLIFIER_FLICKER_STREAM], s["spare"][AMPLIFIER_FLICKER_STREAM]
        relax(p["amplifier_flicker_per_s"], h, words, spare, s["amplifier_flicker"])
        for j in range(3):
            ripple[1, j] += p["amplifier_flicker_v"] * total(s["amplifier_flicker"][j]) / h
    if p["sense_flicker_on"] != 0:
        words, spare = s["random"][SENSE_FLICKER_STREAM], s["spare"][SENSE_FLICKER_STREAM]
        relax(p["sense_flicker_per_s"], h, words, spare, s["sense_flicker"])


@kernel
def _add_half(sums: np.ndarray, h: float, shake: np.ndarray, ripple: np.ndarray, j: int, at: float) -> None:
    """Add what the lines' value and rate at one end of the call, 0 or h, contribute to the cubic between the ends."""
    if at == 0.0:
        _add_between(sums[0, 0, j], sums[0, 1, j], 0.0, 0.0, h, shake, j)
        _add_between(sums[1, 0, j], sums[1, 1, j], 0.0, 0.0, h, ripple, j)
    else:
        _add_between(0.0, 0.0, sums[0, 0, j], sums[0, 1, j], h, shake, j)
        _add_between(0.0, 0.0, sums[1, 0, j], sums[1, 1, j], h, ripple, j)
