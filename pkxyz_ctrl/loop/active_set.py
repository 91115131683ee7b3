"""A small strictly convex quadratic program with two-sided limits, solved exactly; compiled.

    minimise  1/2 v^T H v + q^T v,   lower <= A v <= upper

The dual method of Goldfarb and Idnani ("A numerically stable dual method for solving strictly convex quadratic
programs", Mathematical Programming 27, 1983): from the minimum without limits it takes in one limit after another, the
one passed by most, and lets go of those that hold nothing back any more. Each step raises the dual's value, so no set
of limits comes twice, and it ends. It may as well begin with limits of which it is guessed that they hold: those of the
guess that hold nothing back are let go first.

H and A never change, so all of it happens between the limits: with multipliers y, positive at an upper limit,
A v = f - M y, where f is A v at the minimum without limits, and M = A H^-1 A^T. The first rows of A are the unknowns
themselves, one row each; an unknown further on, without a slope and limits of its own, has none. So A v begins with the
solution, and M is all that has to be known.
"""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel

Array = NDArray[np.float64]
Records = NDArray[np.void]

TOO_LONG, IMPOSSIBLE = -1, -2
"""What ``solve`` says where it has no solution: more rounds than allowed, or limits that exclude each other."""

LIMITS_MOST: Final = 184
HELD_MOST: Final = 64
"""Limits that there may be, and that may be held at a time: one more than unknowns."""
_TOGETHER: Final = 4  # numbers that a processor works on at once: rows begin at multiples of so many

PROGRAM = np.dtype(
    [
        ("limits", "i8"),  # m
        ("row", "i8"),  # from one row of M to the next
        ("held_most", "i8"),
        ("held_row", "i8"),  # from one row of its factor to the next
        ("sweeps", "i8"),  # in which many limits change at once
        ("between", "f8", (LIMITS_MOST * LIMITS_MOST,)),  # M by rows; last, as few limits need little of it
    ],
    align=True,
)

WORK = np.dtype(
    [
        ("free", "f8", (LIMITS_MOST,)),  # f
        ("lower", "f8", (LIMITS_MOST,)),
        ("upper", "f8", (LIMITS_MOST,)),
        ("value", "f8", (LIMITS_MOST,)),  # A v
        ("multiplier", "f8", (HELD_MOST,)),  # y of the limits that are held
        ("release", "f8", (HELD_MOST,)),  # by which these fall while the next multiplier grows
        ("side", "f8", (HELD_MOST,)),  # 1.0: held at its upper limit, -1.0: at its lower one
        ("share", "f8", (HELD_MOST,)),  # 1 / D; 0 for a limit that those before it determine
        ("column", "f8", (HELD_MOST,)),  # of D L^T, for one limit more
        ("held", "i8", (HELD_MOST,)),  # which they are
        ("count", "i8"),  # how many
        ("factor", "f8", (HELD_MOST * HELD_MOST,)),  # D L^T by rows, L D L^T = M between them; last, likewise
    ],
    align=True,
)

_SWEEPS: Final = 6
_PASSED: Final = 1e-9  # by less than that a limit is kept, in its own unit
_OTHERS: Final = 1e-10  # of M's diagonal: less is left of a limit that the ones held determine


def program(hessian: Array, rows: Array) -> Records:
    """(1,) of ``PROGRAM`` for H (n, n), symmetric and positive definite, and A (m, n)."""
    (limits, unknowns), made = rows.shape, np.zeros(1, PROGRAM)
    product = rows @ np.linalg.solve(hessian, rows.T)
    row = made["row"][0] = _padded(limits)
    made["limits"], made["held_most"], made["held_row"] = limits, unknowns + 1, _padded(unknowns + 1)
    made["sweeps"] = _SWEEPS
    matrix = made["between"][0, : limits * row].reshape(limits, row)
    matrix[:, :limits] = (product + product.T) / 2.0
    return made


