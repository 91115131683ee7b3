"""Any linear feedback law as a state-space system about the reference, compiled.

    w = -(C x + D e),   x+ = A x + B e + U (1 - g) w,   e = y - y_m

e is the measured position less the model's answer to the set-points (m), w a force at the platform (N) that joins the
feed-forward and acts ``delay_periods`` later. Of it g w is asked for, g being the authority: A - U C is stable, so
nothing winds up while g is below 1, and the law takes over without a jump. What the combs then can't give is in y_m.
"""

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel

Array = NDArray[np.float64]

ORDER_MAX = 24

LINEAR_LAW = np.dtype(
    [
        ("order", "i4"),
        ("d", "f8", (3, 3)),
        ("c", "f8", (3, ORDER_MAX)),
        ("b", "f8", (ORDER_MAX, 3)),
        ("unwind", "f8", (ORDER_MAX, 3)),
        ("a", "f8", (ORDER_MAX, ORDER_MAX)),  # last: rows beyond the order are never looked at
    ],
    align=True,
)

LINEAR_STATE = np.dtype(
    [
        ("x", "f8", (ORDER_MAX,)),
        ("next", "f8", (ORDER_MAX,)),
        ("error_m", "f8", (3,)),
        ("w_n", "f8", (3,)),
    ],
    align=True,
)


@kernel
def add_feedback(linear: np.void, state: np.void, seen_m: Array, expected_m: Array, share: float, out: Array) -> None:
    """Add share times w to ``out`` (3,) for the position seen (3,) and the one expected (3,) of the same sample."""
    order, error = linear["order"], state["error_m"]
    for i in range(3):
        error[i] = seen_m[i] - expected_m[i]
    for i in range(3):
        total = 0.0
        for k in range(order):
            total += linear["c"][i, k] * state["x"][k]
        for k in range(3):
            total += linear["d"][i, k] * error[k]
        state["w_n"][i] = -total
        out[i] -= share * total


@kernel
def advance(linear: np.void, state: np.void, share: float) -> None:
    """Time update with error and force of ``add_feedback``, and the authority of this tick."""
    order, x, following, w = linear["order"], state["x"], state["next"], state["w_n"]
    for i in range(order):
        total = 0.0
        for k in range(order):
            total += linear["a"][i, k] * x[k]
        for k in range(3):
            total += linear["b"][i, k] * state["error_m"][k] + linear["unwind"][i, k] * (1.0 - share) * w[k]
        following[i] = total
    for i in range(order):
        x[i] = following[i]


@kernel
def clear(state: np.void) -> None:
    """Forget: the loop is open."""
    for i in range(ORDER_MAX):
        state["x"][i] = 0.0
