"""Stiffness and range of the three kinds of flexure (paper, Eq. 25 to 32). SI: N/m, N m/rad, rad."""

import math

from pkxyz_ctrl.config.stage import FlexureConfig
from pkxyz_ctrl.elements.errors import require_positive


def folded_spring_stiffness(flexures: FlexureConfig) -> float:
    """K_1 in N/m: one folded leaf spring along the motion (Eq. 26), two clamped leaves in series; four to a slider."""
    f = flexures
    return (
        4 * f.youngs_modulus_pa * f.leaf_height_m * f.leaf_thickness_m**3
        / (f.leaf_inner_length_m**3 + f.leaf_outer_length_m**3)
    )  # fmt: skip


def folded_spring_lateral_stiffness(flexures: FlexureConfig) -> float:
    """K_l1 in N/m: one folded leaf spring across the motion (Eq. 27)."""
    f = flexures
    return (
        4 * f.youngs_modulus_pa * f.leaf_height_m * f.leaf_thickness_m / (f.leaf_inner_length_m + f.leaf_outer_length_m)
    )


def clamped_beam_stiffness(
    modulus_pa: float, height_m: float, thickness_m: float, length_m: float
) -> tuple[float, float]:
    """K_d along the motion and K_l across it in N/m, one pair of clamped-guided beams (Eq. 25): 2 E h t^3 / l^3, 2
    E h t / l.

    The text then puts twice that, 4 E h t^3 / l^3, into Eq. 26 and 27: four beams of each length to a folded spring.
    """
    require_positive(modulus_pa=modulus_pa, height_m=height_m, thickness_m=thickness_m, length_m=length_m)
    return (
        2 * modulus_pa * height_m * thickness_m**3 / length_m**3,
        2 * modulus_pa * height_m * thickness_m / length_m,
    )


def crank_hinge_stiffness(flexures: FlexureConfig) -> float:
    """K_2 in N m/rad: one in-plane hinge of the parallelogram (Eq. 28). Four to a chain."""
    f = flexures
    return f.youngs_modulus_pa * f.crank_hinge_height_m * f.crank_hinge_thickness_m**3 / (12 * f.crank_hinge_length_m)


def link_hinge_stiffness(flexures: FlexureConfig) -> float:
    """K_3 in N m/rad: one out-of-plane hinge of the link (Eq. 31). Four to a chain."""
    f = flexures
    return f.youngs_modulus_pa * f.link_hinge_width_m * f.link_hinge_thickness_m**3 / (12 * f.link_hinge_length_m)


def crank_hinge_range_rad(flexures: FlexureConfig) -> float:
    """theta_max (Eq. 29 and 30): 2 sigma l / (t E), the turn at which the surface reaches the fracture strength."""
    f = flexures
    return 2 * f.fracture_strength_pa * f.crank_hinge_length_m / (f.crank_hinge_thickness_m * f.youngs_modulus_pa)


def link_hinge_range_rad(flexures: FlexureConfig) -> float:
    """alpha_max (Eq. 32)."""
    f = flexures
    return 2 * f.fracture_strength_pa * f.link_hinge_length_m / (f.link_hinge_thickness_m * f.youngs_modulus_pa)


def hinge_moment_max_n_m(fracture_strength_pa: float, width_m: float, thickness_m: float) -> float:
    """M_max in N m (Eq. 29): 2 sigma I / t with I = b t^3 / 12, the moment at which the hinge's surface fractures.

    Eq. 30 turns it into a range as theta_max = M_max C_z with the compliance C_z = 1 / K_2.
    """
    require_positive(fracture_strength_pa=fracture_strength_pa, width_m=width_m, thickness_m=thickness_m)
    return 2 * fracture_strength_pa * width_m * thickness_m**3 / 12 / thickness_m


def crank_tip_retreat_m(crank_length_m: float, turn_rad: float) -> float:
    """L1 (1 - cos theta) in m: by how much a crank turned by ``turn_rad`` falls short along its slider's axis.

    At theta_max this is the "maximum displacement range" of 490 um of IV.B; across the axis it would be L1
    sin(theta), 500 um.
    """
    return 2 * crank_length_m * math.sin(turn_rad / 2) ** 2
