"""Strain energy of the flexures, its gradient (the force that holds a position) and
its Hessian (the stiffness), compiled.

    V = 2 K1 sum q_i^2 + 2 K2 sum theta_i^2 + 2 c K3 (alpha - alpha_0)^2
    sin(theta_i) = s_i / L1,   sin(alpha) = z / L2

c chains count in the out-of-plane term (Eq. 19 as printed: 1). The Hessian at rest is Eq. 19; elsewhere the curvature
of q, theta and alpha, which the paper drops, is in it.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel, rare
from pkxyz_ctrl.core.kinematics import crank, crank_bend, jacobian, link, link_bend, stroke

Array = NDArray[np.float64]

ELASTICITY = np.dtype(
    [
        ("slider_n_per_m", "f8", (3,)),  # 4 K1: each slider on its four folded springs
        ("crank_n_m_per_rad", "f8", (3,)),  # 4 K2: each chain's parallelogram
        ("link_n_m_per_rad", "f8"),  # 4 c K3: the out-of-plane hinges of the c chains that count
    ],
    align=True,
)

BENT = np.dtype(
    [
        ("per_along_m", "f8", (3,)),  # of each chain: 1 / c, as ``kinematics.crank`` says it
        ("stroke_m", "f8", (3,)),
        ("slider_n", "f8", (3,)),  # that the slider's springs need
        ("crank_n_m", "f8", (3,)),  # that the parallelogram needs
        ("per_projection_m", "f8"),  # 1 / delta of the links
        ("link_n_m", "f8"),  # that their hinges need
    ],
    align=True,
)
"""How a stage bends at one position, for whoever needs more of it than the sum."""

_SMALL = 0.1
_HALVINGS = 4  # from a right angle


@kernel
def arcsine(y: float) -> float:
    """asin(y) for |y| <= 1, to some units in the last place; NaN beyond. The same bits on every machine, which no
    library of mathematics promises.

    Near 0, where the workspace lies, by its series; from farther away the angle is halved until it is there.
    """
    doubled = 1.0
    if not abs(y) < _SMALL:
        y, doubled = _halved(y)
    s = y * y
    s2 = s * s  # in pairs, which need not wait for one another
    tail = 5 / 112 + s * (35 / 1152) + s2 * (63 / 2816 + s * (231 / 13312))
    return doubled * (y + y * s * (1 / 6 + s * (3 / 40) + s2 * tail))


@kernel
@rare
def _halved(y: float) -> tuple[float, float]:
    """The sine of an angle that is small enough, and how many of it the one with the sine ``y`` is."""
    times = 1.0
    for _ in range(_HALVINGS):
        if not abs(y) >= _SMALL:
            break
        y /= math.sqrt(2.0 + 2.0 * math.sqrt((1.0 - y) * (1.0 + y)))
        times *= 2.0
    return y, times


@kernel
def energy(geometry: np.void, elasticity: np.void, position_m: Array) -> float:
    """Strain energy in J at ``position_m`` (3,), 0 at rest."""
    x, y = position_m[0], position_m[1]
    _, _, _, drop = link(geometry, position_m[2])
    total = 0.0
    k1, k2 = elasticity["slider_n_per_m"], elasticity["crank_n_m_per_rad"]
    for i in range(3):
        s, _, _, short = crank(geometry, i, x, y)
        q = stroke(geometry, i, x, y, short, drop)
        theta = arcsine(s / geometry["crank_m"])
        total += 0.5 * k1[i] * q * q + 0.5 * k2[i] * theta * theta
    tilt = _elevation_change(geometry, position_m[2], drop)
    return total + 0.5 * elasticity["link_n_m_per_rad"] * tilt * tilt


@kernel
def _elevation_change(geometry: np.void, dz: float, drop: float) -> float:
    """alpha - alpha_0 in rad from its sine, z delta_0 - delta z_0 over L2^2, where delta_0 - delta is ``drop``."""
    z0, delta0, reach = geometry["height_rest_m"], geometry["projection_rest_m"], geometry["link_m"]
    per_square = 1.0 / (reach * reach)
    return arcsine((dz * delta0 + z0 * drop) * per_square)


@kernel
def _springs(
    elasticity: np.void, i: int, q: float, s: float, per_c: float, per_crank: float
) -> tuple[float, float, float]:
    """Force in N along chain i's direction of action that its springs need at stroke ``q``, and across it, and the
    torque in N m of its parallelogram, which is in the latter; ``s`` and 1 / c as ``crank`` says, and 1 / L1.
    """
    force = elasticity["slider_n_per_m"][i] * q
    torque = elasticity["crank_n_m_per_rad"][i] * arcsine(s * per_crank)
    return force, (force * s + torque) * per_c, torque


@kernel
def _link_torque(geometry: np.void, elasticity: np.void, dz: float, drop: float) -> float:
    """In N m, that the out-of-plane hinges need at height ``dz`` above rest."""
    torque: float = elasticity["link_n_m_per_rad"] * _elevation_change(geometry, dz, drop)
    return torque


@kernel
def energy_gradient(geometry: np.void, elasticity: np.void, position_m: Array, out: Array) -> None:
    """dV/dx (3,) in N: the force at the platform that holds it at ``position_m``."""
    e, n = geometry["e"], geometry["n"]
    x, y = position_m[0], position_m[1]
    z, _, per_delta, drop = link(geometry, position_m[2])
    fx = fy = pull = 0.0
    per_crank = 1.0 / geometry["crank_m"]
    for i in range(3):
        s, _, per_c, short = crank(geometry, i, x, y)
        force, across, _ = _springs(elasticity, i, stroke(geometry, i, x, y, short, drop), s, per_c, per_crank)
        fx += force * e[i, 0] + across * n[i, 0]
        fy += force * e[i, 1] + across * n[i, 1]
        pull += force
    out[0] = fx
    out[1] = fy
    out[2] = (pull * z + _link_torque(geometry, elasticity, position_m[2], drop)) * per_delta


@kernel
def gradient_and_pulls(
    geometry: np.void, elasticity: np.void, position_m: Array, out: Array, pulls_out: Array, bent: np.void
) -> None:
    """``energy_gradient`` (3,) and ``kinematics.pulls`` (3,3) at one position, whose cranks and links both need, and
    how the stage bends there: a record of ``BENT``.
    """
    e, n = geometry["e"], geometry["n"]
    along, stroke_m, slider_n, crank_n_m = bent["per_along_m"], bent["stroke_m"], bent["slider_n"], bent["crank_n_m"]
    x, y = position_m[0], position_m[1]
    z, _, per_delta, drop = link(geometry, position_m[2])
    slope, per_crank = z * per_delta, 1.0 / geometry["crank_m"]
    fx = fy = pull = 0.0
    for i in range(3):
        s, _, per_c, short = crank(geometry, i, x, y)
        tangent = s * per_c
        pulls_out[i, 0] = e[i, 0] + n[i, 0] * tangent
        pulls_out[i, 1] = e[i, 1] + n[i, 1] * tangent
        pulls_out[i, 2] = slope + geometry["lift"]
        q = stroke(geometry, i, x, y, short, drop)
        force, across, torque = _springs(elasticity, i, q, s, per_c, per_crank)
        fx += force * e[i, 0] + across * n[i, 0]
        fy += force * e[i, 1] + across * n[i, 1]
        pull += force
        along[i], stroke_m[i], slider_n[i], crank_n_m[i] = per_c, q, force, torque
    bent["per_projection_m"], bent["link_n_m"] = per_delta, _link_torque(geometry, elasticity, position_m[2], drop)
    out[0], out[1], out[2] = fx, fy, (pull * z + bent["link_n_m"]) * per_delta


@kernel
def gradient_and_forces(
    geometry: np.void, elasticity: np.void, position_m: Array, comb_force_n: Array, other_n: Array, out: Array,
    other_out: Array,
) -> tuple[float, float, float]:  # fmt: skip
    """``energy_gradient``, returned, and what two sets of comb forces (3,) do to the platform at the same position,
    (3,) in N each: J^T F (Eq. 23), and their lift. Cranks and links are the same for all three.
    """
    e, n = geometry["e"], geometry["n"]
    x, y = position_m[0], position_m[1]
    z, _, per_delta, drop = link(geometry, position_m[2])
    wx = wy = held = fx = fy = pull = gx = gy = other_pull = 0.0
    slope, per_crank = z * per_delta, 1.0 / geometry["crank_m"]
    for i in range(3):
        s, _, per_c, short = crank(geometry, i, x, y)
        q, tangent = stroke(geometry, i, x, y, short, drop), s * per_c
        spring, spring_across, _ = _springs(elasticity, i, q, s, per_c, per_crank)
        across, other_across = comb_force_n[i] * tangent, other_n[i] * tangent
        wx += spring * e[i, 0] + spring_across * n[i, 0]
        wy += spring * e[i, 1] + spring_across * n[i, 1]
        held += spring
        fx += comb_force_n[i] * e[i, 0] + across * n[i, 0]
        fy += comb_force_n[i] * e[i, 1] + across * n[i, 1]
        pull += comb_force_n[i]
        gx += other_n[i] * e[i, 0] + other_across * n[i, 0]
        gy += other_n[i] * e[i, 1] + other_across * n[i, 1]
        other_pull += other_n[i]
    wz = (held * z + _link_torque(geometry, elasticity, position_m[2], drop)) * per_delta
    out[0], out[1], out[2] = fx, fy, pull * slope + geometry["lift"] * pull
    other_out[0], other_out[1] = gx, gy
    other_out[2] = other_pull * slope + geometry["lift"] * other_pull
    return wx, wy, wz


@njit(cache=True, error_model="numpy")
def stiffness(geometry: np.void, elasticity: np.void, position_m: Array, out: Array) -> None:
    """d2V/dx2 (3,3) in N/m at ``position_m``; at rest it is Eq. 19."""
    j = np.empty((3, 3))
    jacobian(geometry, position_m, j)
    length, n = geometry["crank_m"], geometry["n"]
    k1, k2, k3 = elasticity["slider_n_per_m"], elasticity["crank_n_m_per_rad"], elasticity["link_n_m_per_rad"]
    x, y = position_m[0], position_m[1]
    z, delta, _, drop = link(geometry, position_m[2])
    for a in range(3):
        for b in range(3):
            out[a, b] = k1[0] * (j[0, a] * j[0, b] + j[1, a] * j[1, b] + j[2, a] * j[2, b])
            out[a, b] += (k1[1] - k1[0]) * j[1, a] * j[1, b] + (k1[2] - k1[0]) * j[2, a] * j[2, b]
    for i in range(3):
        s, c, _, short = crank(geometry, i, x, y)
        q = stroke(geometry, i, x, y, short, drop)
        across = k1[i] * q * crank_bend(geometry, c) + k2[i] * (1.0 / c**2 + arcsine(s / length) * s / c**3)
        for a in range(2):
            for b in range(2):
                out[a, b] += across * n[i, a] * n[i, b]
        out[2, 2] += k1[i] * q * link_bend(geometry, delta)
    out[2, 2] += k3 * (1.0 / delta**2 + _elevation_change(geometry, position_m[2], drop) * z / delta**3)
