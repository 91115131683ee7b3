"""The Youla filter: a finite impulse response of the Kalman filter's innovations, per axis, compiled.

    w = - sum_j q_j nu(k - j)

nu (m) is what a sample shows beyond what the model predicted for the forces that were really given. Set-points, jumps
and limits are in that prediction, so none of them reaches w, and no choice of taps can make the nominal loop unstable:
sensitivity is affine in them (Youla, Bongiorno, Lu 1976), which is what their design rests on. For the same reason a
quiet hold may have taps of its own: what lies between both sets of them is as stable.
"""

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.core.feedback import stands_still

Array = NDArray[np.float64]

TAPS_MAX = 40  # even

YOULA = np.dtype(
    [
        ("tap_n_per_m", "f8", (TAPS_MAX, 3)),  # q_j of axes x, y, z
        ("quiet_tap_n_per_m", "f8", (TAPS_MAX, 3)),  # ... and of a quiet hold
        ("taps", "i4"),  # how many of them are in use; 0: there is no such filter
        ("fade_ticks", "i4"),  # from one set of taps to the other
    ],
    align=True,
)

YOULA_STATE = np.dtype(
    [
        ("newest", "i4"),
        ("quiet", "i4"),  # 1: a quiet hold is asked for
        ("faded", "i4"),  # ticks of ``fade_ticks`` on the way to the quiet taps
        ("innovation_m", "f8", (2 * TAPS_MAX, 3)),  # twice the same ring: from ``newest`` on, newest first
    ],
    align=True,
)


@kernel
def ask(state: np.void, wanted: bool, here: Array, later: Array) -> None:
    """Ask for a quiet hold, or no longer: only while the set-point stands still, by its rows (9,) here and later."""
    state["quiet"] = 1 if wanted and stands_still(here, later) else 0


@kernel
def note(youla: np.void, state: np.void, innovation_m: Array) -> None:
    """Take in the innovation (3,) of this sample, and fade a tick further towards what is asked."""
    if youla["taps"] == 0:
        return
    at = state["newest"] - 1 if state["newest"] > 0 else TAPS_MAX - 1
    state["newest"] = at
    for i in range(3):
        state["innovation_m"][at, i] = innovation_m[i]
        state["innovation_m"][at + TAPS_MAX, i] = innovation_m[i]
    if state["quiet"] != 0:
        state["faded"] = min(state["faded"] + 1, youla["fade_ticks"])
    else:
        state["faded"] = max(state["faded"] - 1, 0)


@kernel
def add_feedback(youla: np.void, state: np.void, share: float, out: Array) -> None:
    """Add share times w to ``out`` (3,)."""
    faded, ticks = state["faded"], youla["fade_ticks"]
    if faded < ticks:
        _add_filtered(youla["tap_n_per_m"], youla["taps"], state, share * ((ticks - faded) / ticks), out)
    if faded > 0:
        _add_filtered(youla["quiet_tap_n_per_m"], youla["taps"], state, share * (faded / ticks), out)


@kernel
def _add_filtered(tap: Array, taps: int, state: np.void, share: float, out: Array) -> None:
    """In two sums an axis, of even and of odd ages, which need not wait for one another. Taps not in use are 0."""
    innovation, at = state["innovation_m"], state["newest"]
    x, y, z, odd_x, odd_y, odd_z = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(0, taps, 2):
        n = np.uint32(at + j)  # never below 0, which a signed one would be asked for
        x += tap[j, 0] * innovation[n, 0]
        y += tap[j, 1] * innovation[n, 1]
        z += tap[j, 2] * innovation[n, 2]
        odd_x += tap[j + 1, 0] * innovation[n + 1, 0]
        odd_y += tap[j + 1, 1] * innovation[n + 1, 1]
        odd_z += tap[j + 1, 2] * innovation[n + 1, 2]
    out[0] -= share * (x + odd_x)
    out[1] -= share * (y + odd_y)
    out[2] -= share * (z + odd_z)


@kernel
def clear(state: np.void) -> None:
    """Forget: the loop is open."""
    for j in range(2 * TAPS_MAX):
        for i in range(3):
            state["innovation_m"][j, i] = 0.0
