"""The plant's integration method against the program it was published with."""

import numpy as np
from scipy.integrate import DOP853

from sim import dop853


def test_the_coefficients_are_those_of_dop853() -> None:
    assert np.array_equal(dop853.A, DOP853.A[: dop853.STAGES, : dop853.STAGES])
    assert np.array_equal(dop853.B, DOP853.B)
    assert np.array_equal(dop853.C, DOP853.C[: dop853.STAGES])


def test_the_coefficients_fulfil_the_simplest_order_conditions() -> None:
    """Sum of b is 1, rows of A sum to c, and sums of b c^k are 1 / (k + 1) up to order 8."""
    assert np.allclose(dop853.A.sum(axis=1), dop853.C, rtol=0, atol=1e-13)
    for k in range(8):
        assert abs(dop853.B @ dop853.C**k - 1 / (k + 1)) < 1e-14
