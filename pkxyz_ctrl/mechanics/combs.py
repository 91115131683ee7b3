"""Comb drives and sense combs: force and capacitance (paper, Eq. 33)."""

from pkxyz_ctrl.stage_config import CombConfig

EPSILON_0_F_PER_M = 8.8541878128e-12
"""Vacuum permittivity, CODATA 2018."""


def force_gain_n_per_v2(comb: CombConfig) -> float:
    """F / V^2 = n eps0 h / g in N/V^2 (Eq. 33), independent of the stroke: a comb pulls, whatever the sign of V."""
    return comb.finger_count * EPSILON_0_F_PER_M * comb.finger_height_m / comb.finger_gap_m


def capacitance_gradient_f_per_m(comb: CombConfig) -> float:
    """dC/dq = 2 n eps0 h / g in F/m, twice the force gain since F = 1/2 dC/dq V^2."""
    return 2 * force_gain_n_per_v2(comb)
