"""How the numbers and formulas of the paper are read: as printed, as corrected, and by a law that knows neither.

Units are the paper's: um, mm, mN, N/mm, N mm/rad, mg, Hz.
"""

import math

import numpy as np
from scipy.optimize import brentq

from pkxyz_ctrl.elements import combs, flexures
from pkxyz_ctrl.mechanics.jacobians import nominal_jacobians
from pkxyz_ctrl.mechanics.modes import modes
from pkxyz_ctrl.mechanics.sextic import appendix_coefficients
from pkxyz_ctrl.mechanics.stiffness import lifting_stiffness_n_per_m, nominal_stiffness_n_per_m
from pkxyz_ctrl.stage import Stage

VOLTAGE_V = 130.0  # IV.D
FREQUENCY_XY_HZ, FREQUENCY_Z_HZ = 630.92, 771.75  # Eq. 40
MASS_PRINTED_MG = 3.655e-3  # IV.E and Eq. 40
APPENDIX_RADIUS_MM = 2 + math.sqrt(0.5)  # what the coefficients of Appendix A were made with
# at lambda = 0, as printed, by power of delta; the last two stand under the names c_5 and c_6
APPENDIX_COEFFICIENTS = {
    0: -3.000 * 24470,
    1: -12.00 * 28550,
    2: -12.00 * -27420,
    3: -144.0 * 1158,
    4: -72.0 * -653.6,
    5: -432.0 * 16.24,
    6: 432.0,
}
# the same of the terms in lambda_1 alone, by power of delta; c_0's are too garbled to be read
APPENDIX_SLOPES = {
    1: -12.00 * 2.000 * -9139,
    2: -12.00 * 2.000 * 6947,
    3: -144.0 * -435.7,
    4: -72.0 * 10.0 * 16.24,
    5: -432.0 * -2.0,
}


def spring_n_per_m(stage: Stage) -> float:
    """K_1."""
    return flexures.folded_spring_stiffness(stage.config.flexures)


def lateral_n_per_m(stage: Stage) -> float:
    """K_l1."""
    return flexures.folded_spring_lateral_stiffness(stage.config.flexures)


def elevation_rad(stage: Stage) -> float:
    return float(stage.geometry["elevation_rest_rad"][0])


def link_m(stage: Stage) -> float:
    return float(stage.geometry["link_m"][0])


def stiffness_n_per_m(stage: Stage, axis: int, chains: int = 1) -> float:
    return float(nominal_stiffness_n_per_m(stage.config, chains)[axis, axis])


def middle_slope(stage: Stage) -> float:
    limits = stage.config.limits
    middle = stage.forward_kinematics(np.full(3, (limits.stroke_min_m + limits.stroke_max_m) / 2))
    return float(stage.jacobian(middle)[0, 2])


def comb_force_mn(stage: Stage, height_m: float) -> float:
    comb = stage.config.drive_comb.model_copy(update={"finger_height_m": height_m})
    return combs.force_gain_n_per_v2(comb) * VOLTAGE_V**2 * 1e3


def frequency_hz(stage: Stage, axis: int, mass_kg: float) -> float:
    return float(modes(nominal_stiffness_n_per_m(stage.config, 1), mass_kg).frequency_hz[axis])


def pull_in_um(stage: Stage, axial_n_per_m: float, as_printed: bool) -> float:
    comb = stage.config.drive_comb
    law = combs.pull_in_stroke_printed_m if as_printed else combs.pull_in_stroke_m
    return law(comb.finger_gap_m, lateral_n_per_m(stage), axial_n_per_m, comb.overlap_rest_m) * 1e6


def pull_in_by_balance_um(stage: Stage) -> float:
    """Where side stiffness of spring and gaps cancel, by root search: the check on both forms of Eq. 34."""
    comb, lateral, axial = stage.config.drive_comb, lateral_n_per_m(stage), spring_n_per_m(stage)

    def side_stiffness(stroke_m: float) -> float:
        return lateral - 2 * axial * stroke_m * (comb.overlap_rest_m + stroke_m) / comb.finger_gap_m**2

    return float(brentq(side_stiffness, 0, 1.0)) * 1e6


def lifting_quarter_n_per_m(stage: Stage) -> float:
    """Eq. 24 in units of one folded spring of four, as Eq. 34 takes K_1 for the
    axial and K_l1 for the lateral stiffness.
    """
    hinge = flexures.link_hinge_stiffness(stage.config.flexures)
    return lifting_stiffness_n_per_m(spring_n_per_m(stage), hinge, link_m(stage), elevation_rad(stage), 1) / 4


