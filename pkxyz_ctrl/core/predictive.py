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
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.core import feedback, kinematics
from pkxyz_ctrl.core.elasticity import BENT, gradient_and_pulls
from pkxyz_ctrl.core.linear3 import inverse3, multiply3_transposed

Array = NDArray[np.float64]

HORIZON_MOST = 20

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

SCRATCH = np.dtype(
    [
        ("end", "f8", (6,)),
        ("off", "f8", (3,)),
        ("middle", "f8", (3,)),
        ("force", "f8", (3,)),
        ("pulls", "f8", (3, 3)),
        ("bent", BENT),
        ("inverse", "f8", (3, 3)),
        ("seen", "f8", (6,)),
        ("later", "f8", (6,)),
    ],
    align=True,
)

PLAN = np.dtype(
    [
        ("planned_n", "f8", (HORIZON_MOST, 3)),  # nu of the last plan: all that is kept from tick to tick
        ("rows", "f8", (HORIZON_MOST + 2, 9)),  # of the reference, from the start of the first interval on
        ("middle", "f8", (HORIZON_MOST, 9)),  # ... and in mid-interval
        ("moving_n", "f8", (HORIZON_MOST, 3)),  # C r' + m r'' - d there
        ("stroke_min_m", "f8", (HORIZON_MOST, 3)),  # limits at the ends of the intervals
        ("stroke_max_m", "f8", (HORIZON_MOST, 3)),
        ("error", "f8", (6,)),  # e at the start of the first interval
        ("jump_m", "f8", (HORIZON_MOST, 3)),  # c
        ("free_n", "f8", (HORIZON_MOST, 3)),  # nu of the plan without limits, and ...
        ("free", "f8", (HORIZON_MOST + 1, 6)),  # ... the e to which it leads
        ("along", "f8", (HORIZON_MOST + 1, 6)),  # e to which the last plan leads
        ("comb_n", "f8", (HORIZON_MOST, 3)),  # comb forces F that a plan takes, and ...
        ("stroke_m", "f8", (HORIZON_MOST, 3)),  # ... strokes at the ends of its intervals
        ("about_n", "f8", (HORIZON_MOST, 3)),  # comb forces less v
        ("first_n", "f8", (3,)),  # feed-forward at the platform in the first interval
        ("first_pulls", "f8", (3, 3)),
        ("scratch", SCRATCH),
    ],
    align=True,
)
"""What a plan is made of in a tick; of what is by intervals the first of the horizon."""

NO_PLAN, FREE, LIMITED = 0, 1, 2
"""What there is: nothing; the plan without limits, which keeps them all and so is the solution; a problem to solve."""

FORCE_UNIT_N = 1e-4
"""Unit of the problem's variables, and of strokes in it: numbers that a solver likes."""
STROKE_UNIT_M = 1e-6
_JUMP_M = 2e-9  # smooth references miss their own polynomial by 0.1 nm where the jerk switches


@kernel
def look_ahead(law: np.void, memory: np.void, plan: np.void) -> None:
    """From the reference's rows, what its motion takes in mid-interval, and limits of strokes, those of the reference
    where it is beyond them. ``law``, ``memory``: the tick's, here and below.
    """
    rows, middle, moving, end = plan["rows"], plan["middle"], plan["moving_n"], plan["scratch"]["force"]
    gains, disturbance, least, most = (
        law["feedback"],
        memory["estimate"]["ahead"],
        plan["stroke_min_m"],
        plan["stroke_max_m"],
    )
    low, high = law["predictive"]["stroke_min_m"], law["predictive"]["stroke_max_m"]
    for k in range(law["predictive"]["horizon"]):
        feedback.ahead(gains, rows[k], rows[k + 1], middle[k])
        for i in range(3):
            moving[k, i] = -disturbance[6 + i]
        feedback.add_motion(gains, middle[k], moving[k])
        kinematics.strokes(law["geometry"], rows[k + 1, 0:3], end)
        for i in range(3):
            least[k, i], most[k, i] = min(low, end[i]), max(high, end[i])


