"""What a grid of frequencies shows of a function, refined between its points: peaks and crossings. Functions take many
frequencies (m,) at once, as that costs them little more than one.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Function = Callable[[Array], Array]

_POINTS = 9
"""Looked at between two points in a round."""
_SHARES = np.arange(_POINTS + 2) / (_POINTS + 1)


def peak(grid_hz: Array, values: Array, function: Function, *, maxima: int = 3, rounds: int = 4) -> float:
    """Largest value, the grid's largest local maxima refined between their neighbours; each round divides by 5."""
    padded = np.r_[-np.inf, values, -np.inf]
    local = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:]))
    local = local[np.argsort(values[local])[::-1][:maxima]]
    low, high = grid_hz[np.maximum(local - 1, 0)], grid_hz[np.minimum(local + 1, len(grid_hz) - 1)]
    best = float(values.max())
    for _ in range(rounds):
        found, low, high = _largest_between(low, high, function)
        best = max(best, float(found.max()))
    return best


def _largest_between(low: Array, high: Array, function: Function) -> tuple[Array, Array, Array]:
    """Largest values (k,) between ``low`` and ``high`` (k,), and the points on both sides of where they are."""
    f = low[:, None] + (high - low)[:, None] * _SHARES
    seen = function(f.ravel()).reshape(f.shape)
    rows, at = np.arange(len(f)), seen.argmax(axis=1)
    return seen[rows, at], f[rows, np.maximum(at - 1, 0)], f[rows, np.minimum(at + 1, _POINTS + 1)]


def crossings(grid_hz: Array, values: Array, function: Function) -> Array:
    """Frequencies (k,) at which a function that has ``values`` on the grid passes zero, to 10^-9 of a grid step or
    better: the stretch is narrowed, and the last one taken as straight.
    """
    at = np.flatnonzero((values[:-1] < 0) != (values[1:] < 0))
    low, high = grid_hz[at], grid_hz[at + 1]
    ends = values[at], values[at + 1]
    for _ in range(5 if len(at) else 0):
        f = np.linspace(low, high, _POINTS + 2, axis=1)
        seen = np.column_stack([ends[0], function(f[:, 1:-1].ravel()).reshape(len(f), _POINTS), ends[1]])
        rows = np.arange(len(f))
        first = np.argmax((seen[:, :-1] < 0) != (seen[:, 1:] < 0), axis=1)
        low, high = f[rows, first], f[rows, first + 1]
        ends = seen[rows, first], seen[rows, first + 1]
    return np.asarray(low - ends[0] * (high - low) / (ends[1] - ends[0]))


def first_above(grid_hz: Array, values: Array, function: Function, level: float) -> float:
    """Where the function first reaches a level, from low frequencies; 0 if it starts above, the last if never."""
    above = np.flatnonzero(values >= level)
    if len(above) == 0:
        return float(grid_hz[-1])
    i = int(above[0])
    if i == 0:
        return 0.0
    return float(crossings(grid_hz[i - 1 : i + 1], values[i - 1 : i + 1] - level, lambda f: function(f) - level)[0])