def eq_8_moved_um(stage: Stage, literal: bool) -> float:
    """lambda_1 at rest with the origin 100 um before A0, Y_A0 inside the root as printed or outside:
    lambda_0 is right.
    """
    g, y_a0 = stage.config.geometry, 100e-6
    head = y_a0 + g.base_radius_m - g.projection_rest_m
    crank_mm2 = (g.crank_length_m * 1e3) ** 2  # the printed root mixes length and area; in the paper's millimetres
    if literal:
        return (head - math.sqrt(crank_mm2 - y_a0 * 1e3) * 1e-3) * 1e6
    return (head - math.sqrt(crank_mm2) * 1e-3 - y_a0) * 1e6


def eq_19_n_per_mm(stage: Stage, power: int) -> float:
    k3, alpha = flexures.link_hinge_stiffness(stage.config.flexures), elevation_rad(stage)
    sec, tan = 1 / math.cos(alpha), math.tan(alpha)
    return (4 * k3 * sec**power / link_m(stage) ** 2 + 12 * spring_n_per_m(stage) * tan**power) * 1e-3


def hessian_n_per_mm(stage: Stage, axis: int) -> float:
    return float(stage.stiffness(np.zeros(3))[axis, axis]) * 1e-3


def lift_per_pull(stage: Stage, swapped: bool) -> float:
    """Lift of the platform for one unit of pull on each comb, with Eq. 23 read as its sentence or as it stands."""
    transposed = nominal_jacobians(stage.config.geometry).stroke_m_per_m.T
    return float((np.linalg.inv(transposed) @ np.ones(3))[2] if swapped else (transposed @ np.ones(3))[2])


def lift_per_pull_by_work(stage: Stage) -> float:
    """The same from energy: three strokes for a small rise, exact kinematics."""
    rise = 1e-9
    return float(stage.inverse_kinematics([0.0, 0.0, rise]).sum()) / rise


def rise_per_stroke(stage: Stage, literal: bool) -> float:
    """Height for a unit of common stroke, by Eq. 35 as printed or with the Jacobian inverted."""
    jacobian = nominal_jacobians(stage.config.geometry).stroke_m_per_m
    return float((jacobian @ np.ones(3) if literal else np.linalg.solve(jacobian, np.ones(3)))[2])


def rise_per_stroke_by_closure(stage: Stage) -> float:
    stroke = 1e-9
    return float(stage.forward_kinematics([stroke] * 3)[2]) / stroke


def beams_n_per_mm(stage: Stage, pairs: int) -> float:
    """K_1 from Eq. 25 with one or two of its beam pairs to each half of a folded spring."""
    f = stage.config.flexures
    halves = (f.leaf_inner_length_m, f.leaf_outer_length_m)
    beams = [
        flexures.clamped_beam_stiffness(f.youngs_modulus_pa, f.leaf_height_m, f.leaf_thickness_m, h)[0] for h in halves
    ]
    return pairs / sum(1 / beam for beam in beams) * 1e-3


def appendix_coefficient(power: int) -> float:
    return float(appendix_coefficients(APPENDIX_RADIUS_MM, 1.0, [0.0] * 3)[power])


def appendix_slope(power: int) -> float:
    """The term of c_k in lambda_1 alone: a difference about 0, exact for the fifth degree, which c_k does not pass."""
    steps = np.array([-2.0, -1.0, 1.0, 2.0])
    values = [appendix_coefficients(APPENDIX_RADIUS_MM, 1.0, [step, 0.0, 0.0])[power] for step in steps]
    return float(np.dot([1.0, -8.0, 8.0, -1.0], values)) / 12.0


def stiffness_leaves_once_n_per_mm(stage: Stage) -> float:
    """K_xx of Eq. 19 if the four leaves, which Eq. 26 has put together already, were not taken four times in Eq. 16."""
    k_1 = spring_n_per_m(stage)
    k_2 = flexures.crank_hinge_stiffness(stage.config.flexures) / stage.config.geometry.crank_length_m**2
    return (1.5 * k_1 + 6.0 * k_2) * 1e-3


def mode_strokes(stage: Stage, axis: int) -> np.ndarray:
    return nominal_jacobians(stage.config.geometry).stroke_m_per_m[:, axis]


def delta_printed_um() -> float:
    """The root of the printed polynomial at lambda = 0, with c_0's lost factor,
    that is nearest to the true r - L1.
    """
    printed = dict(APPENDIX_COEFFICIENTS) | {0: -2 * APPENDIX_COEFFICIENTS[0]}
    roots: np.ndarray = np.polynomial.Polynomial([printed[power] for power in range(7)]).roots().astype(complex)
    return float(roots[np.abs(roots - (APPENDIX_RADIUS_MM - 1.0)).argmin()].real) * 1e3
