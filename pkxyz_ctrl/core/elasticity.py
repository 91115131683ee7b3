"""Strain energy of the flexures, its gradient (the force that holds a position) and its Hessian (the stiffness), compiled.

    V = 2 K1 sum q_i^2 + 2 K2 sum theta_i^2 + 2 c K3 (alpha - alpha_0)^2,   sin(theta_i) = s_i / L1,   sin(alpha) = z / L2

c chains count in the out-of-plane term (Eq. 19 as printed: 1). The Hessian at rest is Eq. 19; elsewhere the curvature of q,
theta and alpha, which the paper drops, is in it.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pkxyz_ctrl.core.kinematics import jacobian, strokes

Array = NDArray[np.float64]

ELASTICITY = np.dtype(
    [
        ("slider_n_per_m", "f8"),  # 4 K1: one slider on its four folded springs
        ("crank_n_m_per_rad", "f8"),  # 4 K2: one chain's parallelogram
        ("link_n_m_per_rad", "f8"),  # 4 c K3: the out-of-plane hinges of the c chains that count
    ],
    align=True,
)


@njit(cache=True)
def energy(geometry, elasticity, position_m: Array) -> float:
    """Strain energy in J at ``position_m`` (3,), 0 at rest."""
    q = np.empty(3)
    strokes(geometry, position_m, q)
    crank, n = geometry["crank_m"], geometry["n"]
    total = 0.0
    for i in range(3):
        theta = math.asin((n[i, 0] * position_m[0] + n[i, 1] * position_m[1]) / crank)
        total += 0.5 * elasticity["slider_n_per_m"] * q[i] * q[i] + 0.5 * elasticity["crank_n_m_per_rad"] * theta * theta
    tilt = _elevation_change(geometry, position_m[2])
    return total + 0.5 * elasticity["link_n_m_per_rad"] * tilt * tilt


@njit(cache=True)
def _elevation_change(geometry, dz: float) -> float:
    """alpha - alpha_0 in rad from its sine, z delta_0 - delta z_0 over L2^2, with the small difference written as a quotient."""
    link, z0, d0 = geometry["link_m"], geometry["height_rest_m"], geometry["projection_rest_m"]
    z = z0 + dz
    d = math.sqrt((link - z) * (link + z))
    return math.asin(dz * (d0 + z0 * (z + z0) / (d + d0)) / (link * link))


@njit(cache=True)
def energy_gradient(geometry, elasticity, position_m: Array, out: Array) -> None:
    """dV/dx (3,) in N: the force at the platform that holds it at ``position_m``."""
    q = np.empty(3)
    j = np.empty((3, 3))
    strokes(geometry, position_m, q)
    jacobian(geometry, position_m, j)
    crank, link, n = geometry["crank_m"], geometry["link_m"], geometry["n"]
    k1, k2 = elasticity["slider_n_per_m"], elasticity["crank_n_m_per_rad"]
    out[0] = out[1] = out[2] = 0.0
    for i in range(3):
        s = n[i, 0] * position_m[0] + n[i, 1] * position_m[1]
        turn = k2 * math.asin(s / crank) / math.sqrt((crank - s) * (crank + s))
        out[0] += k1 * q[i] * j[i, 0] + turn * n[i, 0]
        out[1] += k1 * q[i] * j[i, 1] + turn * n[i, 1]
        out[2] += k1 * q[i] * j[i, 2]
    z = geometry["height_rest_m"] + position_m[2]
    out[2] += elasticity["link_n_m_per_rad"] * _elevation_change(geometry, position_m[2]) / math.sqrt((link - z) * (link + z))


@njit(cache=True)
def stiffness(geometry, elasticity, position_m: Array, out: Array) -> None:
    """d2V/dx2 (3,3) in N/m at ``position_m``; at rest it is Eq. 19."""
    q = np.empty(3)
    j = np.empty((3, 3))
    strokes(geometry, position_m, q)
    jacobian(geometry, position_m, j)
    crank, link, n = geometry["crank_m"], geometry["link_m"], geometry["n"]
    k1, k2, k3 = elasticity["slider_n_per_m"], elasticity["crank_n_m_per_rad"], elasticity["link_n_m_per_rad"]
    z = geometry["height_rest_m"] + position_m[2]
    delta2 = (link - z) * (link + z)
    delta = math.sqrt(delta2)
    for a in range(3):
        for b in range(3):
            out[a, b] = k1 * (j[0, a] * j[0, b] + j[1, a] * j[1, b] + j[2, a] * j[2, b])
    for i in range(3):
        s = n[i, 0] * position_m[0] + n[i, 1] * position_m[1]
        c2 = (crank - s) * (crank + s)
        c = math.sqrt(c2)
        across = k1 * q[i] * crank * crank / (c2 * c) + k2 * (1.0 / c2 + math.asin(s / crank) * s / (c2 * c))
        for a in range(2):
            for b in range(2):
                out[a, b] += across * n[i, a] * n[i, b]
        out[2, 2] += k1 * q[i] * link * link / (delta2 * delta)
    out[2, 2] += k3 * (1.0 / delta2 + _elevation_change(geometry, position_m[2]) * z / (delta2 * delta))
