"""S of a closed loop at many frequencies at once, for studies that ask thousands of loops.

The loop is one system from a disturbance n of what is measured to y = C x, so S = I + C (z I - A)^-1 B. A is brought to
Schur form once, A = U T U^H; then each frequency is a back substitution, n^2 in place of n^3, done for all of them
together.
"""

import math

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from pkxyz_ctrl.design.discrete_law import DiscreteLaw, LawError
from pkxyz_ctrl.design.loop_plant import LoopPlant

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


def closed_loop(plant: LoopPlant, law: DiscreteLaw) -> Array:
    """State matrix of plant and law together. Raises ``LawError`` where their periods differ."""
    if not math.isclose(plant.period_s, law.period_s, rel_tol=1e-9):
        raise LawError(f"the law has a period of {law.period_s * 1e6:g} us and the bus {plant.period_s * 1e6:g} us")
    return np.block([[plant.a - plant.b @ law.d @ plant.c, -plant.b @ law.c], [law.b @ plant.c, law.a]])


class Sensitivity:
    """S(f) of a plant with a law: a function of frequencies (m,) in Hz, with values (m, 3, 3).

    Raises ``LawError`` where their periods differ.
    """

    def __init__(self, plant: LoopPlant, law: DiscreteLaw) -> None:
        a = closed_loop(plant, law)
        # balanced, as states of all sizes are turned into one another: forces, positions, velocities
        balanced, (scale, _) = scipy.linalg.matrix_balance(a, permute=False, separate=True)
        self._triangle, turn = scipy.linalg.schur(balanced, output="complex")
        self.poles: Complex = np.asarray(np.diag(self._triangle))
        """(n,) of the loop"""
        enters = np.vstack([-plant.b @ law.d, law.b]) / scale[:, None]
        leaves = np.hstack([plant.c, np.zeros((len(plant.c), law.order))]) * scale
        self._enters, self._leaves = turn.conj().T @ enters, leaves @ turn
        self._period_s = plant.period_s

    @property
    def spectral_radius(self) -> float:
        """Below 1 the loop is stable."""
        return float(np.abs(self.poles).max())

    def __call__(self, frequency_hz: Array) -> Complex:
        z = np.exp(2j * math.pi * np.asarray(frequency_hz, dtype=np.float64) * self._period_s)
        n, inputs = self._enters.shape
        state = np.empty((n, inputs * len(z)), np.complex128)
        reach = 1.0 / (z - self.poles[:, None])
        for k in range(n - 1, -1, -1):
            driven = (self._triangle[k, k + 1 :] @ state[k + 1 :]).reshape(inputs, len(z))
            state[k] = ((driven + self._enters[k][:, None]) * reach[k]).ravel()
        seen = (self._leaves @ state).reshape(len(self._leaves), inputs, len(z))
        return np.asarray(np.moveaxis(seen, 2, 0) + np.eye(inputs), dtype=np.complex128, order="C")