@kernel
def deviation(law: np.void, memory: np.void, plan: np.void) -> None:
    """e at the start of the first interval, as the state feedback sees it; and the feed-forward in that interval."""
    scratch, rows, force, error = memory["scratch"], plan["rows"], plan["first_n"], plan["error"]
    target, last = scratch["row"], scratch["w_n"]
    middle, pulls, bent = plan["middle"][0, 0:3], plan["first_pulls"], plan["scratch"]["bent"]
    gradient_and_pulls(law["geometry"], law["elasticity"], middle, force, pulls, bent)
    feedback.add_motion(law["feedback"], plan["middle"][0], force)
    for i in range(3):
        last[i] = memory["feedforward_n"][i] if memory["feedforward_known"] != 0 else force[i]
    feedback.sampled_target(law["feedback"], rows[0], force, last, target)
    ahead, origin = memory["estimate"]["ahead"], law["estimator"]["operating_point_m"]
    for i in range(3):
        error[i] = origin[i] + ahead[i] - target[i]
        error[3 + i] = ahead[3 + i] - target[3 + i]


@kernel
def jumps(period_s: float, rows: Array, horizon: int, jump_m: Array) -> bool:
    """c (n,3): where a row (n+1, 9) of the reference is not what the row before leads to; returns if anywhere."""
    found = False
    for k in range(horizon):
        for i in range(3):
            v, a = rows[k, 3 + i], (2.0 * rows[k, 6 + i] + rows[k + 1, 6 + i]) / 3.0
            miss = rows[k, i] + period_s * (v + 0.5 * period_s * a) - rows[k + 1, i]
            jump_m[k, i] = miss if abs(miss) > _JUMP_M else 0.0
            found = found or abs(miss) > _JUMP_M
    return found


@kernel
def free_plan(law: np.void, error: Array, jump_m: Array, jumps: bool, e: Array, nu_n: Array, scratch: np.void) -> None:
    """The plan nu (n,3) that knows no limits, and where it leads from the deviation ``error`` (6,): e (n+1, 6).

    nu_k = -K e_k - B (P c_k + h_k+1), where h carries later jumps back: h_k = (Phi - Gamma K)^T (P c_k + h_k+1).
    """
    numbers, gains, after, seen = law["predictive"], law["feedback"], scratch["later"], scratch["seen"]
    position_gain, velocity_gain = gains["position_gain_n_per_m"], gains["velocity_gain_n_s_per_m"]
    for i in range(6):
        e[0, i], after[i] = error[i], 0.0
    for k in range(numbers["horizon"]):
        for i in range(3):
            nu_n[k, i] = 0.0
    for k in range(numbers["horizon"] - 1 if jumps else -1, -1, -1):
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
    for k in range(numbers["horizon"]):
        for i in range(3):
            total = nu_n[k, i]
            for j in range(3):
                total -= position_gain[i, j] * e[k, j] + velocity_gain[i, j] * e[k, 3 + j]
            nu_n[k, i] = total
        step(law["estimator"], e[k], nu_n[k], jump_m[k], e[k + 1])


@kernel
def predict(law: np.void, error: Array, jump_m: Array, nu_n: Array, e: Array) -> None:
    """Where a plan nu (n,3) leads from the deviation ``error`` (6,): e (n+1, 6)."""
    for i in range(6):
        e[0, i] = error[i]
    for k in range(law["predictive"]["horizon"]):
        step(law["estimator"], e[k], nu_n[k], jump_m[k], e[k + 1])


@kernel
def step(estimator: np.void, e: Array, nu_n: Array, jump_m: Array, out: Array) -> None:
    """e (6,) at the end of an interval, with the jump (3,) there."""
    phi, gamma = estimator["transition"], estimator["input"]
    for i in range(6):
        total = jump_m[i] if i < 3 else 0.0
        for j in range(6):
            total += phi[i, j] * e[j]
        for j in range(3):
            total += gamma[i, j] * nu_n[j]
        out[i] = total


@kernel
def comb_forces(law: np.void, plan: np.void, k: int, begin: Array, end: Array, nu_n: Array) -> bool:
    """F that gives nu (3,) in interval ``k``, from deviation ``begin`` (6,) at its start to ``end`` (6,), which has the
    jump behind it. False where the links do not reach.
    """
    filter_, scratch, row, jump, moving = (
        law["estimator"],
        plan["scratch"],
        plan["middle"],
        plan["jump_m"],
        plan["moving_n"],
    )
    off, middle, force, stiffness = scratch["off"], scratch["middle"], scratch["force"], filter_["stiffness_n_per_m"]
    quarter_s = 0.25 * filter_["half_period_s"]
    for i in range(3):
        off[i] = 0.5 * (begin[i] + end[i] - jump[k, i]) + quarter_s * (begin[3 + i] - end[3 + i])
        middle[i] = row[k, i] + off[i]
    if kinematics.in_domain(law["geometry"], middle) != 0:
        return False
    gradient_and_pulls(law["geometry"], law["elasticity"], middle, force, scratch["pulls"], scratch["bent"])
    for i in range(3):
        held = stiffness[i, 0] * off[0] + stiffness[i, 1] * off[1] + stiffness[i, 2] * off[2]
        force[i] += moving[k, i] + nu_n[i] - held
    inverse3(scratch["pulls"], scratch["inverse"])
    multiply3_transposed(scratch["inverse"], force, plan["comb_n"][k])
    return True


