"""The stage at rest: the linear stage that it is there, and where constant forces take it. Compiled, as a study makes
plants by the thousand; records are in arrays, as numba takes twenty times as long to tell the type of one alone."""

import math

import numpy as np

from sim.motion.kernel import kernel
from sim.motion.mechanics import acceleration, stiffness

_ROUNDS = 50
_ROUNDING = 1e-15
STILL_M = 1e-18
"""Who moves by less than this from one step of Newton's method to the next stands still."""


@kernel
def linearise(params: np.ndarray, quality: float, rest_n_per_m: np.ndarray) -> None:
    """Write the Hessian (3, 3) of the elastic energy at rest, N/m, to ``rest_n_per_m``, and what follows from it to the
    one record of ``params``: K / m; D = C / m, in which every mode w of the rest pose has the quality factor, so that
    D = (K / m)^(1/2) / Q, and none for a ``quality`` of 0; the response to a transient of the amplifier.
    """
    p = params[0]
    stiff, damping, square = p["stiff_per_s2"], p["damping_per_s"], p["damping2_per_s2"]
    _fill(rest_n_per_m, *stiffness(p, 0.0, 0.0, 0.0))
    for i in range(3):
        for k in range(3):
            stiff[i, k], damping[i, k] = rest_n_per_m[i, k] / p["mass_kg"], 0.0
    if quality > 0.0:
        _take_root(stiff, damping, square, p["response_1"], p["response_2"])  # all of them are written below
        for i in range(3):
            for k in range(3):
                damping[i, k] /= quality
    for i in range(3):
        for k in range(3):
            dd = damping[i, 0] * damping[0, k] + damping[i, 1] * damping[1, k] + damping[i, 2] * damping[2, k]
            square[i, k] = 0.25 * dd
    _respond(p["amplifier_s"], stiff, damping, p["response_1_s2"], p["response_1"])
    _respond(0.5 * p["amplifier_s"], stiff, damping, p["response_2_s2"], p["response_2"])


@kernel
def _fill(out: np.ndarray, xx: float, xy: float, xz: float, yy: float, yz: float, zz: float) -> None:
    """A symmetric matrix (3, 3)."""
    out[0, 0], out[1, 1], out[2, 2] = xx, yy, zz
    out[0, 1], out[1, 0], out[0, 2], out[2, 0], out[1, 2], out[2, 1] = xy, xy, xz, xz, yz, yz


@kernel
def _take_root(a: np.ndarray, root: np.ndarray, inverse: np.ndarray, one: np.ndarray, two: np.ndarray) -> None:
    """Square root (3, 3) of a symmetric positive definite matrix by Denman and Beavers' iteration (Higham, Functions of
    Matrices, 6.3); the others are scratch."""
    size = a[0, 0] + a[1, 1] + a[2, 2]  # brought near 1, where it takes off quickly
    for i in range(3):
        for k in range(3):
            root[i, k], inverse[i, k] = 3.0 * a[i, k] / size, 1.0 if i == k else 0.0
    for _ in range(_ROUNDS):
        _invert(root, one)
        _invert(inverse, two)
        change = 0.0
        for i in range(3):
            for k in range(3):
                step = 0.5 * (two[i, k] - root[i, k])
                root[i, k] += step
                inverse[i, k] += 0.5 * (one[i, k] - inverse[i, k])
                change = max(change, abs(step))
        if change < _ROUNDING:
            break
    for i in range(3):
        for k in range(3):
            root[i, k] *= math.sqrt(size / 3.0)


@kernel
def _invert(a: np.ndarray, out: np.ndarray) -> None:
    """Inverse (3, 3) of a symmetric matrix by its adjugate."""
    xx, xy = a[1, 1] * a[2, 2] - a[1, 2] * a[1, 2], a[0, 2] * a[1, 2] - a[0, 1] * a[2, 2]
    xz = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
    scale = 1.0 / (a[0, 0] * xx + a[0, 1] * xy + a[0, 2] * xz)
    yy, zz = a[0, 0] * a[2, 2] - a[0, 2] * a[0, 2], a[0, 0] * a[1, 1] - a[0, 1] * a[0, 1]
    yz = a[0, 1] * a[0, 2] - a[0, 0] * a[1, 2]
    _fill(out, scale * xx, scale * xy, scale * xz, scale * yy, scale * yz, scale * zz)


@kernel
def _respond(tau: float, stiff: np.ndarray, d: np.ndarray, response_s2: np.ndarray, response: np.ndarray) -> None:
    """R, where xi = R A exp(-t / tau) solves xi'' + D xi' + K xi / m = A exp(-t / tau) to leading orders in tau, and
    what R A stands before in -(xi'' + D xi'). K is that of the rest pose: of R, a part in 2000 hangs on it."""
    square = tau * tau
    for i in range(3):
        for k in range(3):
            unit = 1.0 if i == k else 0.0
            response_s2[i, k] = square * (unit + tau * d[i, k] - square * stiff[i, k])
    for i in range(3):
        for k in range(3):
            total = 0.0
            for j in range(3):
                unit = 1.0 if i == j else 0.0
                total += (d[i, j] / tau - unit / square) * response_s2[j, k] if tau > 0.0 else 0.0
            response[i, k] = total


@kernel
def settle(
    params: np.ndarray, state: np.ndarray, volt2: np.ndarray, x: np.ndarray, force_n: np.ndarray, hessian: np.ndarray
) -> float:
    """Move ``x`` (3,), m, to where elastic, comb and constant forces balance under squared voltages (3,), by Newton's
    method; returns by how much it still moves. ``force_n`` (3,) and ``hessian`` (3, 3) are scratch."""
    p, change = params[0], 0.0
    for _ in range(_ROUNDS):
        ax, ay, az = acceleration(p, state[0], volt2, x[0], x[1], x[2], 0.0, 0.0, 0.0)
        force_n[0], force_n[1], force_n[2] = p["mass_kg"] * ax, p["mass_kg"] * ay, p["mass_kg"] * az
        _fill(hessian, *stiffness(p, x[0], x[1], x[2]))
        _invert(hessian, hessian)
        change = 0.0
        for i in range(3):
            step = hessian[i, 0] * force_n[0] + hessian[i, 1] * force_n[1] + hessian[i, 2] * force_n[2]
            x[i] += step
            change = max(change, abs(step))
        if change < STILL_M:
            break
    return float(change)
