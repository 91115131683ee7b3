"""The plant's integration method: its weights against the conditions that make its order, in exact fractions."""

from fractions import Fraction
from math import factorial

import numpy as np
from scipy.integrate import solve_ivp

from sim.motion import nystrom


def exact(values: np.ndarray) -> list[Fraction]:
    """The fractions that the floats are rounded from."""
    return [Fraction(float(v)).limit_denominator(10**10) for v in values]


def test_weights_are_those_of_the_quadratures_and_of_each_other() -> None:
    """sum b' c^k = 1 / (k + 1) to order 7, b = b' (1 - c), rows of A sum to c^2 / 2."""
    c, b, rate = exact(nystrom.C), exact(nystrom.B), exact(nystrom.B_RATE)
    for k in range(7):
        assert sum(w * x**k for w, x in zip(rate, c, strict=True)) == Fraction(1, k + 1)
    assert b == [w * (1 - x) for w, x in zip(rate, c, strict=True)]
    for row, x in zip(nystrom.A, c, strict=True):
        assert abs(row.sum() - float(x) ** 2 / 2) < 1e-14
    assert not np.triu(nystrom.A).any()


def test_an_oscillation_is_exact_up_to_terms_of_order_8() -> None:
    """x'' = -w^2 x from x = 1 and from v = 1: the step is a polynomial in h, that of cos and sin."""
    for start, lead in ((np.ones(nystrom.STAGES), 0), (nystrom.C, 1)):
        stages = start
        for n in range(1, 5):
            for weights, power in ((nystrom.B, 2 * n + lead), (nystrom.B_RATE, 2 * n - 1 + lead)):
                if power <= 8:
                    assert abs(weights @ stages * factorial(power) - 1) < 1e-11
            stages = nystrom.A @ stages


def kepler(steps: int) -> np.ndarray:
    """Position after one turn and a half of an ellipse of eccentricity 0.3, in so many steps."""
    x, v, h = np.array([0.7, 0.0]), np.array([0.0, np.sqrt(1.3 / 0.7)]), 3 * np.pi / steps
    for _ in range(steps):
        given = np.zeros((nystrom.STAGES, 2))
        for i, c in enumerate(nystrom.C):
            at = x + c * h * v + h * h * nystrom.A[i] @ given
            given[i] = -at / np.linalg.norm(at) ** 3
        x, v = x + h * v + h * h * nystrom.B @ given, v + h * nystrom.B_RATE @ given
    return x


def test_error_falls_with_the_eighth_power_of_the_step() -> None:
    """Of a planet, which is nonlinear, against scipy."""
    start = [0.7, 0.0, 0.0, np.sqrt(1.3 / 0.7)]

    def rate(_: float, y: np.ndarray) -> list[float]:
        r3 = np.hypot(y[0], y[1]) ** 3
        return [y[2], y[3], -y[0] / r3, -y[1] / r3]

    true = solve_ivp(rate, (0, 3 * np.pi), start, "DOP853", rtol=1e-13, atol=1e-14).y[:2, -1]
    coarse, fine = (np.abs(kepler(n) - true).max() for n in (60, 120))
    assert fine < 1e-8
    assert 2**7 < coarse / fine < 2**10
