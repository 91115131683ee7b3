"""Kinematics of the three chains, compiled: strokes, Jacobian, curvature and their inverse.

Frame: origin at the rest position of the platform, x and y in the wafer plane, z up, away from the handle layer. Chain i
acts along e_i at 90, 210, 330 degrees (paper, Eq. 2); n_i is e_i turned by +90 degrees. For a platform at ``position_m``
= (x, y, z) relative to rest, with s_i = (x, y).n_i, delta = sqrt(L2^2 - (z_0 + z)^2)::

    q_i = (x, y).e_i + (delta_0 - delta) + (L1 - sqrt(L1^2 - s_i^2))

which is the paper's Eq. 8 with the minus sign before the root, less its value at rest. Differences of near numbers are
written as quotients, so q keeps its relative precision down to zero. Strokes are positive inward.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pkxyz_ctrl.core.linear3 import inverse3
from pkxyz_ctrl.stage_config import GeometryConfig

Array = NDArray[np.float64]

GEOMETRY = np.dtype(
    [
        ("crank_m", "f8"),  # L1
        ("link_m", "f8"),  # L2
        ("height_rest_m", "f8"),  # z_0
        ("projection_rest_m", "f8"),  # delta_0
        ("elevation_rest_rad", "f8"),  # alpha_0
        ("e", "f8", (3, 2)),  # inward unit vectors e_i
        ("n", "f8", (3, 2)),  # e_i turned by +90 degrees about z
    ],
    align=True,
)

_HALF_ROOT3 = math.sqrt(3.0) / 2.0


def geometry_record(config: GeometryConfig) -> NDArray[np.void]:
    """One-element array of ``GEOMETRY`` for a stage's dimensions."""
    record = np.zeros(1, GEOMETRY)
    delta0, z0 = config.projection_rest_m, config.height_rest_m
    record["crank_m"] = config.crank_length_m
    record["link_m"] = config.link_length_m if config.link_length_m is not None else math.hypot(delta0, z0)
    record["height_rest_m"] = z0
    record["projection_rest_m"] = delta0
    record["elevation_rest_rad"] = math.atan2(z0, delta0)
    e = np.array([[0.0, 1.0], [-_HALF_ROOT3, -0.5], [_HALF_ROOT3, -0.5]])
    record["e"] = e
    record["n"] = np.stack([-e[:, 1], e[:, 0]], axis=1)
    return record


@njit(cache=True)
def in_domain(geometry, position_m: Array) -> int:
    """0 if the links can reach ``position_m`` (3,); 1, 2, 3 if the crank of that chain can't; 4 if the links can't (|z_0 + z| >= L2)."""
    crank = geometry["crank_m"]
    n = geometry["n"]
    for i in range(3):
        if not abs(n[i, 0] * position_m[0] + n[i, 1] * position_m[1]) < crank:
            return i + 1
    if not abs(geometry["height_rest_m"] + position_m[2]) < geometry["link_m"]:
        return 4
    return 0


@njit(cache=True)
def strokes(geometry, position_m: Array, out: Array) -> None:
    """Inverse kinematics (Eq. 8): strokes q (3,) in m relative to rest. ``position_m`` must be ``in_domain``."""
    crank, link, z0 = geometry["crank_m"], geometry["link_m"], geometry["height_rest_m"]
    e, n = geometry["e"], geometry["n"]
    x, y, dz = position_m[0], position_m[1], position_m[2]
    z = z0 + dz
    delta = math.sqrt((link - z) * (link + z))
    drop = dz * (z + z0) / (delta + geometry["projection_rest_m"])
    for i in range(3):
        s = n[i, 0] * x + n[i, 1] * y
        out[i] = e[i, 0] * x + e[i, 1] * y + drop + s * s / (crank + math.sqrt((crank - s) * (crank + s)))


@njit(cache=True)
def jacobian(geometry, position_m: Array, out: Array) -> None:
    """dq/dx (3,3) at ``position_m``: rows [e_i + n_i tan(theta_i), tan(alpha)]. Eq. 12 is its value at rest."""
    crank, link = geometry["crank_m"], geometry["link_m"]
    e, n = geometry["e"], geometry["n"]
    z = geometry["height_rest_m"] + position_m[2]
    slope = z / math.sqrt((link - z) * (link + z))
    for i in range(3):
        s = n[i, 0] * position_m[0] + n[i, 1] * position_m[1]
        tangent = s / math.sqrt((crank - s) * (crank + s))
        out[i, 0] = e[i, 0] + n[i, 0] * tangent
        out[i, 1] = e[i, 1] + n[i, 1] * tangent
        out[i, 2] = slope


@njit(cache=True)
def newton_step(geometry, strokes_m: Array, position_m: Array) -> float:
    """Move ``position_m`` (3,) in place by one Newton step towards q(x) = ``strokes_m``; the size of the step in m.

    The Jacobian is the exact one at the position handed in, so the error that is left is quadratic in the step: a step of
    1 um leaves about 1 nm, one of 30 nm less than 1 pm. Returns inf and moves nothing where the Jacobian is singular.
    """
    q = np.empty(3)
    j = np.empty((3, 3))
    strokes(geometry, position_m, q)
    jacobian(geometry, position_m, j)
    inverse = np.empty((3, 3))
    if inverse3(j, inverse) == 0.0:
        return math.inf
    r0, r1, r2 = strokes_m[0] - q[0], strokes_m[1] - q[1], strokes_m[2] - q[2]
    size = 0.0
    for i in range(3):
        step = inverse[i, 0] * r0 + inverse[i, 1] * r1 + inverse[i, 2] * r2
        position_m[i] += step
        size = max(size, abs(step))
    return size


@njit(cache=True)
def position_from_strokes(geometry, strokes_m: Array, position_m: Array) -> int:
    """Forward kinematics: Newton from the position handed in (rest is always a good start), in place, until it stands still.

    Returns the number of steps (4 to 5 within the workspace) or -1 where it leaves the links' domain or doesn't settle.
    """
    last = math.inf
    for count in range(1, 21):
        size = newton_step(geometry, strokes_m, position_m)
        if in_domain(geometry, position_m) != 0:
            return -1
        if size < 1e-18 or (size < 1e-15 and size >= last):
            return count
        last = size
    return 20 if last < 1e-15 else -1
