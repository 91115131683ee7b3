"""A small strictly convex quadratic program with two-sided limits, solved exactly; compiled.

    minimise  1/2 v^T H v + q^T v,   lower <= A v <= upper

The dual method of Goldfarb and Idnani ("A numerically stable dual method for solving strictly convex quadratic
programs", Mathematical Programming 27, 1983): from the minimum without limits it takes in one limit after another, the
one passed by most, and lets go of those that hold nothing back any more. Each step raises the dual's value, so no set
of limits comes twice, and it ends.

H and A never change, so all of it happens between the limits: with multipliers y, positive at an upper limit,
A v = -A H^-1 q - M y, where M = A H^-1 A^T. The first rows of A are the unknowns themselves, one row each; an unknown
further on, without a slope and limits of its own, has none. So A v begins with the solution, the first columns of M are
A H^-1, and M is all that has to be known.

It begins anew at each problem: the answer depends on the problem alone.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

TOO_LONG, IMPOSSIBLE = -1, -2
"""What ``solve`` says where it has no solution: more rounds than allowed, or limits that exclude each other."""

_PASSED = 1e-9  # by less than that a limit is kept, in its own unit
_OTHERS = 1e-10  # of M's diagonal: less is left of a limit that the ones held determine


Work = tuple[Array, Array, Array, Array, Array, NDArray[np.int64]]
"""Memory of ``solve`` for n unknowns and m limits: A v (m,); by which it falls (m,) while the next multiplier grows and
the limits that are held stay where they are; their multipliers (n + 1,), and by which those fall meanwhile; the inverse
of M between them (n + 1, n + 1); which they are. Nothing in it is kept from one problem to the next."""


def between(hessian: Array, rows: Array) -> Array:
    """M (m, m) for H (n, n), symmetric and positive definite, and A (m, n)."""
    product = rows @ np.linalg.solve(hessian, rows.T)
    return np.ascontiguousarray((product + product.T) / 2.0)


def work(unknowns: int, limits: int) -> Work:
    """Memory for such problems."""
    most = unknowns + 1
    held = np.zeros(most, np.int64)
    return np.zeros(limits), np.zeros(limits), np.zeros(most), np.zeros(most), np.zeros((most, most)), held


@njit(cache=True, error_model="numpy")
def solve(between: Array, memory: Work, q: Array, lower: Array, upper: Array, rounds_max: int, v: Array) -> int:
    """Put the solution into v, of the length of q, and return how many rounds it took, one more than limits were taken
    in or let go; or ``TOO_LONG`` or ``IMPOSSIBLE``, v unchanged. ``lower`` and ``upper`` (m,), one not above the other.
    """
    value, slope, multiplier, release, inverse, held = memory
    limits, count, new, sign = len(value), 0, -1, 1.0
    _values_without_limits(between, q, value)
    for rounds in range(1, rounds_max + 1):
        if new < 0:
            new = _passed_most(value, lower, upper, slope)
            if new < 0:
                v[:] = value[: len(v)]
                return rounds
            sign = 1.0 if value[new] > upper[new] else -1.0
            multiplier[count] = 0.0
        _released(between[new], inverse, held, count, release)
        first, far = _first_released(multiplier, release, sign, count)
        for i in range(limits):
            slope[i] = between[new, i]
        _take_off(between, held, release, count, slope)
        if slope[new] > _OTHERS * between[new, new] and count < len(held):
            by = value[new] - upper[new] if sign > 0.0 else lower[new] - value[new]
            if by <= far * slope[new]:
                first, far = -1, by / slope[new]
        elif first < 0:
            return IMPOSSIBLE
        for i in range(limits):
            value[i] -= sign * far * slope[i]
        for k in range(count):
            multiplier[k] -= sign * far * release[k]
        multiplier[count] += sign * far
        if first < 0:
            _border(inverse, release, slope[new], count)
            held[count], new, count = new, -1, count + 1
        else:
            count -= 1
            _let_go(inverse, first, count)
            held[first], multiplier[first], multiplier[count] = held[count], multiplier[count], multiplier[count + 1]
    return TOO_LONG


@njit(cache=True, error_model="numpy")
def _values_without_limits(between: Array, q: Array, value: Array) -> None:
    value[:] = 0.0
    n = len(q)
    for j in range(0, n - n % 4, 4):
        a, b, c, d = between[j], between[j + 1], between[j + 2], between[j + 3]
        p, r, s, t = q[j], q[j + 1], q[j + 2], q[j + 3]
        for i in range(len(value)):
            value[i] = value[i] - p * a[i] - r * b[i] - s * c[i] - t * d[i]
    for j in range(n - n % 4, n):
        for i in range(len(value)):
            value[i] -= q[j] * between[j, i]


@njit(cache=True, error_model="numpy")
def _released(row: Array, inverse: Array, held: NDArray[np.int64], count: int, out: Array) -> None:
    """By which the multipliers of those held fall while that of the limit of this ``row`` of M grows."""
    for j in range(count):
        out[j] = 0.0
    fours = count - count % 4
    for k in range(0, fours, 4):
        a, b, c, d = inverse[k], inverse[k + 1], inverse[k + 2], inverse[k + 3]
        p, r, s, t = row[held[k]], row[held[k + 1]], row[held[k + 2]], row[held[k + 3]]
        for j in range(count):
            out[j] = out[j] + p * a[j] + r * b[j] + s * c[j] + t * d[j]
    for k in range(fours, count):
        a, p = inverse[k], row[held[k]]
        for j in range(count):
            out[j] += p * a[j]


@njit(cache=True, error_model="numpy")
def _take_off(between: Array, held: NDArray[np.int64], shares: Array, count: int, out: Array) -> None:
    """Less the rows of M of those held times their shares; four at once, in the order of one after the other."""
    fours = count - count % 4
    for k in range(0, fours, 4):
        a, b, c, d = between[held[k]], between[held[k + 1]], between[held[k + 2]], between[held[k + 3]]
        p, r, s, t = shares[k], shares[k + 1], shares[k + 2], shares[k + 3]
        for i in range(len(out)):
            out[i] = out[i] - p * a[i] - r * b[i] - s * c[i] - t * d[i]
    for k in range(fours, count):
        a, p = between[held[k]], shares[k]
        for i in range(len(out)):
            out[i] -= p * a[i]


@njit(cache=True, error_model="numpy")
def _passed_most(value: Array, lower: Array, upper: Array, by: Array) -> int:
    """The limit that A v (m,) passes by most; -1 if it keeps all. ``by`` (m,): by how much each is, afterwards."""
    for i in range(len(value)):
        above, below = value[i] - upper[i], lower[i] - value[i]
        by[i] = above if above > below else below
    passed, most = -1, _PASSED
    for i in range(len(by)):
        if by[i] > most:
            passed, most = i, by[i]
    return passed


@njit(cache=True, error_model="numpy")
def _first_released(multiplier: Array, release: Array, sign: float, count: int) -> tuple[int, float]:
    """Which of the held limits holds nothing back any more first, and after how far; -1 and infinity if none ever."""
    first, far = -1, math.inf
    for k in range(count):
        falls = sign * release[k]
        if falls * multiplier[k] > 0.0 and multiplier[k] / falls < far:
            first, far = k, multiplier[k] / falls
    return first, far


@njit(cache=True, error_model="numpy")
def _border(inverse: Array, release: Array, own: float, count: int) -> None:
    """The inverse of one row and column more."""
    for j in range(count):
        part = release[j] / own
        for k in range(count):
            inverse[j, k] += part * release[k]
        inverse[j, count] = inverse[count, j] = -part
    inverse[count, count] = 1.0 / own


@njit(cache=True, error_model="numpy")
def _let_go(inverse: Array, k: int, last: int) -> None:
    """The inverse without row and column k, whose place the last one takes."""
    for i in range(last + 1):
        inverse[k, i], inverse[last, i] = inverse[last, i], inverse[k, i]
    for i in range(last + 1):
        inverse[i, k], inverse[i, last] = inverse[i, last], inverse[i, k]
    for i in range(last):
        part = inverse[i, last] / inverse[last, last]
        for j in range(last):
            inverse[i, j] -= part * inverse[last, j]
