"""Comb forces under limits: the feasible forces whose effect on the platform is nearest to the one demanded.

    minimise  1/2 |J^T F - w|^2   subject to   lower <= F <= upper

J = dq/dx at the set-point, w the demanded platform force. Three variables, so the exact solution is a matter of trying
active sets: the free one first (in operation nearly always right), then every other until the KKT conditions hold.
Strictly convex as J is regular, hence one solution and at most 27 tries, in a fixed order: bounded time, same bits.
"""

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel

Array = NDArray[np.float64]

SCRATCH = np.dtype(
    [
        ("hessian", "f8", (3, 3)),
        ("linear", "f8", (3,)),
        ("trial_n", "f8", (3,)),
    ],
    align=True,
)
"""Room for the search: what is compiled for a board has no heap."""

_FREE, _LOWER, _UPPER = 0, 1, 2
_SETS = np.array([[code % 3, code // 3 % 3, code // 9] for code in range(27)], dtype=np.int8)
_SETS.setflags(write=False)


@kernel
def allocate(
    jacobian: Array,
    inverse: Array,
    demand_n: Array,
    lower_n: Array,
    upper_n: Array,
    force_n: Array,
    scratch: np.void,
) -> int:
    """Write the optimal comb forces (3,) to ``force_n``; returns how many active sets were tried (1: no limit was met).

    ``inverse`` is J^-1 and gives the unconstrained solution J^-T w. Needs lower <= upper. ``scratch``: a record of
    ``SCRATCH``.
    """
    inside = True
    for i in range(3):
        force_n[i] = inverse[0, i] * demand_n[0] + inverse[1, i] * demand_n[1] + inverse[2, i] * demand_n[2]
        inside = inside and lower_n[i] <= force_n[i] <= upper_n[i]
    if inside:
        return 1
    return _search(jacobian, demand_n, lower_n, upper_n, force_n, scratch)


@kernel
def _search(jacobian: Array, demand_n: Array, lower_n: Array, upper_n: Array, best: Array, scratch: np.void) -> int:
    hessian, linear, trial = scratch["hessian"], scratch["linear"], scratch["trial_n"]
    scale = 0.0
    for i in range(3):
        for k in range(3):
            hessian[i, k] = (
                jacobian[i, 0] * jacobian[k, 0] + jacobian[i, 1] * jacobian[k, 1] + jacobian[i, 2] * jacobian[k, 2]
            )
        linear[i] = jacobian[i, 0] * demand_n[0] + jacobian[i, 1] * demand_n[1] + jacobian[i, 2] * demand_n[2]
        scale = max(scale, abs(linear[i]), abs(upper_n[i]))
    tolerance = 1e-13 * scale
    least = np.inf
    for code in range(1, 27):
        state = _SETS[code]
        _solve_fixed(hessian, linear, lower_n, upper_n, state, trial)
        violation = kkt_violation(hessian, linear, lower_n, upper_n, state, trial)
        if violation < least:
            least = violation
            for i in range(3):
                best[i] = min(max(trial[i], lower_n[i]), upper_n[i])
        if violation <= tolerance:
            return code + 1
    return 27


@kernel
def _solve_fixed(
    hessian: Array, linear: Array, lower: Array, upper: Array, state: NDArray[np.int8], out: Array
) -> None:
    """Minimise 1/2 F^T H F - linear^T F with the non-free components held at their bounds."""
    i, k = -1, -1  # the first and the last that are free
    for n in range(3):
        if state[n] == _FREE:
            i, k = n if i < 0 else i, n
        else:
            out[n] = lower[n] if state[n] == _LOWER else upper[n]
    if i < 0:
        return
    if i == k:
        out[i] = _residual(hessian, linear, state, out, i) / hessian[i, i]
    else:
        ri, rk = _residual(hessian, linear, state, out, i), _residual(hessian, linear, state, out, k)
        determinant = hessian[i, i] * hessian[k, k] - hessian[i, k] * hessian[k, i]
        out[i] = (hessian[k, k] * ri - hessian[i, k] * rk) / determinant
        out[k] = (hessian[i, i] * rk - hessian[k, i] * ri) / determinant


@kernel
def _residual(hessian: Array, linear: Array, state: NDArray[np.int8], fixed: Array, row: int) -> float:
    """Right-hand side of a free row after the fixed components went over to it."""
    total = linear[row]
    for k in range(3):
        if state[k] != _FREE:
            total -= hessian[row, k] * fixed[k]
    return total


@kernel
def kkt_violation(
    hessian: Array, linear: Array, lower: Array, upper: Array, state: NDArray[np.int8], force: Array
) -> float:
    """How far a candidate is from the KKT conditions: bounds passed by free components, multipliers of the wrong sign
    (both in N).
    """
    worst = 0.0
    for i in range(3):
        if state[i] == _FREE:
            worst = max(worst, lower[i] - force[i], force[i] - upper[i])
        else:
            slope = -linear[i]
            for k in range(3):
                slope += hessian[i, k] * force[k]
            worst = max(worst, -slope if state[i] == _LOWER else slope)
    return worst
