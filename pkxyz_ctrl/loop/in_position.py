"""In position, decided on the estimate and how uncertain it is. PURE and compiled.

The filter's gain K says how much of an innovation it believes: with the innovations' variance S the variance of its
position is (1 - K) K S, per axis (Kalman: P H' = K S before the sample is seen, and (1 - K) of it after). S is what two
thirds of the innovations of late are within, squared: on the way, where a model that is not the device makes them ten
times as large, it hardly grows, and so does not outlast the way. What the model gets wrong now shows in their mean m:
of that the estimate keeps (1 - K) m, which counts as off.
"""

import math

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel

Array = NDArray[np.float64]

MEMORY_TICKS = 32
"""How slowly S follows: by 1/32 of itself a tick. So many ticks are averaged before it does."""
MEAN_TICKS = 4
"""Time constant of the mean of the innovations."""
_BEYOND = 0.3173  # share of a normal distribution that is beyond one standard deviation

IN_POSITION = np.dtype(
    [
        ("square_m2", "f8", (3,)),  # variance of the innovations
        ("mean_m", "f8", (3,)),  # of the innovations
        ("uncertainty_m", "f8", (3,)),  # standard deviation of the estimate
        ("ticks", "i4"),  # inside in a row, this one included
        ("seen", "i4"),  # innovations that were averaged
    ],
    align=True,
)


@kernel
def look(
    state: np.void, gain: Array, target_m: Array, estimate_m: Array, innovation_m: Array, window_m: float, sigmas: float
) -> int:
    """Take in a tick, and return for how many in a row each axis of the estimate has been within ``window_m`` of its
    target (3,), ``sigmas`` standard deviations of it included. ``gain`` (9, 3) is the filter's. Whoever sets ``seen``
    to 0 has it begin anew.
    """
    inside, seen = True, state["seen"]
    for i in range(3):
        square, variance = innovation_m[i] * innovation_m[i], state["square_m2"][i]
        if seen == 0:
            variance, state["mean_m"][i] = square, 0.0
        elif seen < MEMORY_TICKS:
            variance += (square - variance) / (seen + 1)
        elif square > variance:
            variance *= 1.0 + (1.0 - _BEYOND) / MEMORY_TICKS
        else:
            variance *= 1.0 - _BEYOND / MEMORY_TICKS
        state["square_m2"][i] = variance
        state["mean_m"][i] += (innovation_m[i] - state["mean_m"][i]) / MEAN_TICKS
        believed = min(max(gain[i, i], 0.0), 1.0)
        state["uncertainty_m"][i] = math.sqrt(believed * (1.0 - believed) * variance)
        off = abs(estimate_m[i] - target_m[i]) + (1.0 - believed) * abs(state["mean_m"][i])
        inside = inside and off + sigmas * state["uncertainty_m"][i] <= window_m
    state["seen"] = min(seen + 1, MEMORY_TICKS)
    state["ticks"] = state["ticks"] + 1 if inside else 0
    return int(state["ticks"])
