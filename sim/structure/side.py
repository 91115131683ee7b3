"""Fingers that do not stand in the middle of their gaps: how far the voltage pulls them aside, and when they snap.

Of a finger d aside in a gap g on both sides, overlapping by l = y0 + q (k the comb's force gain, n eps0 h / g):

    lateral force  F(d) = k g l V^2 / 2 (1 / (g - d)^2 - 1 / (g + d)^2)
    balance        K(q) y = F(offset + y),   K(q) = K_0 / (1 + (q / q_s)^2)
    along          k -> k / (1 - (d / g)^2)

The lateral mode lies far above a hundred kilohertz, so the balance is kept at every instant. F is convex: Newton's
method from y = 0 climbs to the smallest root, and where K - F' loses its sign before, there is none."""

import numpy as np

from sim.motion.geometry import strokes
from sim.motion.kernel import kernel


@kernel
def balance(p: np.void, s: np.void) -> int:
    """Set how far each chain's fingers bend, s["aside_m"] (3,), and what their force rises by, s["comb_rise"] (3,), for
    voltages and strokes now. Returns a chain that has no balance, or -1."""
    strokes(p, s["motion"], s["strokes_m"])
    gap = p["finger_gap_m"]
    loose = -1
    for i in range(3):
        stroke = s["strokes_m"][i]
        volt = s["voltage_v"][i] - s["charge_v"][i]
        push = 0.5 * p["force_gain_n_per_v2"][i] * gap * max(0.0, p["overlap_rest_m"] + stroke) * volt * volt
        bent = stroke / p["softening_m"]
        aside = _aside(p["aside_m"][i], push, gap, p["lateral_n_per_m"] / (1.0 + bent * bent))
        if aside < 0.0:
            if s["held"][i] == 0:
                loose = i
            aside = s["aside_m"][i]
        s["aside_m"][i] = aside
        share = (p["aside_m"][i] + aside) / gap
        s["comb_rise"][i] = 1.0 / (1.0 - share * share)
    return loose


@kernel
def _aside(offset_m: float, push: float, gap_m: float, lateral_n_per_m: float) -> float:
    """Bending y >= 0, m, of fingers ``offset_m`` >= 0 aside; -1 where they snap."""
    y = 0.0
    for _ in range(60):
        left, right = gap_m - offset_m - y, gap_m + offset_m + y
        if left <= 0.0:
            return -1.0
        force = push * (1.0 / (left * left) - 1.0 / (right * right))
        rigid = lateral_n_per_m - 2.0 * push * (1.0 / left**3 + 1.0 / right**3)
        if rigid <= 0.0:
            return -1.0
        change = (force - lateral_n_per_m * y) / rigid
        y += change
        if change <= 1e-16:
            return y
    return y
