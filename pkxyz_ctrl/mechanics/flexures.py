"""Stiffness and range of the three kinds of flexure (paper, Eq. 25 to 32). SI: N/m, N m/rad, rad."""

from pkxyz_ctrl.stage_config import FlexureConfig


def folded_spring_stiffness(flexures: FlexureConfig) -> float:
    """K_1 in N/m: one folded leaf spring along the motion (Eq. 26), two clamped leaves in series. Four act on a slider."""
    f = flexures
    return (
        4 * f.youngs_modulus_pa * f.leaf_height_m * f.leaf_thickness_m**3
        / (f.leaf_inner_length_m**3 + f.leaf_outer_length_m**3)
    )  # fmt: skip


def folded_spring_lateral_stiffness(flexures: FlexureConfig) -> float:
    """K_l1 in N/m: one folded leaf spring across the motion (Eq. 27)."""
    f = flexures
    return 4 * f.youngs_modulus_pa * f.leaf_height_m * f.leaf_thickness_m / (f.leaf_inner_length_m + f.leaf_outer_length_m)


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
