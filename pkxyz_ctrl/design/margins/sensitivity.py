"""S of a closed loop at many frequencies at once, for studies that ask thousands of loops.

The loop is one system from a disturbance n of what is measured to y = C x, so S = I + C (z I - A)^-1 B. A is brought to
Schur form once, A = U T U^H; then each frequency is a sum over modes, or where these are too much alike a back
substitution, n^2 in place of n^3.
"""

import math
from functools import lru_cache

import numpy as np
import scipy.linalg
from numba import njit
from numpy.typing import NDArray

from pkxyz_ctrl.design.margins.modal import add_up, split
from pkxyz_ctrl.design.model.discrete_law import DiscreteLaw, LawError
from pkxyz_ctrl.design.model.loop_plant import LoopPlant

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


AGREEMENT = 1e-11
"""Of modes with substitution, by the largest that each input does."""
_ASKED_RAD = np.array([0.003, 0.1, 0.4, 1.2, 3.0])
"""Turns at which that is asked, and that of the slowest pole."""


def closed_loop(plant: LoopPlant, law: DiscreteLaw) -> Array:
    """State matrix of plant and law together. Raises ``LawError`` where their periods differ."""
    if not math.isclose(plant.period_s, law.period_s, rel_tol=1e-9):
        raise LawError(f"the law has a period of {law.period_s * 1e6:g} us and the bus {plant.period_s * 1e6:g} us")
    n = len(plant.a)
    loop = np.empty((n + law.order, n + law.order))
    loop[:n, :n], loop[:n, n:] = plant.a - plant.b @ law.d @ plant.c, -plant.b @ law.c
    loop[n:, :n], loop[n:, n:] = law.b @ plant.c, law.a
    return loop


class Transfer:
    """I + C (z I - A)^-1 B of a system: a function of frequencies (m,) in Hz, with values (m, p, q)."""

    def __init__(self, a: Array, enters: Array, leaves: Array, period_s: float) -> None:
        # balanced, as states of all sizes are turned into one another: forces, positions, velocities
        balanced, scale = _balanced(a)
        self._triangle, turn = _schur(balanced)
        self.poles: Complex = np.asarray(np.diag(self._triangle))
        """(n,) of the system"""
        self._enters = turn.conj().T @ (enters / scale[:, None])
        self._leaves = np.ascontiguousarray((leaves * scale) @ turn)
        self._period_s = period_s
        self._modes = self._split()

    @property
    def spectral_radius(self) -> float:
        """Below 1 it is stable."""
        return float(np.abs(self.poles).max())

    def __call__(self, frequency_hz: Array) -> Complex:
        z = np.exp(2j * math.pi * np.asarray(frequency_hz, dtype=np.float64) * self._period_s)
        if self._modes is None:
            return self._substituted(z)
        s = np.empty((len(z), len(self._leaves), self._enters.shape[1]), np.complex128)
        add_up(*self._modes, z, s)
        return s

    def _substituted(self, z: Complex) -> Complex:
        s = np.empty((len(z), len(self._leaves), self._enters.shape[1]), np.complex128)
        _substitute_back(self._triangle, self._enters, self._leaves, z, s)
        return s

    def _split(self) -> tuple[Complex, Array, Array] | None:
        """The system by its modes, if they give what substitution does."""
        modes = split(self._triangle, self._enters, self._leaves)
        if modes is None or not len(self.poles):
            return None
        slowest = self.poles[np.argmax(np.abs(self.poles))]
        z = np.exp(1j * np.append(_ASKED_RAD, abs(np.angle(slowest))))
        exact = self._substituted(z)
        found = np.empty_like(exact)
        add_up(*modes, z, found)
        with np.errstate(invalid="ignore"):
            agree = np.abs(found - exact).max(axis=0) <= AGREEMENT * np.abs(exact).max(axis=(0, 1))
        return modes if agree.all() else None


