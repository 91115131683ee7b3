"""Where the mechanism is when flexible modes stand between it and the table, and what is seen of both.

mechanism = table - sum_j table_shape_j r_j,    strokes seen = q(mechanism) + sum_j comb_shape_j r_j
point of interest = table + tilt_shift table"""

import numpy as np

from sim.motion.geometry import stroke_rates, strokes
from sim.motion.kernel import kernel


@kernel
def mechanism(p: np.void, s: np.void, out: np.ndarray) -> None:
    """Pose and velocity (6,) of the rigid mechanism."""
    for j in range(6):
        out[j] = s["motion"][j]
    for k in range(p["mode_count"]):
        for j in range(3):
            out[j] -= p["mode_table"][k, j] * s["modes"][0, k]
            out[3 + j] -= p["mode_table"][k, j] * s["modes"][1, k]


@kernel
def combs_seen(p: np.void, s: np.void, out_m: np.ndarray, out_m_per_s: np.ndarray) -> None:
    """Strokes and rates (3,) of the sense combs, of whichever modes the plant has."""
    if p["mode_count"] > 0:
        mechanism(p, s, s["pose"])
        strokes(p, s["pose"], out_m)
        stroke_rates(p, s["pose"], out_m_per_s)
        for k in range(p["mode_count"]):
            for i in range(3):
                out_m[i] += p["mode_comb"][k, i] * s["modes"][0, k]
                out_m_per_s[i] += p["mode_comb"][k, i] * s["modes"][1, k]
        return
    strokes(p, s["motion"], out_m)
    stroke_rates(p, s["motion"], out_m_per_s)
    if p["parasitic_on"] != 0:
        for i in range(3):
            out_m[i] += p["parasitic_comb"][i] * s["parasitic"][0]
            out_m_per_s[i] += p["parasitic_comb"][i] * s["parasitic"][1]


@kernel
def stand(p: np.void, s: np.void, out_m: np.ndarray) -> None:
    """Position (3,) of the point of interest from rest, m."""
    for j in range(3):
        out_m[j] = s["motion"][j] + p["parasitic_table"][j] * s["parasitic"][0]
    if p["tilt_on"] != 0:
        x, y, z = out_m[0], out_m[1], out_m[2]
        for j in range(3):
            out_m[j] += p["tilt_shift"][j, 0] * x + p["tilt_shift"][j, 1] * y + p["tilt_shift"][j, 2] * z
