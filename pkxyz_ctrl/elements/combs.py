"""Drive and sense combs: force, capacitance and the stroke at which a comb snaps sideways (paper, Eq. 33 and 34)."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkxyz_ctrl.config.stage import CombConfig
from pkxyz_ctrl.elements.errors import require_positive

EPSILON_0_F_PER_M = 8.8541878128e-12
"""Vacuum permittivity, CODATA 2018."""


def force_gain_n_per_v2(comb: CombConfig) -> float:
    """F / V^2 = n eps0 h / g in N/V^2 (Eq. 33), independent of the stroke: a comb pulls, whatever the sign of V."""
    return comb.finger_count * EPSILON_0_F_PER_M * comb.finger_height_m / comb.finger_gap_m


def capacitance_gradient_f_per_m(comb: CombConfig) -> float:
    """dC/dq = 2 n eps0 h / g in F/m, twice the force gain since F = 1/2 dC/dq V^2."""
    return 2 * force_gain_n_per_v2(comb)


def voltage_for_force_v(comb: CombConfig, force_n: ArrayLike) -> NDArray[np.float64]:
    """Voltage (...) in V at which the comb pulls with ``force_n`` (...) in N: Eq. 33 inverted, without any limit.

    NaN where a push would be needed: no voltage gives one.
    """
    force = np.asarray(force_n, dtype=np.float64)
    return np.sqrt(np.where(force >= 0, force, np.nan) / force_gain_n_per_v2(comb))


def pull_in_stroke_printed_m(
    gap_m: float, lateral_n_per_m: float, axial_n_per_m: float, overlap_rest_m: float
) -> float:
    """Eq. 34 as printed: g sqrt(k_l / 2k) - lambda_0. See ``pull_in_stroke_m`` for what the balance really gives."""
    return gap_m * math.sqrt(lateral_n_per_m / (2 * axial_n_per_m)) - overlap_rest_m


def pull_in_stroke_m(gap_m: float, lateral_n_per_m: float, axial_n_per_m: float, overlap_rest_m: float) -> float:
    """Stroke in m at which a comb that holds itself by its own voltage snaps sideways; Eq. 34 corrected.

    The side force of both gaps has the negative stiffness 2 F (y_0 + q) / g^2 with F = k q, which reaches the lateral
    stiffness k_l at q = -y_0/2 + sqrt(y_0^2/4 + g^2 k_l / 2k). Eq. 34 takes y_0 off whole, and off the wrong side
    of the square root. ``axial_n_per_m`` is what the comb works against: the suspension alone in the paper, in
    truth all that ``stiffness.lifting_stiffness_n_per_m`` counts.
    """
    require_positive(gap_m=gap_m, lateral_n_per_m=lateral_n_per_m, axial_n_per_m=axial_n_per_m)
    half = overlap_rest_m / 2
    return -half + math.sqrt(half**2 + gap_m**2 * lateral_n_per_m / (2 * axial_n_per_m))
