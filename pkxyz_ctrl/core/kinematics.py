"""Kinematics of the three chains, compiled: strokes, Jacobian, curvature and their inverse.

Frame: origin at the rest position of the platform, x and y in the wafer plane, z up, away from the handle layer.
Chain i acts along e_i at 90, 210, 330 degrees (paper, Eq. 2); n_i is e_i turned by +90 degrees. For a platform at
``position_m`` = (x, y, z) relative to rest, with s_i = (x, y).n_i, delta = sqrt(L2^2 - (z_0 + z)^2)::

    q_i = (x, y).e_i + (delta_0 - delta) + (L1 - sqrt(L1^2 - s_i^2))

which is the paper's Eq. 8 with the minus sign before the root, less its value at rest. Differences of near numbers are
written as quotients, so q keeps its relative precision down to zero. Strokes are positive inward.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.config.stage import GeometryConfig

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
        ("lift", "f8"),  # force up a comb's fingers by its pull
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


@kernel
def in_domain(geometry: np.void, position_m: Array) -> int:
    """0 if the links can reach ``position_m`` (3,); 1, 2, 3 if the crank of that chain can't; 4 if the links can't
    (|z_0 + z| >= L2).
    """
    n = geometry["n"]
    for i in range(3):
        if not abs(n[i, 0] * position_m[0] + n[i, 1] * position_m[1]) < geometry["crank_m"]:
            return i + 1
    if not abs(geometry["height_rest_m"] + position_m[2]) < geometry["link_m"]:
        return 4
    return 0


@kernel
def link(geometry: np.void, dz: float) -> tuple[float, float, float, float]:
    """The out-of-plane links at height ``dz`` above rest: height z, projection delta, 1 / delta, and delta_0 - delta,
    in m and 1/m. Both quotients by one division, which a processor takes as long for as for some products.
    """
    reach, z0 = geometry["link_m"], geometry["height_rest_m"]
    z = z0 + dz
    delta = math.sqrt((reach - z) * (reach + z))
    total = delta + geometry["projection_rest_m"]
    shared = 1.0 / (delta * total)
    return z, delta, shared * total, dz * (z + z0) * (shared * delta)


@kernel
def crank(geometry: np.void, i: int, x: float, y: float) -> tuple[float, float, float, float]:
    """Chain i's crank at (x, y): s = L1 sin(theta), across its direction of action, and c = L1 cos(theta), in m; 1 / c
    and L1 - c, as in ``link`` by one division.
    """
    n, length = geometry["n"], geometry["crank_m"]
    s = n[i, 0] * x + n[i, 1] * y
    c = math.sqrt((length - s) * (length + s))
    total = length + c
    shared = 1.0 / (c * total)
    return s, c, shared * total, s * s * (shared * c)


@kernel
def stroke(geometry: np.void, i: int, x: float, y: float, short: float, drop: float) -> float:
    """q_i in m from the last number of ``crank`` and that of ``link``."""
    e = geometry["e"]
    return e[i, 0] * x + e[i, 1] * y + drop + short


@kernel
def strokes(geometry: np.void, position_m: Array, out: Array) -> None:
    """Inverse kinematics (Eq. 8): strokes q (3,) in m relative to rest. ``position_m`` must be ``in_domain``."""
    x, y = position_m[0], position_m[1]
    _, _, _, drop = link(geometry, position_m[2])
    for i in range(3):
        _, _, _, short = crank(geometry, i, x, y)
        out[i] = stroke(geometry, i, x, y, short, drop)


@kernel
def jacobian(geometry: np.void, position_m: Array, out: Array) -> None:
    """dq/dx (3,3) at ``position_m``: rows [e_i + n_i tan(theta_i), tan(alpha)]. Eq. 12 is its value at rest."""
    e, n = geometry["e"], geometry["n"]
    z, _, per_delta, _ = link(geometry, position_m[2])
    slope = z * per_delta
    for i in range(3):
        s, _, per_c, _ = crank(geometry, i, position_m[0], position_m[1])
        tangent = s * per_c
        out[i, 0] = e[i, 0] + n[i, 0] * tangent
        out[i, 1] = e[i, 1] + n[i, 1] * tangent
        out[i, 2] = slope


@kernel
def pulls(geometry: np.void, position_m: Array, out: Array) -> None:
    """B (3,3) at ``position_m``: row i is the force at the platform by the pull of comb i, the gradient of its stroke
    and what lifts its fingers. Without lift the Jacobian.
    """
    jacobian(geometry, position_m, out)
    for i in range(3):
        out[i, 2] += geometry["lift"]


@kernel
def crank_bend(geometry: np.void, c: float) -> float:
    """Curvature of a stroke across its direction in 1/m, L1^2 / c^3 with ``crank``'s c: along n_i n_i^T."""
    length: float = geometry["crank_m"]
    return length * length / c**3