def used_bytes(limits: int, unknowns: int) -> tuple[int, int]:
    """Of ``PROGRAM`` and of ``WORK``, for m limits and n unknowns, from their beginnings."""
    held = unknowns + 1
    numbers = limits * _padded(limits), held * _padded(held)
    behind = (LIMITS_MOST * LIMITS_MOST - numbers[0], HELD_MOST * HELD_MOST - numbers[1])
    return PROGRAM.itemsize - 8 * behind[0], WORK.itemsize - 8 * behind[1]


def _padded(count: int) -> int:
    return -(-count // _TOGETHER) * _TOGETHER


@kernel
def solve(program: np.void, work: np.void, rounds_max: int) -> int:
    """From ``free`` and limits in ``work``, lower not above upper, make ``value``, which begins with the solution.
    Returns how many rounds it took, or ``TOO_LONG`` or ``IMPOSSIBLE``.

    Begins with the ``count`` limits ``held`` at their ``side`` and leaves those of the solution there; none without.
    """
    rounds = 0
    _put_in_order(work)
    while rounds < min(program["sweeps"], rounds_max):
        rounds += 1
        _hold(program, work)
        _values(program, work)
        if not _exchange(program, work):
            return rounds
    _hold(program, work)
    while rounds < rounds_max and _let_go_wrong(work):
        rounds += 1
        _hold(program, work)
    answer: int = _one_by_one(program, work, rounds, rounds_max)
    if answer < 0:
        work["count"] = 0
    return answer


@kernel
def _one_by_one(program: np.void, work: np.void, rounds: int, rounds_max: int) -> int:
    """Take in and let go single limits, from some that all hold something back. Each is a round."""
    value, lower, upper, multiplier, held = (
        work["value"],
        work["lower"],
        work["upper"],
        work["multiplier"],
        work["held"],
    )
    between, new, sign, passed = program["between"], -1, 1.0, 0.0
    while rounds < rounds_max:
        rounds += 1
        count = work["count"]
        if new < 0:
            _values(program, work)
            new = _passed_most(value, lower, upper, program["limits"])
            if new < 0:
                return rounds
            sign = 1.0 if value[new] > upper[new] else -1.0
            passed = value[new] - upper[new] if sign > 0.0 else lower[new] - value[new]
            multiplier[count] = 0.0
        left = _released(program, work, new)
        first, far = _first_released(multiplier, work["release"], sign, count)
        if left > _OTHERS * between[new * program["row"] + new] and count < program["held_most"]:
            if passed <= far * left:
                first, far = -1, passed / left
        elif first < 0:
            return IMPOSSIBLE
        passed -= far * left
        for k in range(count):
            multiplier[k] -= sign * far * work["release"][k]
        multiplier[count] += sign * far
        if first < 0:
            _border(work, program["held_row"], left)
            held[count], work["side"][count], new, work["count"] = new, sign, -1, count + 1
        else:
            for k in range(first, count):
                multiplier[k], held[k], work["side"][k] = multiplier[k + 1], held[k + 1], work["side"][k + 1]
            work["count"] = count - 1
            _factorise(program, work)
    return TOO_LONG


@kernel
def _hold(program: np.void, work: np.void) -> None:
    """Multipliers with which the held limits are just met."""
    held, side, beyond = work["held"], work["side"], work["multiplier"]
    _factorise(program, work)
    for k in range(work["count"]):
        limit = held[k]
        beyond[k] = work["free"][limit] - (work["upper"][limit] if side[k] > 0.0 else work["lower"][limit])
    _forwards(work, program["held_row"], beyond)
    _backwards(work, program["held_row"], beyond)


@kernel
def _let_go_wrong(work: np.void) -> bool:
    """Hold no limit any more whose multiplier has the wrong sign; returns whether there was one."""
    held, side, multiplier, count = work["held"], work["side"], work["multiplier"], 0
    before = work["count"]
    for k in range(before):
        if side[k] * multiplier[k] > 0.0:
            held[count], side[count] = held[k], side[k]
            count += 1
    work["count"] = count
    return bool(count < before)


@kernel
def _exchange(program: np.void, work: np.void) -> bool:
    """Let go of those that hold nothing back and take in all that are passed; returns whether there was any. The new
    ones come first, and of either the first rows: where limits determine each other, the last is left out.
    """
    value, lower, upper, held, side = work["value"], work["lower"], work["upper"], work["held"], work["side"]
    changes, count = _let_go_wrong(work), 0
    _put_in_order(work)
    kept = work["count"]
    old = away = HELD_MOST - kept
    for k in range(kept - 1, -1, -1):
        held[away + k], side[away + k] = held[k], side[k]
    for i in range(program["limits"]):
        above, below = value[i] - upper[i], lower[i] - value[i]
        if old < HELD_MOST and held[old] == i:
            old += 1
        elif (above if above > below else below) > _PASSED and count + kept < program["held_most"]:
            held[count], side[count] = i, 1.0 if above > below else -1.0
            count += 1
    for k in range(kept):
        held[count + k], side[count + k] = held[away + k], side[away + k]
    work["count"] = count + kept
    return bool(changes or count > 0)


@kernel
def _put_in_order(work: np.void) -> None:
    """The limits that are held by their rows, each once."""
    held, side, count = work["held"], work["side"], 0
    for k in range(work["count"]):
        limit, at_side, at = held[k], side[k], count
        while at > 0 and held[at - 1] > limit:
            at -= 1
        if at > 0 and held[at - 1] == limit:
            continue
        for j in range(count, at, -1):
            held[j], side[j] = held[j - 1], side[j - 1]
        held[at], side[at] = limit, at_side
        count += 1
    work["count"] = count


@kernel
def _values(program: np.void, work: np.void) -> None:
    """A v = f - M y."""
    between, held, share, row = program["between"], work["held"], work["multiplier"], program["row"]
    free, value, count = work["free"], work["value"], work["count"]
    for i in range(row):
        value[i] = free[i]
    fours = count & ~3
    for k in range(0, fours, 4):
        a, b, c, d = held[k] * row, held[k + 1] * row, held[k + 2] * row, held[k + 3] * row
        _take_four(between, a, b, c, d, share[k], share[k + 1], share[k + 2], share[k + 3], row, value, 0)
    for k in range(fours, count):
        _take(between, held[k] * row, share[k], row, value, 0)


@kernel
def _factorise(program: np.void, work: np.void) -> None:
    """D L^T of the limits held. A limit that those before it determine is left out, and gets no multiplier."""
    between, factor, share, held, row = (
        program["between"], work["factor"], work["share"], work["held"], program["held_row"],
    )  # fmt: skip
    count = work["count"]
    for j in range(count):
        of_limit, at, length = np.uint64(held[j] * program["row"]), j * row + j, count - j
        for i in range(length):
            factor[np.uint64(at + i)] = between[of_limit + np.uint64(held[j + i])]
        own, fours = factor[at], j & ~3
        for k in range(0, fours, 4):
            a, b, c, d = k * row + j, (k + 1) * row + j, (k + 2) * row + j, (k + 3) * row + j
            p, r, s, t = (
                factor[a] * share[k],
                factor[b] * share[k + 1],
                factor[c] * share[k + 2],
                factor[d] * share[k + 3],
            )
            _take_four(factor, a, b, c, d, p, r, s, t, length, factor, at)
        for k in range(fours, j):
            _take(factor, k * row + j, factor[k * row + j] * share[k], length, factor, at)
        left = factor[at]
        share[j] = 1.0 / left if left > _OTHERS * own else 0.0


@kernel
def _forwards(work: np.void, row: int, z: Array) -> None:
    """L z' = z in its place."""
    count, share = work["count"], work["share"]
    for k in range(count - 1):
        _take(work["factor"], k * row + k + 1, z[k] * share[k], count - k - 1, z, k + 1)


@kernel
def _backwards(work: np.void, row: int, z: Array) -> None:
    """D L^T y = z in its place, in four sums."""
    count, share, factor = work["count"], work["share"], work["factor"]
    for k in range(count - 1, -1, -1):
        a, b, c, d, at, end = z[k], 0.0, 0.0, 0.0, np.uint64(k * row), np.uint64(count)
        i, one = np.uint64(k + 1), np.uint64(1)
        while (end - i) & np.uint64(3):
            a -= factor[at + i] * z[i]
            i += one
        while i < end:
            a -= factor[at + i] * z[i]
            b -= factor[at + i + one] * z[i + one]
            c -= factor[at + i + np.uint64(2)] * z[i + np.uint64(2)]
            d -= factor[at + i + np.uint64(3)] * z[i + np.uint64(3)]
            i += np.uint64(4)
        z[k] = ((a + b) + (c + d)) * share[k]


@kernel
def _take(matrix: Array, at: int, share: float, count: int, out: Array, to: int) -> None:
    """Take a share of so many numbers of a matrix, from ``at`` on, off those of ``out`` from ``to`` on."""
    first, begin = np.uint64(at), np.uint64(to)  # numba looks at each signed index whether it is negative
    for i in range(np.uint64(count)):
        out[begin + i] -= share * matrix[first + i]


@kernel
def _take_four(
    matrix: Array, a: int, b: int, c: int, d: int, p: float, r: float, s: float, t: float, count: int, out: Array,
    to: int,
) -> None:  # fmt: skip
    """The same from four places at once, in the order of one after the other."""
    first, second, third, fourth, begin = np.uint64(a), np.uint64(b), np.uint64(c), np.uint64(d), np.uint64(to)
    for i in range(np.uint64(count)):
        left = out[begin + i] - p * matrix[first + i] - r * matrix[second + i]
        out[begin + i] = left - s * matrix[third + i] - t * matrix[fourth + i]


@kernel
def _released(program: np.void, work: np.void, new: int) -> float:
    """Write by which the multipliers of those held fall while that of limit ``new`` grows, and its ``column``. Returns
    what is left of its own entry of M: by which it falls.
    """
    held, release, column, share, between = (
        work["held"], work["release"], work["column"], work["share"], program["between"],
    )  # fmt: skip
    at, count = new * program["row"], work["count"]
    own = between[at + new]
    for k in range(count):
        release[k] = between[at + held[k]]
    _forwards(work, program["held_row"], release)
    for k in range(count):
        column[k] = release[k]
        own -= release[k] * release[k] * share[k]
    _backwards(work, program["held_row"], release)
    return own


@kernel
def _border(work: np.void, row: int, own: float) -> None:
    """The factor of one limit more, whose ``column`` is known."""
    factor, count = work["factor"], work["count"]
    for k in range(count):
        factor[k * row + count] = work["column"][k]
    factor[count * row + count], work["share"][count] = own, 1.0 / own


@kernel
def _passed_most(value: Array, lower: Array, upper: Array, limits: int) -> int:
    """The limit that A v (m,) passes by most; -1 if it keeps all."""
    passed, most = -1, _PASSED
    for i in range(limits):
        above, below = value[i] - upper[i], lower[i] - value[i]
        by = above if above > below else below
        if by > most:
            passed, most = i, by
    return passed


@kernel
def _first_released(multiplier: Array, release: Array, sign: float, count: int) -> tuple[int, float]:
    """Which of the held limits holds nothing back any more first, and after how far; -1 and infinity if none ever."""
    first, far = -1, math.inf
    for k in range(count):
        falls = sign * release[k]
        if falls * multiplier[k] > 0.0 and multiplier[k] / falls < far:
            first, far = k, multiplier[k] / falls
    return first, far
