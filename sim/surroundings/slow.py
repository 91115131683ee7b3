"""Temperature and age: what springs, drive combs and sense combs are now, written
into the record of parameters once a call."""

import math

import numpy as np

from sim.motion.kernel import kernel


@kernel
def grow_old(p: np.void, t_us: int) -> None:
    """Set stiffness and gains of ``p`` to those at t_us, from what was drawn. Damping stays what it was."""
    t = 1e-6 * t_us
    warm = p["warm_k"] + p["warming_k"] * (1.0 - math.exp(-t / p["warming_s"]))
    warm += p["swing_k"] * math.sin(p["swing_rad_per_s"] * t)
    grown = 1.0 - math.exp(-(t - p["ageing_from_s"]) / p["ageing_s"]) if t > p["ageing_from_s"] else 0.0
    soft = 1.0 + p["stiffness_per_k"] * warm
    p["link_hinge_nm"] = p["drawn_link_hinge_nm"] * soft
    for i in range(3):
        aged = soft * (1.0 + p["ageing_springs"][i] * grown)
        p["leaf_n_per_m"][i] = p["drawn_leaf_n_per_m"][i] * aged
        p["crank_hinge_nm"][i] = p["drawn_crank_hinge_nm"][i] * aged
        comb = (1.0 + p["comb_per_k"] * warm) * (1.0 + p["ageing_combs"][i] * grown)
        p["force_gain_n_per_v2"][i] = p["drawn_force_gain_n_per_v2"][i] * comb
        p["sense_f_per_m"][i] = p["drawn_sense_f_per_m"][i] * (1.0 + p["sense_per_k"] * warm)
