"""Where the stage as a linear one is led within a step of the usual length: tables of its exact motion.

    x'' + D x' + K x / m = n

with the stiffness K of the rest pose, the mass m and the damping D. Poses at four instants, and the velocity at the
last, are linear in pose and velocity at the start, in a steady n, and in the values at the instants of an n that is a
cubic; each by its Taylor series in time. Damping is modal, D a function of K, so each of these matrices is one, too: it
is symmetric, and kept as its xx, yy, zz, xy, xz, yz."""

import math

import numpy as np
from numpy.polynomial.polynomial import polyfromroots

from sim.motion.integrator import times
from sim.motion.kernel import kernel
from sim.motion.layout import INSTANTS

AT = np.array([0.08858795951270395, 0.4094668644407347, 0.7876594617608471, 1.0])
"""The instants, shares of a step: Radau's nodes, roots of P_3 - P_4 (Legendre's on 0..1)."""
_OTHERS = [np.delete(AT, k) for k in range(INSTANTS)]
CUBIC = np.array([polyfromroots(others) / np.prod(t - others) for t, others in zip(AT, _OTHERS, strict=True)]).T.copy()
"""[power, k]: coefficients of the polynomial that is 1 at instant k and 0 at the others."""
_TERMS = 30
"""Of a series in omega h, which is about 1: the last is below rounding by ten orders."""
_POWERS = AT ** np.arange(_TERMS)[:, None]


@kernel
def tabulate_flow(p: np.void, s: np.void) -> None:
    """Fill in the tables of a step of p["regular_s"]."""
    s["flow_h_s"], tau = p["regular_s"], p["amplifier_s"]
    for j in range(INSTANTS):
        s["instant_decay"][j] = math.exp(-AT[j] * p["regular_s"] / tau) if tau > 0.0 else 0.0
    solved, end, steady, answer = s["solved"], s["end_rate"], s["steady"], s["answer"]
    s["from_pose"][:], s["from_rate"][:], steady[:], answer[:], end[:] = 0.0, 0.0, 0.0, 0.0, 0.0
    for axis in range(3):
        _solve(p, axis, -1, solved)
        _keep(solved, axis, 1.0, s["from_pose"], end[0])
        _solve(p, 3 + axis, -1, solved)
        _keep(solved, axis, 1.0, s["from_rate"], end[1])
        for power in range(INSTANTS):
            _solve(p, axis, power, solved)
            for k in range(INSTANTS):
                _keep(solved, axis, CUBIC[power, k], answer[k], end[2 + k])
    for k in range(INSTANTS):
        for entry in range(6):
            for j in range(INSTANTS):
                steady[entry, j] += answer[k, entry, j]
            s["to_end"][entry, k], s["to_end"][6 + entry, k] = answer[k, entry, INSTANTS - 1], end[2 + k, entry]


@kernel
def _keep(solved: np.ndarray, axis: int, share: float, poses: np.ndarray, end_rate: np.ndarray) -> None:
    """Add a share of what ``solved`` (6, 4) says of column ``axis`` to matrices of the poses (6, 4), and of the rate at
    the end (6,)."""
    for row in range(axis + 1):
        entry = axis if row == axis else row + axis + 2
        for j in range(INSTANTS):
            poses[entry, j] += share * solved[row, j]
        end_rate[entry] += share * solved[3 + row, INSTANTS - 1]


@kernel
def _solve(p: np.void, c: int, power: int, out: np.ndarray) -> None:
    """Position and velocity (6, 4) at the instants: from a start that is 1 in entry ``c`` of those; or from 0, if
    ``power`` >= 0, with an n of (t / h)^power along axis ``c``."""
    h, stiff, damping = p["regular_s"], p["stiff_per_s2"], p["damping_per_s"]
    pushed = 1.0 if power >= 0 else 0.0
    x, y, z = _unit(c, 1.0 - pushed)  # coefficients of (t / h)^n in the position, and ...
    dx, dy, dz = _unit(c - 3, h * (1.0 - pushed))  # ... of (t / h)^(n + 1)
    out[:] = 0.0
    for n in range(_TERMS):
        for j in range(INSTANTS):
            share, rate = _POWERS[n, j], (n + 1) * _POWERS[n, j] / h
            out[0, j], out[3, j] = out[0, j] + share * x, out[3, j] + rate * dx
            out[1, j], out[4, j] = out[1, j] + share * y, out[4, j] + rate * dy
            out[2, j], out[5, j] = out[2, j] + share * z, out[5, j] + rate * dz
        kx, ky, kz = times(stiff, x, y, z)
        ex, ey, ez = times(damping, dx, dy, dz)
        nx, ny, nz = _unit(c, pushed if n == power else 0.0)
        f, g = h * h / ((n + 1) * (n + 2)), h / (n + 2)
        x, y, z, dx, dy, dz = dx, dy, dz, f * (nx - kx) - g * ex, f * (ny - ky) - g * ey, f * (nz - kz) - g * ez


@kernel
def _unit(axis: int, size: float) -> tuple[float, float, float]:
    """A vector of ``size`` along an axis, if there is such an axis."""
    return size if axis == 0 else 0.0, size if axis == 1 else 0.0, size if axis == 2 else 0.0
