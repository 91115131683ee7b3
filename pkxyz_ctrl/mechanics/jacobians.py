"""The three Jacobians of the paper (Eq. 9 to 12): strokes,
crank angles and link elevation against the platform's position.

The paper writes them J_1^-1, J_2^-1 and J_3^-1, and calls J_1 what maps strokes to positions. Here each is named
by what it gives per metre of platform. Nominal is Eq. 12, at rest; exact is at any position, from the derivative
of the loop closure.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkxyz_ctrl.config.stage import GeometryConfig
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]


class Jacobians(NamedTuple):
    """Derivatives by position: leading axes (...) of the positions, none for the nominal ones."""

    stroke_m_per_m: Array
    """J_1^-1 (..., 3, 3): dq_i/dx."""
    crank_rad_per_m: Array
    """J_2^-1 (..., 3, 3): dtheta_i/dx."""
    link_rad_per_m: Array
    """J_3^-1 (..., 3): dalpha/dx, one row since the links share their elevation."""


def nominal_jacobians(geometry: GeometryConfig) -> Jacobians:
    """Eq. 12: the Jacobians at rest, from L1, L2 and alpha_0."""
    alpha = math.atan2(geometry.height_rest_m, geometry.projection_rest_m)
    link = math.hypot(geometry.height_rest_m, geometry.projection_rest_m)
    tan, half = math.tan(alpha), math.sqrt(3) / 2
    stroke = np.array([[0.0, 1.0, tan], [-half, -0.5, tan], [half, -0.5, tan]])
    crank = np.array([[-1.0, 0.0, 0.0], [0.5, -half, 0.0], [0.5, half, 0.0]]) / geometry.crank_length_m
    return Jacobians(stroke, crank, np.array([0.0, 0.0, 1 / (math.cos(alpha) * link)]))


def joint_angles(stage: Stage, position_m: ArrayLike) -> tuple[Array, Array]:
    """Crank angles theta (..., 3), counter-clockwise from e_i, and link elevation
    alpha (...), in rad, at positions (..., 3).
    """
    _, s, z = _reach(stage, position_m)
    record = stage.geometry[0]
    return np.arcsin(s / record["crank_m"]), np.arcsin(z / record["link_m"])


def exact_jacobians(stage: Stage, position_m: ArrayLike) -> Jacobians:
    """The three Jacobians at positions (..., 3): rows [e_i + n_i tan(theta_i), tan(alpha)], [n_i / (L1
    cos(theta_i)), 0], [0, 0, 1/delta].

    Raises ``StageDomainError`` where a link cannot reach.
    """
    position, s, z = _reach(stage, position_m)
    record = stage.geometry[0]
    crank = np.zeros((*position.shape[:-1], 3, 3))
    crank[..., :2] = record["n"] / np.sqrt(record["crank_m"] ** 2 - s**2)[..., None]
    link = np.zeros(position.shape)
    link[..., 2] = 1 / np.sqrt(record["link_m"] ** 2 - z**2)
    return Jacobians(stage.jacobian(position), crank, link)


def stroke_curvature_per_m(stage: Stage, position_m: ArrayLike) -> Array:
    """d2q_i/dx2 (..., 3, 3, 3) in 1/m, first of the last three axes the chain; never negative: strokes are convex in x.

    In the plane n_i n_i^T / (L1 cos^3(theta_i)), along z L2^2 / delta^3. It is what
    the paper's constant Jacobian leaves out.
    """
    return stage.stroke_curvature(position_m)


def _reach(stage: Stage, position_m: ArrayLike) -> tuple[Array, Array, Array]:
    """Positions, s_i = (x, y).n_i and the link's height z_0 + z; the Stage's own domain check first."""
    stage.inverse_kinematics(position_m)
    position = np.asarray(position_m, dtype=np.float64)
    record = stage.geometry[0]
    return position, position[..., :2] @ record["n"].T, record["height_rest_m"] + position[..., 2]
