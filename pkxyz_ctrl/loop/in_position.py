"""In position, decided on the estimate and how uncertain it is. PURE and compiled.

The filter's gain K says how much of an innovation it believes: with the innovations' variance S the variance of its
position is (1 - K) K S, per axis (Kalman: P H' = K S before the sample is seen, and (1 - K) of it after). S is what the
innovations of the last ticks show, so a filter that is surprised, by a model that is not the device, says so.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

MEMORY_TICKS = 32
"""Time constant of the mean of the innovations' squares."""

IN_POSITION = np.dtype(
    [
        ("square_m2", "f8", (3,)),  # mean square of the innovations
        ("uncertainty_m", "f8", (3,)),  # standard deviation of the estimate
        ("ticks", "i8"),  # inside in a row, this one included
    ],
    align=True,
)


@njit(cache=True, error_model="numpy")
def look(
    state: np.void, gain: Array, target_m: Array, estimate_m: Array, innovation_m: Array, window_m: float, sigmas: float
) -> int:
    """Take in a tick, and return for how many in a row each axis of the estimate has been within ``window_m`` of its
    target (3,), ``sigmas`` standard deviations of it included. ``gain`` (9, 3) is the filter's.
    """
    inside = True
    for i in range(3):
        square = innovation_m[i] * innovation_m[i]
        state["square_m2"][i] += (square - state["square_m2"][i]) / MEMORY_TICKS
        believed = min(max(gain[i, i], 0.0), 1.0)
        state["uncertainty_m"][i] = math.sqrt(believed * (1.0 - believed) * state["square_m2"][i])
        off = abs(estimate_m[i] - target_m[i]) + sigmas * state["uncertainty_m"][i]
        inside = inside and off <= window_m
    state["ticks"] = state["ticks"] + 1 if inside else 0
    return int(state["ticks"])
