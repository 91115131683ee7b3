"""Fingers that do not stand in the middle of their gaps: how far the voltage pulls them aside, and when they snap.

Of a finger d aside in a gap g on both sides, overlapping by l = y0 + q (k the comb's force gain, n eps0 h / g):

    lateral force  F(d) = k g l V^2 / 2 (1 / (g - d)^2 - 1 / (g + d)^2)
    balance        K(q) y = F(offset + y),   K(q) = K_0 / (1 + (q / q_s)^2)
    along          k -> k / (1 - (d / g)^2)

The lateral mode lies far above a hundred kilohertz, so the balance is kept at every instant. F is convex: Newton's
method from y = 0 climbs to the smallest root, and where K - F' loses its sign before, there is none. Within a step the
rise of k is a line in V^2 and q, tangent at the last balance."""

import numpy as np

from sim.motion.geometry import strokes
from sim.motion.kernel import kernel

STIFF = 0.1
"""K - F' counts as at least this share of K in the tangent, which at a snap would be endless."""


@kernel
def balance(p: np.void, s: np.void) -> int:
    """Set how far each chain's fingers bend, s["aside_m"] (3,), what their force rises by, s["comb_rise"] (3,), and the
    tangent to that, s["rise_line"] (3, 3): for voltages and strokes now. Returns a chain that has no balance, or -1."""
    strokes(p, s["motion"], s["strokes_m"])
    gap = p["finger_gap_m"]
    loose = -1
    for i in range(3):
        stroke = s["strokes_m"][i]
        volt = s["voltage_v"][i] - s["charge_v"][i]
        volt2, overlap = volt * volt, max(0.0, p["overlap_rest_m"] + stroke)
        per_m_v2 = 0.5 * p["force_gain_n_per_v2"][i] * gap
        bent = stroke / p["softening_m"]
        lateral = p["lateral_n_per_m"] / (1.0 + bent * bent)
        aside = _aside(p["aside_m"][i], per_m_v2 * overlap * volt2, gap, lateral)
        if aside < 0.0:
            if s["held"][i] == 0:
                loose = i
            aside = s["aside_m"][i]
        s["aside_m"][i] = aside
        share = (p["aside_m"][i] + aside) / gap
        rise = 1.0 / (1.0 - share * share)
        s["comb_rise"][i] = rise
        left, right = gap - p["aside_m"][i] - aside, gap + p["aside_m"][i] + aside
        pull = per_m_v2 * (1.0 / (left * left) - 1.0 / (right * right))
        rigid = lateral - 2.0 * per_m_v2 * overlap * volt2 * (1.0 / left**3 + 1.0 / right**3)
        per_n = 2.0 * share * rise * rise / (gap * max(rigid, STIFF * lateral))
        softer = 2.0 * bent / (p["softening_m"] * (1.0 + bent * bent))
        line = s["rise_line"][i]
        line[1] = per_n * pull * overlap
        line[2] = per_n * (pull * volt2 + lateral * aside * softer)
        line[0] = rise - line[1] * volt2 - line[2] * stroke
    return loose


@kernel
def rise_within(s: np.void, strokes_m: np.ndarray, volt2: np.ndarray) -> None:
    """Squared voltages (3,) times what the combs' forces rise by at these and at strokes (3,), in place."""
    for i in range(3):
        line = s["rise_line"][i]
        volt2[i] *= max(1.0, line[0] + line[1] * volt2[i] + line[2] * strokes_m[i])


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