@kernel
def link_bend(geometry: np.void, delta: float) -> float:
    """Curvature of every stroke along z in 1/m, L2^2 / delta^3 with ``link``'s delta."""
    reach: float = geometry["link_m"]
    return reach * reach / delta**3


@kernel
def curvature(geometry: np.void, position_m: Array, out: Array) -> None:
    """d2q_i/dx2 (3,3,3) in 1/m at ``position_m``, first axis the chain."""
    n = geometry["n"]
    _, delta, _, _ = link(geometry, position_m[2])
    out[:] = 0.0
    for i in range(3):
        _, c, _, _ = crank(geometry, i, position_m[0], position_m[1])
        across = crank_bend(geometry, c)
        for a in range(2):
            for b in range(2):
                out[i, a, b] = across * n[i, a] * n[i, b]
        out[i, 2, 2] = link_bend(geometry, delta)


@kernel
def newton_step(geometry: np.void, strokes_m: Array, position_m: Array, residual_m: Array) -> float:
    """Move ``position_m`` (3,) in place by one Newton step towards q(x) = ``strokes_m``; the size of the step in m.
    ``residual_m`` (3,) is by how much the strokes are more than those of the position handed in.

    The Jacobian is the exact one at the position handed in, so the error that is left is quadratic
    in the step: a step of 1 um leaves about 1 nm, one of 30 nm less than 1 pm. Returns inf and
    moves nothing where the Jacobian is singular.

    The third column of J is the same in every row, so z is eliminated by differences and two unknowns remain.
    """
    e, n = geometry["e"], geometry["n"]
    x, y = position_m[0], position_m[1]
    z, delta, _, drop = link(geometry, position_m[2])
    s, _, per_c, short = crank(geometry, 0, x, y)
    r0 = residual_m[0] = strokes_m[0] - stroke(geometry, 0, x, y, short, drop)
    a0, b0 = e[0, 0] + n[0, 0] * (s * per_c), e[0, 1] + n[0, 1] * (s * per_c)
    s, _, per_c, short = crank(geometry, 1, x, y)
    residual_m[1] = strokes_m[1] - stroke(geometry, 1, x, y, short, drop)
    r1 = residual_m[1] - r0
    a1, b1 = e[1, 0] + n[1, 0] * (s * per_c) - a0, e[1, 1] + n[1, 1] * (s * per_c) - b0
    s, _, per_c, short = crank(geometry, 2, x, y)
    residual_m[2] = strokes_m[2] - stroke(geometry, 2, x, y, short, drop)
    r2 = residual_m[2] - r0
    a2, b2 = e[2, 0] + n[2, 0] * (s * per_c) - a0, e[2, 1] + n[2, 1] * (s * per_c) - b0
    determinant = a1 * b2 - a2 * b1
    if determinant == 0.0 or z == 0.0:
        return math.inf
    inverse, per_slope = 1.0 / determinant, delta / z
    dx = (r1 * b2 - r2 * b1) * inverse
    dy = (a1 * r2 - a2 * r1) * inverse
    dz = (r0 - a0 * dx - b0 * dy) * per_slope
    position_m[0] = x + dx
    position_m[1] = y + dy
    position_m[2] += dz
    return max(abs(dx), abs(dy), abs(dz))


@njit(cache=True, error_model="numpy")
def position_from_strokes(geometry: np.void, strokes_m: Array, position_m: Array) -> int:
    """Forward kinematics: Newton from the position handed in (rest is always a good
    start), in place, until it stands still.

    Returns the number of steps (4 to 5 within the workspace) or -1 where it leaves the links' domain or doesn't settle.
    """
    last, residual = math.inf, np.empty(3)
    for count in range(1, 21):
        size = newton_step(geometry, strokes_m, position_m, residual)
        if in_domain(geometry, position_m) != 0:
            return -1
        if size < 1e-18 or (size < 1e-15 and size >= last):
            return count
        last = size
    return 20 if last < 1e-15 else -1
