"""The predictive law's problem at one tick: where a plan leads, what the combs and strokes still allow beside it, and
whether it keeps all limits; compiled.

With e = [x - r, v - r'] at the start of interval k, and nu the force that the linear model is given::

    e+ = Phi e + Gamma nu + c,   minimise  sum e^T Q e + nu^T nu  + e_N^T P e_N

c is where the reference jumps. P solves the regulator's Riccati equation, so the plan without limits begins with the
regulator's own answer. What the combs must give for nu is not linear::

    B(x)^T F = grad V(x) + C r' + m r'' - K_0 (x - r) + nu - d

taken in mid-interval, on the cubic that joins both its ends; so the model holds wherever the stage goes, and K_0 and
B_0 at one point serve everywhere (B: ``kinematics.pulls``). The variables are comb forces v = B_0^-T nu. Limits of F
and of strokes become limits of v about those that the last plan leads to; from tick to tick they become exact.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pkxyz_ctrl.core import feedback, kinematics
from pkxyz_ctrl.core.elasticity import energy_gradient
from pkxyz_ctrl.core.linear3 import inverse3, multiply3, multiply3_transposed

Array = NDArray[np.float64]

PREDICTIVE = np.dtype(
    [
        ("cost_to_go", "f8", (6, 6)),  # P
        ("closed", "f8", (6, 6)),  # Phi - Gamma K
        ("answer", "f8", (3, 6)),  # (1 + Gamma^T P Gamma)^-1 Gamma^T
        ("position_weight", "f8"),  # of Q, (N/m)^2
        ("velocity_weight", "f8"),  # (N s/m)^2
        ("stroke_min_m", "f8"),
        ("stroke_max_m", "f8"),
        ("horizon", "i4"),  # intervals
        ("iterations_max", "i4"),  # rounds of the solver in one tick
    ],
    align=True,
)

NO_PLAN, FREE, LIMITED = 0, 1, 2
"""What there is: nothing; the plan without limits, which keeps them all and so is the solution; a problem to solve."""

_JUMP_M = 2e-9  # smooth references miss their own polynomial by 0.1 nm where the jerk switches


@njit(cache=True, error_model="numpy")
def deviation(law: np.void, memory: np.void, rows: Array, error: Array) -> None:
    """e (6,) at the start of the first interval, as the state feedback sees it."""
    gains, row, target, force = law["feedback"], np.empty(9), np.empty(9), np.empty(3)
    feedback.ahead(gains, rows[0], rows[1], row)
    energy_gradient(law["geometry"], law["elasticity"], row[0:3], force)
    feedback.add_motion(gains, row, force)
    last = force.copy()
    if memory["feedforward_known"] != 0:
        last[:] = memory["feedforward_n"]
    feedback.sampled_target(gains, rows[0], force, last, target)
    ahead, origin = memory["estimate"]["ahead"], law["estimator"]["operating_point_m"]
    for i in range(3):
        error[i] = origin[i] + ahead[i] - target[i]
        error[3 + i] = ahead[3 + i] - target[3 + i]


@njit(cache=True, error_model="numpy")
def jumps(period_s: float, rows: Array, jump_m: Array) -> bool:
    """c (n,3): where a row (n+1, 9) of the reference is not what the row before leads to; returns if anywhere."""
    found = False
    for k in range(len(rows) - 1):
        for i in range(3):
            v, a = rows[k, 3 + i], (2.0 * rows[k, 6 + i] + rows[k + 1, 6 + i]) / 3.0
            miss = rows[k, i] + period_s * (v + 0.5 * period_s * a) - rows[k + 1, i]
            jump_m[k, i] = miss if abs(miss) > _JUMP_M else 0.0
            found = found or abs(miss) > _JUMP_M
    return found


@njit(cache=True, error_model="numpy")
def free_plan(law: np.void, error: Array, jump_m: Array, jumps: bool, e: Array, nu_n: Array) -> None:
    """The plan nu (n,3) that knows no limits, and where it leads from the deviation ``error`` (6,): e (n+1, 6).

    nu_k = -K e_k - B (P c_k + h_k+1), where h carries later jumps back: h_k = (Phi - Gamma K)^T (P c_k + h_k+1).
    """
    numbers, gains, after, seen = law["predictive"], law["feedback"], np.zeros(6), np.empty(6)
    nu_n[:] = 0.0
    if jumps:
        for k in range(len(nu_n) - 1, -1, -1):
            for i in range(6):
                seen[i] = after[i]
                for j in range(3):
                    seen[i] += numbers["cost_to_go"][i, j] * jump_m[k, j]
            for i in range(3):
                for j in range(6):
                    nu_n[k, i] -= numbers["answer"][i, j] * seen[j]
            for i in range(6):
                after[i] = 0.0
                for j in range(6):
                    after[i] += numbers["closed"][j, i] * seen[j]
    e[0] = error
    for k in range(len(nu_n)):
        for i in range(3):
            for j in range(3):
                nu_n[k, i] -= gains["position_gain_n_per_m"][i, j] * e[k, j]
                nu_n[k, i] -= gains["velocity_gain_n_s_per_m"][i, j] * e[k, 3 + j]
        _step(law["estimator"], e[k], nu_n[k], jump_m[k], e[k + 1])


@njit(cache=True, error_model="numpy")
def predict(law: np.void, error: Array, jump_m: Array, nu_n: Array, e: Array) -> None:
    """Where a plan nu (n,3) leads from the deviation ``error`` (6,): e (n+1, 6)."""
    e[0] = error
    for k in range(len(nu_n)):
        _step(law["estimator"], e[k], nu_n[k], jump_m[k], e[k + 1])


@njit(cache=True, error_model="numpy")
def _step(estimator: np.void, e: Array, nu_n: Array, jump_m: Array, out: Array) -> None:
    phi, gamma = estimator["transition"], estimator["input"]
    for i in range(6):
        total = jump_m[i] if i < 3 else 0.0
        for j in range(6):
            total += phi[i, j] * e[j]
        for j in range(3):
            total += gamma[i, j] * nu_n[j]
        out[i] = total


@njit(cache=True, error_model="numpy")
def slope(law: np.void, pulls0: Array, e: Array, out: Array) -> None:
    """Half the derivative (3n,) of the cost by v at v = 0, from where that leads: e
    (n+1, 6). Backwards, as adjoints go.
    """
    numbers, phi, gamma = law["predictive"], law["estimator"]["transition"], law["estimator"]["input"]
    adjoint, before, by_nu = np.empty(6), np.empty(6), np.empty(3)
    n = len(e) - 1
    for i in range(6):
        adjoint[i] = 0.0
        for j in range(6):
            adjoint[i] += numbers["cost_to_go"][i, j] * e[n, j]
    for k in range(n - 1, -1, -1):
        for i in range(3):
            by_nu[i] = 0.0
            for j in range(6):
                by_nu[i] += gamma[j, i] * adjoint[j]
        multiply3(pulls0, by_nu, out[3 * k : 3 * k + 3])
        for i in range(6):
            before[i] = (numbers["position_weight"] if i < 3 else numbers["velocity_weight"]) * e[k, i]
            for j in range(6):
                before[i] += phi[j, i] * adjoint[j]
        adjoint[:] = before


Scratch = tuple[Array, Array, Array, Array, Array, Array, Array]


@njit(cache=True, error_model="numpy")
def scratch() -> Scratch:
    """Memory for ``comb_forces``, which would take longer to get it anew than to work in it."""
    return np.empty(9), np.empty(6), np.empty(3), np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))


@njit(cache=True, error_model="numpy")
def comb_forces(
    law: np.void, now: Array, after: Array, e: Array, nu_n: Array, disturbance_n: Array, comb_n: Array, memory: Scratch
) -> bool:
    """F (3,) that gives nu (3,) in the interval between two rows (9,) of the reference, from deviation e (6,) at its
    start. False where the links do not reach.
    """
    gains, filter_ = law["feedback"], law["estimator"]
    row, end, off, middle, force, pulls, inverse = memory
    feedback.ahead(gains, now, after, row)
    off[:] = 0.0
    _step(filter_, e, nu_n, off, end)
    for i in range(3):
        off[i] = 0.5 * (e[i] + end[i]) + 0.25 * filter_["half_period_s"] * (e[3 + i] - end[3 + i])
        middle[i] = row[i] + off[i]
    if kinematics.in_domain(law["geometry"], middle) != 0:
        return False
    energy_gradient(law["geometry"], law["elasticity"], middle, force)
    feedback.add_motion(gains, row, force)
    for i in range(3):
        force[i] += nu_n[i] - disturbance_n[i]
        for k in range(3):
            force[i] -= filter_["stiffness_n_per_m"][i, k] * off[k]
    kinematics.pulls(law["geometry"], middle, pulls)
    inverse3(pulls, inverse)
    multiply3_transposed(inverse, force, comb_n)
    return True


@njit(cache=True, error_model="numpy")
def forces_and_strokes(
    law: np.void, rows: Array, e: Array, nu_n: Array, disturbance_n: Array, comb_n: Array, stroke_m: Array,
    memory: Scratch,
) -> bool:  # fmt: skip
    """Comb forces (n,3) that a plan nu (n,3) takes along rows (n+1, 9), with its e (n+1, 6), and strokes (n,3) at the
    ends of the intervals. False where the links do not reach.
    """
    for k in range(len(nu_n)):
        if not _interval(law, rows, e, nu_n, disturbance_n, k, comb_n[k], stroke_m[k], memory):
            return False
    return True


@njit(cache=True, error_model="numpy")
def keeps_limits(
    law: np.void, rows: Array, e: Array, nu_n: Array, disturbance_n: Array, count: Array, lower_m: Array,
    upper_m: Array, comb_n: Array, stroke_m: Array, memory: Scratch,
) -> bool:  # fmt: skip
    """Whether forces and strokes of a plan, as above, keep voltage and slew after the last counts (3,) and limits (n,3)
    of strokes. It ends at the first interval that does not.
    """
    drive, volt = law["drive"], np.empty(3)
    gain, most = drive["force_gain_n_per_v2"], drive["volt_per_count"] * drive["count_max"]
    step = drive["volt_per_count"] * drive["count_slew_max"]
    for i in range(3):
        volt[i] = drive["volt_per_count"] * count[i]
    for k in range(len(nu_n)):
        if not _interval(law, rows, e, nu_n, disturbance_n, k, comb_n[k], stroke_m[k], memory):
            return False
        for i in range(3):
            if not 0.0 <= comb_n[k, i] <= gain[i] * most * most:
                return False
            before, volt[i] = volt[i], math.sqrt(comb_n[k, i] / gain[i])
            if abs(volt[i] - before) > step or not lower_m[k, i] <= stroke_m[k, i] <= upper_m[k, i]:
                return False
    return True


@njit(cache=True, error_model="numpy")
def _interval(
    law: np.void, rows: Array, e: Array, nu_n: Array, disturbance_n: Array, k: int, comb_n: Array, stroke_m: Array,
    memory: Scratch,
) -> bool:  # fmt: skip
    """Comb forces (3,) in interval k, and strokes (3,) at its end. False where the links do not reach."""
    if not comb_forces(law, rows[k], rows[k + 1], e[k], nu_n[k], disturbance_n, comb_n, memory):
        return False
    end = memory[2]
    for i in range(3):
        end[i] = rows[k + 1, i] + e[k + 1, i]
    if kinematics.in_domain(law["geometry"], end) != 0:
        return False
    kinematics.strokes(law["geometry"], end, stroke_m)
    return True


@njit(cache=True, error_model="numpy")
def stroke_limits(law: np.void, rows: Array, lower_m: Array, upper_m: Array) -> None:
    """Limits (n, 3) of those strokes, where a reference that is beyond them has its own."""
    asked = np.empty(3)
    low, high = law["predictive"]["stroke_min_m"], law["predictive"]["stroke_max_m"]
    for m in range(len(lower_m)):
        kinematics.strokes(law["geometry"], rows[m + 1, 0:3], asked)
        for i in range(3):
            lower_m[m, i] = min(low, asked[i])
            upper_m[m, i] = max(high, asked[i])


@njit(cache=True, error_model="numpy")
def comb_bounds(drive: np.void, count: Array, about_n: Array, lower: Array, upper: Array) -> None:
    """Bounds (3n,) of v from what the voltages can be after 1, 2, ... periods of slewing from the last counts (3,);
    ``about_n`` (n,3): comb forces less v, as a plan has them.
    """
    gain, scale = drive["force_gain_n_per_v2"], drive["volt_per_count"]
    for k in range(len(about_n)):
        slew = (k + 1) * drive["count_slew_max"]
        for i in range(3):
            low, high = scale * max(0, count[i] - slew), scale * min(drive["count_max"], count[i] + slew)
            lower[3 * k + i] = gain[i] * low * low - about_n[k, i]
            upper[3 * k + i] = gain[i] * high * high - about_n[k, i]


@njit(cache=True, error_model="numpy")
def slew_bounds(drive: np.void, about_n: Array, comb_n: Array, lower: Array, upper: Array) -> None:
    """Bounds (3n-3,) of v_k - v_(k-1) from the slew limit, about comb forces (n,3) that were planned."""
    gain = drive["force_gain_n_per_v2"]
    step_v = drive["volt_per_count"] * drive["count_slew_max"]
    for k in range(1, len(about_n)):
        for i in range(3):
            volt = math.sqrt(max(comb_n[k - 1, i], 0.0) / gain[i])
            change = about_n[k, i] - about_n[k - 1, i]
            lower[3 * k - 3 + i] = -gain[i] * step_v * max(2.0 * volt - step_v, step_v) - change
            upper[3 * k - 3 + i] = gain[i] * step_v * (2.0 * volt + step_v) - change
