"""One finite-difference checker for every gradient, Jacobian and Hessian of the project.

Central differences of sixth order. Truncation costs h^6 |f^(7)| / 140, which is about 36 (h/L)^6 of the derivative when
the nearest singularity lies at a distance L, and rounding eps |f| / (h |f'|). The links' reach is some 250 um above
rest, so a step of 2 um is good for 1e-11.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_OFFSETS = np.array([-3, -2, -1, 1, 2, 3])
_WEIGHTS = np.array([-1, 9, -45, 45, -9, 1]) / 60  # sixth-order first derivative, Fornberg 1988


def central_differences(function: Callable[[Array], ArrayLike], at: ArrayLike, step: float) -> Array:
    """Derivative of ``function`` at a point (n,): shape of its value with a last axis (n,) added."""
    point = np.asarray(at, dtype=float)
    columns = []
    for axis in range(len(point)):
        total: Array | float = 0.0
        for offset, weight in zip(_OFFSETS, _WEIGHTS, strict=True):
            moved = point.copy()
            moved[axis] += offset * step
            total = total + weight * np.asarray(function(moved), dtype=float)
        columns.append(np.asarray(total) / step)
    return np.stack(columns, axis=-1)


def assert_derivative(
    function: Callable[[Array], ArrayLike],
    derivative: Callable[[Array], ArrayLike],
    points: ArrayLike,
    *,
    step: float,
    rtol: float,
    floor: float = 0.0,
) -> None:
    """``derivative`` is the derivative of ``function`` at every point (N, n).

    To ``rtol`` of its largest entry there, or of ``floor``, which is for derivatives that vanish somewhere: the size
    below which an entry is small on the scale of the problem.
    """
    for point in np.atleast_2d(np.asarray(points, dtype=float)):
        numeric = central_differences(function, point, step)
        analytic = np.asarray(derivative(point))
        assert analytic.shape == numeric.shape, (
            f"derivative has shape {analytic.shape}, the function calls for {numeric.shape}"
        )
        scale = max(np.abs(numeric).max(), floor)
        error = np.abs(analytic - numeric).max()
        assert error <= rtol * scale, (
            f"at {point}: analytic\n{analytic}\nnumeric\n{numeric}\ndiffer by {error / scale:.2e} > {rtol:g}"
        )


def seeded_points(count: int, low: ArrayLike, high: ArrayLike, seed: int = 1) -> Array:
    """``count`` points (count, n), uniform between the corners ``low`` and ``high`` (n,), the same on every run."""
    generator = np.random.default_rng(seed)
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    points: Array = low + (high - low) * generator.random((count, len(low)))
    return points