class Sensitivity(Transfer):
    """S(f) of a plant with a law: values (m, 3, 3), and the loop's poles. Raises ``LawError`` where their periods
    differ.
    """

    def __init__(self, plant: LoopPlant, law: DiscreteLaw) -> None:
        enters, leaves = np.vstack([-plant.b @ law.d, law.b]), np.hstack([plant.c, np.zeros((len(plant.c), law.order))])
        super().__init__(closed_loop(plant, law), enters, leaves, plant.period_s)


def _balanced(a: Array) -> tuple[Array, Array]:
    """``scipy.linalg.matrix_balance`` without permutations: the matrix, and the size of each state (n,)."""
    balanced, _, _, scale, failed = scipy.linalg.lapack.dgebal(a, scale=1, permute=0)
    if failed:
        raise LawError("the loop's states can't be brought to one size")
    return np.asarray(balanced), np.asarray(scale)


def _schur(a: Array) -> tuple[Complex, Complex]:
    """``scipy.linalg.schur`` in complex form, without what that asks and looks at each time."""
    triangle, _, _, turn, _, failed = scipy.linalg.lapack.zgees(
        _unsorted, a.astype(np.complex128), lwork=_schur_room(len(a)), overwrite_a=True
    )
    if failed:
        raise LawError("the loop's poles can't be found")
    return np.asarray(triangle), np.asarray(turn)


@lru_cache(maxsize=32)
def _schur_room(order: int) -> int:
    work = scipy.linalg.lapack.zgees(_unsorted, np.eye(order, dtype=np.complex128), lwork=-1)[-2]
    return int(work[0].real)


def _unsorted(_: complex) -> bool:
    return False


_TOGETHER = 32
"""Frequencies that are worked on at once: a vector of each state's values, all of which the cache holds."""


@njit(cache=True, error_model="numpy")
def _substitute_back(triangle: Complex, enters: Complex, leaves: Complex, z: Complex, out: Complex) -> None:
    """out (m, p, q) = I + leaves (z I - triangle)^-1 enters for each z (m,)."""
    n, inputs = enters.shape
    re, im = np.empty((n, inputs, _TOGETHER)), np.empty((n, inputs, _TOGETHER))
    over_re, over_im = np.empty(_TOGETHER), np.empty(_TOGETHER)
    total_re, total_im = np.empty(_TOGETHER), np.empty(_TOGETHER)
    for first in range(0, len(z), _TOGETHER):
        some = z[first : first + _TOGETHER]
        for k in range(n - 1, -1, -1):
            for f in range(len(some)):
                u, v = some[f].real - triangle[k, k].real, some[f].imag - triangle[k, k].imag
                size = 1.0 / (u * u + v * v)
                over_re[f], over_im[f] = u * size, -v * size
            for i in range(inputs):
                x, y = re[k, i], im[k, i]
                for f in range(len(some)):
                    x[f], y[f] = enters[k, i].real, enters[k, i].imag
                for j in range(k + 1, n):
                    a, b, u, v = triangle[k, j].real, triangle[k, j].imag, re[j, i], im[j, i]
                    for f in range(len(some)):
                        x[f] += a * u[f] - b * v[f]
                        y[f] += a * v[f] + b * u[f]
                for f in range(len(some)):
                    u, v = x[f], y[f]
                    x[f] = u * over_re[f] - v * over_im[f]
                    y[f] = u * over_im[f] + v * over_re[f]
        for o in range(len(leaves)):
            for i in range(inputs):
                total_re[:], total_im[:] = 1.0 if o == i else 0.0, 0.0
                for k in range(n):
                    a, b, x, y = leaves[o, k].real, leaves[o, k].imag, re[k, i], im[k, i]
                    for f in range(len(some)):
                        total_re[f] += a * x[f] - b * y[f]
                        total_im[f] += a * y[f] + b * x[f]
                for f in range(len(some)):
                    out[first + f, o, i] = complex(total_re[f], total_im[f])
