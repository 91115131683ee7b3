"""Stiffness of the platform and of what a comb works against, forces and strokes (paper, Eq. 15 to 24).

``out_of_plane_chains`` says on how many chains the out-of-plane hinges count: 1 as Eq. 19 prints it (4 K3), 3 as
the text describes it (four pivots on each of three chains, 12 K3). The exact energy is ``Stage.potential_energy``;
its Hessian at rest is ``nominal_stiffness_n_per_m``.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.elements.errors import require_positive
from pkxyz_ctrl.elements.flexures import crank_hinge_stiffness, folded_spring_stiffness, link_hinge_stiffness
from pkxyz_ctrl.mechanics.jacobians import nominal_jacobians, stroke_curvature_per_m
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]


def spring_energy_j(spring_n_per_m: float, strokes_m: ArrayLike) -> Array:
    """Eq. 15 and 16: 2 K_1 sum(q_i^2) (...) in J, four folded springs of stiffness
    K_1 on each slider; strokes (..., 3).
    """
    strokes = np.asarray(strokes_m, dtype=np.float64)
    return np.asarray(2 * spring_n_per_m * (strokes**2).sum(axis=-1))


def in_plane_stiffness_n_per_m(spring_n_per_m: float, crank_hinge_n_m_per_rad: float, crank_m: float) -> float:
    """K_xx = K_yy = 6 (K_1 + K_2 / L1^2) (Eq. 19)."""
    require_positive(crank_m=crank_m)
    return 6 * (spring_n_per_m + crank_hinge_n_m_per_rad / crank_m**2)


def out_of_plane_stiffness_n_per_m(
    spring_n_per_m: float,
    link_hinge_n_m_per_rad: float,
    link_m: float,
    elevation_rad: float,
    out_of_plane_chains: int = 1,
) -> float:
    """K_zz = 4 c K_3 sec^2(alpha) / L2^2 + 12 K_1 tan^2(alpha) (Eq. 19 and 20;
    both print sec^2[alpha]^2 and tan^2[alpha]^2).
    """
    require_positive(link_m=link_m, elevation_rad=elevation_rad)
    pivots = 4 * out_of_plane_chains * link_hinge_n_m_per_rad / (link_m * math.cos(elevation_rad)) ** 2
    return pivots + 12 * spring_n_per_m * math.tan(elevation_rad) ** 2


def nominal_stiffness_n_per_m(config: StageConfig, out_of_plane_chains: int | None = None) -> Array:
    """Eq. 19: K (3, 3) in N/m at rest, with the stage's own count of out-of-plane chains unless another is given."""
    f, g = config.flexures, config.geometry
    k1 = folded_spring_stiffness(f)
    in_plane = in_plane_stiffness_n_per_m(k1, crank_hinge_stiffness(f), g.crank_length_m)
    chains = f.out_of_plane_chains if out_of_plane_chains is None else out_of_plane_chains
    link, elevation = math.hypot(g.projection_rest_m, g.height_rest_m), math.atan2(g.height_rest_m, g.projection_rest_m)
    vertical = out_of_plane_stiffness_n_per_m(k1, link_hinge_stiffness(f), link, elevation, chains)
    return np.diag([in_plane, in_plane, vertical])


def assembled_stiffness_n_per_m(config: StageConfig, out_of_plane_chains: int | None = None) -> Array:
    """Eq. 18: K = 4 sum_i K_i J_i^-T J_i^-1 (3, 3) in N/m from the Jacobians of Eq. 12. Eq. 19 is its closed form."""
    f = config.flexures
    chains = f.out_of_plane_chains if out_of_plane_chains is None else out_of_plane_chains
    stroke, crank, link = nominal_jacobians(config.geometry)
    return np.asarray(
        4 * folded_spring_stiffness(f) * stroke.T @ stroke
        + 4 * crank_hinge_stiffness(f) * crank.T @ crank
        + 4 * chains * link_hinge_stiffness(f) * np.outer(link, link)
    )


def lift_ratio(elevation_rad: float) -> float:
    """d lambda / dz = tan(alpha_0) (Eq. 21): what each slider moves for a unit
    of height when all three move alike.
    """
    return math.tan(elevation_rad)


def lifting_stiffness_n_per_m(
    spring_n_per_m: float,
    link_hinge_n_m_per_rad: float,
    link_m: float,
    elevation_rad: float,
    out_of_plane_chains: int = 1,
) -> float:
    """F_lambda / d lambda in N/m (Eq. 24): what each comb works against when all three lift:
    K_zz / (3 tan^2(alpha)).
    """
    vertical = out_of_plane_stiffness_n_per_m(
        spring_n_per_m, link_hinge_n_m_per_rad, link_m, elevation_rad, out_of_plane_chains
    )
    return vertical / (3 * lift_ratio(elevation_rad) ** 2)


def platform_force_n(stroke_jacobian: ArrayLike, comb_force_n: ArrayLike) -> Array:
    """Eq. 22 and 23: F_x = (J_1^-1)^T F_lambda (..., 3) in N. The sentence below Eq. 23 swaps the two names."""
    return np.asarray(np.einsum("...ij,...i->...j", np.asarray(stroke_jacobian), np.asarray(comb_force_n)))


def comb_stiffness_n_per_m(stage: Stage, position_m: ArrayLike) -> Array:
    """J^-T H J^-1 (..., 3, 3) in N/m at positions (..., 3): comb forces per stroke, the exact counterpart of Eq. 24.

    Off the diagonal is the coupling through the platform. The stress term (the curvature of x(q) under the holding
    forces) is in it: this is the derivative of ``Stage.holding_forces`` by the strokes.
    """
    inverse = np.linalg.inv(stage.jacobian(position_m))
    at_work = small_signal_stiffness_n_per_m(stage, position_m, stage.holding_forces(position_m))
    return np.asarray(np.einsum("...ji,...jk,...kl->...il", inverse, at_work, inverse))


def small_signal_stiffness_n_per_m(stage: Stage, position_m: ArrayLike, comb_force_n: ArrayLike) -> Array:
    """H - sum_i F_i d2q_i/dx2 (..., 3, 3) in N/m: the stiffness about a position that constant comb voltages hold.

    A comb's force does not depend on its stroke (Eq. 33), but its direction at the platform does: softer in x and
    y than the flexures alone. ``comb_force_n`` (..., 3) in N.
    """
    curvature = stroke_curvature_per_m(stage, position_m)
    geometric = np.einsum("...i,...ijk->...jk", np.asarray(comb_force_n), curvature)
    return np.asarray(stage.stiffness(position_m) - geometric)
