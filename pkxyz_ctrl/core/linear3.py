"""Three by three linear algebra without allocation, by the adjugate."""

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel

Array = NDArray[np.float64]


@kernel
def inverse3(matrix: Array, out: Array) -> float:
    """Write the inverse of a (3,3) matrix to ``out`` and return its determinant; ``out`` is undefined if that is 0."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 0], matrix[1, 1], matrix[1, 2]
    g, h, i = matrix[2, 0], matrix[2, 1], matrix[2, 2]
    ca, cb, cc = e * i - f * h, f * g - d * i, d * h - e * g
    determinant = a * ca + b * cb + c * cc
    if determinant == 0.0:
        return determinant
    s = 1.0 / determinant
    out[0, 0], out[0, 1], out[0, 2] = ca * s, (c * h - b * i) * s, (b * f - c * e) * s
    out[1, 0], out[1, 1], out[1, 2] = cb * s, (a * i - c * g) * s, (c * d - a * f) * s
    out[2, 0], out[2, 1], out[2, 2] = cc * s, (b * g - a * h) * s, (a * e - b * d) * s
    return determinant


@kernel
def multiply3(matrix: Array, vector: Array, out: Array) -> None:
    """out = M v for (3,3) and (3,); ``out`` must not be ``vector``."""
    for i in range(3):
        out[i] = matrix[i, 0] * vector[0] + matrix[i, 1] * vector[1] + matrix[i, 2] * vector[2]


@kernel
def multiply3_transposed(matrix: Array, vector: Array, out: Array) -> None:
    """out = M^T v for (3,3) and (3,); ``out`` must not be ``vector``."""
    for i in range(3):
        out[i] = matrix[0, i] * vector[0] + matrix[1, i] * vector[1] + matrix[2, i] * vector[2]