@kernel
def _interval(law: np.void, plan: np.void, k: int, e: Array, nu_n: Array) -> bool:
    """Comb forces in interval ``k`` of a plan nu (n,3) that leads to e (n+1, 6), and strokes at its end. False where
    the links do not reach.
    """
    if not comb_forces(law, plan, k, e[k], e[k + 1], nu_n[k]):
        return False
    end, rows = plan["scratch"]["middle"], plan["rows"]
    for i in range(3):
        end[i] = rows[k + 1, i] + e[k + 1, i]
    if kinematics.in_domain(law["geometry"], end) != 0:
        return False
    kinematics.strokes(law["geometry"], end, plan["stroke_m"][k])
    return True


@kernel
def forces_and_strokes(law: np.void, plan: np.void, e: Array, nu_n: Array) -> bool:
    """Comb forces that a plan nu (n,3) takes, with its e (n+1, 6), and strokes. False where the links do not reach."""
    reached, k = True, 0
    while reached and k < law["predictive"]["horizon"]:
        reached, k = _interval(law, plan, k, e, nu_n), k + 1
    return reached


@kernel
def keeps_limits(law: np.void, plan: np.void, e: Array, nu_n: Array, count: Array) -> bool:
    """Whether forces and strokes of a plan, as above, keep voltage and slew after the last counts (3,) and limits of
    strokes. It ends at the first interval that does not.
    """
    drive, volt, comb, stroke = law["drive"], plan["scratch"]["off"], plan["comb_n"], plan["stroke_m"]
    gain, most = drive["force_gain_n_per_v2"], drive["volt_per_count"] * drive["count_max"]
    slew, last = drive["volt_per_count"] * drive["count_slew_max"], plan["scratch"]["seen"]
    for i in range(3):
        last[i] = drive["volt_per_count"] * count[i]
    for k in range(law["predictive"]["horizon"]):
        if not _interval(law, plan, k, e, nu_n):
            return False
        for i in range(3):
            if not 0.0 <= comb[k, i] <= gain[i] * most * most:
                return False
            volt[i] = math.sqrt(comb[k, i] / gain[i])
            if abs(volt[i] - last[i]) > slew:
                return False
            last[i] = volt[i]
            if not plan["stroke_min_m"][k, i] <= stroke[k, i] <= plan["stroke_max_m"][k, i]:
                return False
    return True


@kernel
def comb_bounds(drive: np.void, horizon: int, count: Array, about_n: Array, lower: Array, upper: Array) -> None:
    """Bounds (3n,) of v, in its unit, from what the voltages can be after 1, 2, ... periods of slewing from the last
    counts (3,); ``about_n`` (n,3): comb forces less v, as a plan has them.
    """
    gain, scale = drive["force_gain_n_per_v2"], drive["volt_per_count"]
    for k in range(horizon):
        slew = (k + 1) * drive["count_slew_max"]
        for i in range(3):
            low, high = scale * max(0, count[i] - slew), scale * min(drive["count_max"], count[i] + slew)
            lower[3 * k + i] = (gain[i] * low * low - about_n[k, i]) / FORCE_UNIT_N
            upper[3 * k + i] = (gain[i] * high * high - about_n[k, i]) / FORCE_UNIT_N


@kernel
def slew_bounds(drive: np.void, horizon: int, about_n: Array, comb_n: Array, lower: Array, upper: Array) -> None:
    """Bounds of v_k - v_(k-1), in the same unit, behind those, from the slew limit about comb forces (n,3) that were
    planned.
    """
    gain, first = drive["force_gain_n_per_v2"], 3 * horizon
    step_v = drive["volt_per_count"] * drive["count_slew_max"]
    for k in range(1, horizon):
        for i in range(3):
            volt = math.sqrt(max(comb_n[k - 1, i], 0.0) / gain[i])
            change, at = about_n[k, i] - about_n[k - 1, i], first + 3 * k - 3 + i
            lower[at] = (-gain[i] * step_v * max(2.0 * volt - step_v, step_v) - change) / FORCE_UNIT_N
            upper[at] = (gain[i] * step_v * (2.0 * volt + step_v) - change) / FORCE_UNIT_N
