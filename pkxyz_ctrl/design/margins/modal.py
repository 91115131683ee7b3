"""C (z I - T)^-1 B of a triangular T by its modes, for many points z at once: n p q operations a point in place of n^2.

Poles far from 0 are split off, each with the residue of its eigenvectors, which need no iteration as T is triangular;
what is left is what waits in delay lines, whose powers T^k soon are nothing::

    C (z I - T)^-1 B = sum_i C x_i y_i B / (z - l_i) + sum_k C T^k P B z^-(k+1),   P = I - sum_i x_i y_i

Poles that are nearly the same without being of one eigenspace spoil that: whether it holds is asked of a few points,
by substitution.
"""

from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

NEAR_ZERO: Final = 1e-3
"""Poles below it are left in the delay lines."""
POWERS: Final = 8
"""Of T at most, for what is left."""
NOTHING: Final = 1e-13
"""Of what is left of an input, by its size."""
_TOGETHER: Final = 64
"""Points that are worked on at once."""


def split(triangle: Complex, enters: Complex, leaves: Complex) -> tuple[Complex, Array, Array] | None:
    """Poles (k,), and parts (k + l, p q) of the residues and of the l powers, real and imaginary; None where poles of T
    (n,n) are exactly the same, or delay lines are longer than ``POWERS``.
    """
    far = np.flatnonzero(np.abs(np.diag(triangle)) > NEAR_ZERO)
    outputs, inputs = len(leaves), enters.shape[1]
    terms = np.zeros((len(far) + POWERS, outputs, inputs), np.complex128)
    rows, columns = np.ascontiguousarray(triangle), np.ascontiguousarray(triangle.T)
    used = _split(rows, columns, np.ascontiguousarray(enters), leaves, far, terms)
    flat = terms[:used].reshape(used, outputs * inputs) if used >= 0 else terms[:0, 0]
    if used < 0 or not np.isfinite(flat).all():
        return None
    return np.diag(triangle)[far].copy(), np.ascontiguousarray(flat.real), np.ascontiguousarray(flat.imag)


@njit(cache=True, error_model="numpy")
def _split(
    rows: Complex, columns: Complex, enters: Complex, leaves: Complex, far: NDArray[np.int64], terms: Complex
) -> int:  # fmt: skip
    """Fill ``terms`` (k + POWERS, p, q); how many of them there are, -1 where they do not do. T by rows and columns."""
    n, inputs = enters.shape
    vector, ahead, left = np.empty(n, np.complex128), np.empty((n, inputs), np.complex128), enters.copy()
    for m in range(len(far)):
        at = far[m]
        pole = rows[at, at]
        for q in range(inputs):
            ahead[0, q] = enters[at, q]
        vector[at] = 1.0
        for j in range(at + 1, n):  # to the left of T
            vector[j] = rows[at, j]
        for j in range(at + 1, n):
            if rows[j, j] == pole:
                return -1
            y = -vector[j] / (rows[j, j] - pole)
            vector[j] = y
            for k in range(j + 1, n):
                vector[k] += y * rows[j, k]
            for q in range(inputs):
                ahead[0, q] += y * enters[j, q]
        for j in range(at):  # to the right of it
            vector[j] = columns[at, j]
        for j in range(at - 1, -1, -1):
            if rows[j, j] == pole:
                return -1
            x = -vector[j] / (rows[j, j] - pole)
            vector[j] = x
            for k in range(j):
                vector[k] += x * columns[j, k]
        for o in range(len(leaves)):
            shown = 0j
            for j in range(at + 1):
                shown += leaves[o, j] * vector[j]
            for q in range(inputs):
                terms[m, o, q] = shown * ahead[0, q]
        for j in range(at + 1):
            for q in range(inputs):
                left[j, q] -= vector[j] * ahead[0, q]
    return _powers(rows, enters, leaves, left, ahead, terms, len(far))


@njit(cache=True, error_model="numpy")
def _powers(
    rows: Complex, enters: Complex, leaves: Complex, left: Complex, ahead: Complex, terms: Complex, first: int
) -> int:
    """Add what ``left`` (n, q) of ``enters`` makes of ``terms`` from the first on; how many there are then, or -1."""
    n, inputs = left.shape
    for m in range(first, len(terms)):
        negligible = True
        for q in range(inputs):
            most, now = 0.0, 0.0
            for i in range(n):
                most, now = max(most, abs(enters[i, q])), max(now, abs(left[i, q]))
            negligible = negligible and now <= NOTHING * most
        if negligible:
            return m
        for o in range(len(leaves)):
            for q in range(inputs):
                for i in range(n):
                    terms[m, o, q] += leaves[o, i] * left[i, q]
        for i in range(n):
            for q in range(inputs):
                ahead[i, q] = 0j
            for k in range(i, n):
                for q in range(inputs):
                    ahead[i, q] += rows[i, k] * left[k, q]
        for i in range(n):
            for q in range(inputs):
                left[i, q] = ahead[i, q]
    return -1


@njit(cache=True, error_model="numpy")
def add_up(poles: Complex, re: Array, im: Array, z: Complex, out: Complex) -> None:
    """out (m, p, q) = I + the terms for each z (m,)."""
    terms, inputs = len(re), out.shape[2]
    weight_re, weight_im = np.empty((terms, _TOGETHER)), np.empty((terms, _TOGETHER))
    total_re, total_im = np.empty(_TOGETHER), np.empty(_TOGETHER)
    for first in range(0, len(z), _TOGETHER):
        some = z[first : first + _TOGETHER]
        count = len(some)
        for m in range(len(poles)):
            for f in range(count):
                u, v = some[f].real - poles[m].real, some[f].imag - poles[m].imag
                size = 1.0 / (u * u + v * v)
                weight_re[m, f], weight_im[m, f] = u * size, -v * size
        for f in range(count):
            back, power = 1.0 / some[f], 1.0 + 0j
            for m in range(len(poles), terms):
                power *= back
                weight_re[m, f], weight_im[m, f] = power.real, power.imag
        for o in range(out.shape[1]):
            for i in range(inputs):
                total_re[:], total_im[:] = 1.0 if o == i else 0.0, 0.0
                for m in range(terms):
                    a, b, x, y = re[m, o * inputs + i], im[m, o * inputs + i], weight_re[m], weight_im[m]
                    for f in range(count):
                        total_re[f] += a * x[f] - b * y[f]
                        total_im[f] += a * y[f] + b * x[f]
                for f in range(count):
                    out[first + f, o, i] = complex(total_re[f], total_im[f])
