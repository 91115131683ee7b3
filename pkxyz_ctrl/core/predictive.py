"""The predictive law's problem at one tick: what the stage would do by itself, what the combs and strokes still allow,
and the plan that ignores limits; compiled.

With e = [x - r, v - r'] at the start of interval k, nu = u + d (u: force beside the feed-forward, d: disturbance)::

    e+ = Phi e + Gamma nu + c,   minimise  sum e^T Q e + nu^T nu  + e_N^T P e_N

c is where the reference jumps. P solves the regulator's Riccati equation, so the plan without limits begins with the
regulator's own answer. The variables are comb forces v = B_0^-T nu (B_0: ``kinematics.pulls``) about those of the
feed-forward, so that their limits are bounds; slew limits are linear about the forces of the last plan, strokes about
the reference. Beyond the first interval the limits are predictions: what goes out is held to the exact ones by
allocation and voltage.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pkxyz_ctrl.core import feedback, kinematics
from pkxyz_ctrl.core.elasticity import energy_gradient
from pkxyz_ctrl.core.linear3 import inverse3, multiply3_transposed

Array = NDArray[np.float64]

PREDICTIVE = np.dtype(
    [
        ("position_weight", "f8"),  # of Q, (N/m)^2
        ("velocity_weight", "f8"),  # (N s/m)^2
        ("stroke_min_m", "f8"),
        ("stroke_max_m", "f8"),
        ("rho", "f8"),  # step of the solver
        ("horizon", "i4"),  # intervals
        ("iterations_max", "i4"),
    ],
    align=True,
)

FREE, LIMITED = 1, 2
"""Whether the plan without limits keeps them all, and so is the solution, or has to be solved for."""

_JUMP_M = 2e-9  # smooth references miss their own polynomial by 0.1 nm where the jerk switches


@njit(cache=True)
def feedforwards(law: np.void, rows: Array, force_n: Array, comb_n: Array) -> None:
    """Feed-forward at the platform (n,3) and at the combs (n,3) in each interval of the reference rows (n+1, 9)."""
    gains, row = law["feedback"], np.empty(9)
    pulls, inverse = np.empty((3, 3)), np.empty((3, 3))
    for k in range(len(rows) - 1):
        feedback.ahead(gains, rows[k], rows[k + 1], row)
        energy_gradient(law["geometry"], law["elasticity"], row[0:3], force_n[k])
        feedback.add_motion(gains, row, force_n[k])
        kinematics.pulls(law["geometry"], row[0:3], pulls)
        inverse3(pulls, inverse)
        multiply3_transposed(inverse, force_n[k], comb_n[k])


@njit(cache=True)
def deviation(law: np.void, memory: np.void, rows: Array, force_n: Array, error: Array) -> None:
    """e (6,) at the start of the first interval, as the state feedback sees it."""
    target, last = np.empty(9), force_n[0].copy()
    if memory["feedforward_known"] != 0:
        last[:] = memory["feedforward_n"]
    feedback.sampled_target(law["feedback"], rows[0], force_n[0], last, target)
    ahead, origin = memory["estimate"]["ahead"], law["estimator"]["operating_point_m"]
    for i in range(3):
        error[i] = origin[i] + ahead[i] - target[i]
        error[3 + i] = ahead[3 + i] - target[3 + i]


@njit(cache=True)
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


@njit(cache=True)
def comb_bounds(drive: np.void, count: Array, comb_n: Array, offset_n: Array, lower: Array, upper: Array) -> None:
    """Bounds (3n,) of v from what the voltages can be after 1, 2, ... periods of slewing from the last counts (3,);
    ``offset_n`` (3,) = B_0^-T d.
    """
    gain, scale = drive["force_gain_n_per_v2"], drive["volt_per_count"]
    for k in range(len(comb_n)):
        slew = (k + 1) * drive["count_slew_max"]
        for i in range(3):
            low, high = scale * max(0, count[i] - slew), scale * min(drive["count_max"], count[i] + slew)
            lower[3 * k + i] = gain[i] * low * low - comb_n[k, i] + offset_n[i]
            upper[3 * k + i] = gain[i] * high * high - comb_n[k, i] + offset_n[i]


@njit(cache=True)
def slew_bounds(drive: np.void, comb_n: Array, planned_n: Array, lower: Array, upper: Array) -> None:
    """Bounds (3n-3,) of v_k - v_(k-1) from the slew limit, about the comb forces (n,3) planned at the last tick."""
    gain = drive["force_gain_n_per_v2"]
    step_v = drive["volt_per_count"] * drive["count_slew_max"]
    for k in range(1, len(comb_n)):
        for i in range(3):
            volt = np.sqrt(max(planned_n[k, i], 0.0) / gain[i])  # planned for k then is k - 1 now
            change = comb_n[k, i] - comb_n[k - 1, i]
            lower[3 * k - 3 + i] = -gain[i] * step_v * max(2.0 * volt - step_v, step_v) - change
            upper[3 * k - 3 + i] = gain[i] * step_v * (2.0 * volt + step_v) - change


@njit(cache=True)
def stroke_bounds(law: np.void, rows: Array, free_m: Array, lower: Array, upper: Array) -> None:
    """Bounds (3m,) in m of the strokes that v adds, for the rows (m, 9) at the ends of as many intervals and the
    strokes (3m,) about them that come by themselves.
    """
    stroke = np.empty(3)
    low, high = law["predictive"]["stroke_min_m"], law["predictive"]["stroke_max_m"]
    for k in range(len(rows)):
        kinematics.strokes(law["geometry"], rows[k, 0:3], stroke)
        for i in range(3):
            lower[3 * k + i] = min(low - stroke[i], 0.0) - free_m[3 * k + i]  # a reference may go to a limit
            upper[3 * k + i] = max(high - stroke[i], 0.0) - free_m[3 * k + i]


@njit(cache=True)
def is_inside(lower: Array, upper: Array, slewed: Array, stroked: Array, v: Array, n: int) -> bool:
    """Whether a plan v (3n,) keeps bounds, slew and strokes; the latter's values as ``slewed`` (3n-3,) and ``stroked``
    (3m,).
    """
    inside = True
    for i in range(3 * n):
        inside = inside and lower[i] <= v[i] <= upper[i]
    for i in range(len(stroked)):
        inside = inside and lower[6 * n - 3 + i] <= stroked[i] <= upper[6 * n - 3 + i]
    for i in range(3 * n - 3):
        inside = inside and lower[3 * n + i] <= slewed[i] <= upper[3 * n + i]
    return inside
