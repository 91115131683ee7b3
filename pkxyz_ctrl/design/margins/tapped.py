"""S of a loop whose law has a filter of taps beside it, without the taps' states: their delays are powers of z.

With i = m - H x the innovation and v = Q(z) i what the taps add, and G the loop without taps from (n, v) to (y, i)::

    S = I + G_yn + G_yv M^-1 Q (I + G_in),   M = I - Q G_iv

Q has no pole but at 0, so M's determinant turns about 0 as often as the loop with taps has more unstable poles than the
one without (the argument principle).
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pkxyz_ctrl.design.margins.sensitivity import Transfer, closed_loop
from pkxyz_ctrl.design.model.discrete_law import TappedLaw
from pkxyz_ctrl.design.model.loop_plant import LoopPlant

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

POINTS_A_TURN = 4
"""Of the oldest tap's phase, that M is looked at at least."""
STEP_MOST = 0.7
"""Of M between two points, by its smallest singular value: along a straight line between them it is never singular,
and its determinant turns by less than 3 asin(0.7), which is below pi."""
HALVINGS = 40
NEAR_CIRCLE = 1e-9


class TappedSensitivity:
    """S(f) of a plant with a law and its taps: a function of frequencies (m,) in Hz, with values (m, 3, 3).

    Raises ``LawError`` where their periods differ.
    """

    def __init__(self, plant: LoopPlant, law: TappedLaw) -> None:
        base, self._law, self._plant = law.law, law, plant
        states = len(plant.a)
        enters, leaves = np.zeros((states + base.order, 6)), np.zeros((6, states + base.order))
        enters[:states, :3], enters[states:, :3] = -plant.b @ base.d, base.b
        enters[:states, 3:], enters[states:][law.told, 3:] = -plant.b, -np.eye(3)
        leaves[:3, :states] = leaves[3:, :states] = plant.c
        leaves[3:, states:] = -law.seen
        self._base = Transfer(closed_loop(plant, base), enters, leaves, plant.period_s)
        self._period_s, self._taps = plant.period_s, np.ascontiguousarray(law.taps)

    @property
    def base_poles(self) -> Complex:
        """(n,) of the loop without taps."""
        return self._base.poles

    def __call__(self, frequency_hz: Array) -> Complex:
        return self._closed(frequency_hz)[0]

    def resolved(self, grid_hz: Array) -> tuple[bool, Array, Complex]:
        """Whether the loop is stable, frequencies (m,) from 0 to half the sampling rate, and S (m,3,3) there: those of
        a grid that resolves the loop without taps, and more where taps and loop together are close to instability.
        """
        even = np.linspace(0.0, 0.5 / self._period_s, POINTS_A_TURN * len(self._taps) // 2 + 1)
        f = np.unique(np.concatenate([grid_hz, even]))
        s, m = self._closed(f)
        far = _far_apart(m)
        for _ in range(HALVINGS):
            if not len(far):
                break
            new = 0.5 * (f[far] + f[far + 1])
            more_s, more_m = self._closed(new)
            f, s, m = (np.insert(old, far + 1, add, axis=0) for old, add in ((f, new), (s, more_s), (m, more_m)))
            far = _far_apart(m)
        stable = self._is_stable(m) if not len(far) else self._is_stable_by_poles()
        return stable, f, s

    def _is_stable(self, m: Complex) -> bool:
        size = np.abs(self._base.poles)
        if np.abs(size - 1.0).min() < NEAR_CIRCLE:
            return self._is_stable_by_poles()
        determinant = np.empty(len(m), np.complex128)
        _determinants(m, determinant)
        turns = float(np.angle(determinant[1:] / determinant[:-1]).sum()) / math.pi  # of the upper half circle
        return int(np.count_nonzero(size > 1.0)) == round(turns)

    def _is_stable_by_poles(self) -> bool:
        return bool(np.abs(np.linalg.eigvals(closed_loop(self._plant, self._law.whole()))).max() < 1.0)

    def _closed(self, frequency_hz: Array) -> tuple[Complex, Complex]:
        """S and M (m,3,3)."""
        wide = self._base(frequency_hz)
        z = np.exp(2j * math.pi * np.asarray(frequency_hz, dtype=np.float64) * self._period_s)
        s, m = np.empty((len(z), 3, 3), np.complex128), np.empty((len(z), 3, 3), np.complex128)
        _close(wide, z, self._taps, s, m)
        return s, m


@njit(cache=True, error_model="numpy")
def _close(wide: Complex, z: Complex, taps: Array, s: Complex, m: Complex) -> None:
    """``s`` and ``m`` (k,3,3) from I + G (k,6,6) at points z (k,)."""
    right, inverse = np.empty((3, 3), np.complex128), np.empty((3, 3), np.complex128)
    q = np.empty(3, np.complex128)
    for n in range(len(z)):
        g, out = wide[n], m[n]
        _responses(taps, 1.0 / z[n], q)
        for i in range(3):
            for j in range(3):
                unit = 1.0 if i == j else 0.0
                right[i, j] = q[i] * (unit + g[3 + i, j])
                out[i, j] = unit - q[i] * (g[3 + i, 3 + j] - unit)
        for i in range(3):
            a, b = (i + 1) % 3, (i + 2) % 3
            for j in range(3):
                c, d = (j + 1) % 3, (j + 2) % 3
                inverse[j, i] = out[a, c] * out[b, d] - out[a, d] * out[b, c]
        scale = 1.0 / (out[0, 0] * inverse[0, 0] + out[0, 1] * inverse[1, 0] + out[0, 2] * inverse[2, 0])
        for i in range(3):
            for j in range(3):
                s[n, i, j] = g[i, j]
        for k in range(3):
            for j in range(3):
                x = scale * (inverse[k, 0] * right[0, j] + inverse[k, 1] * right[1, j] + inverse[k, 2] * right[2, j])
                for i in range(3):
                    s[n, i, j] += g[i, 3 + k] * x


@njit(cache=True, error_model="numpy")
def _responses(taps: Array, back: complex, out: Complex) -> None:
    """Q (3,) of taps (k,3) by 1 / z: even and odd ones of all axes side by side, as each waits for the one before."""
    square, x, y, z = back * back, 0j, 0j, 0j
    odd_x, odd_y, odd_z = 0j, 0j, 0j
    for k in range(len(taps) - 1 - (len(taps) - 1) % 2, -1, -2):
        x, y, z = x * square + taps[k, 0], y * square + taps[k, 1], z * square + taps[k, 2]
        if k + 1 < len(taps):
            odd_x = odd_x * square + taps[k + 1, 0]
            odd_y = odd_y * square + taps[k + 1, 1]
            odd_z = odd_z * square + taps[k + 1, 2]
    out[0], out[1], out[2] = x + back * odd_x, y + back * odd_y, z + back * odd_z


@njit(cache=True, error_model="numpy")
def _determinants(m: Complex, out: Complex) -> None:
    for n in range(len(m)):
        a = m[n]
        out[n] = (
            a[0, 0] * (a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1])
            - a[0, 1] * (a[1, 0] * a[2, 2] - a[1, 2] * a[2, 0])
            + a[0, 2] * (a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0])
        )


def _far_apart(m: Complex) -> NDArray[np.int64]:
    """Which neighbours (of m - 1 pairs) are too far from each other for a turn to be told."""
    determinant, far = np.empty(len(m), np.complex128), np.empty(len(m) - 1, np.bool_)
    _determinants(m, determinant)
    _tell_far(m, determinant, far)
    return np.flatnonzero(far)


@njit(cache=True, error_model="numpy")
def _tell_far(m: Complex, determinant: Complex, far: NDArray[np.bool_]) -> None:
    before = 0.0
    for n in range(len(m)):
        square, step = 0.0, 0.0
        for i in range(3):
            for j in range(3):
                square += m[n, i, j].real ** 2 + m[n, i, j].imag ** 2
                if n:
                    move = m[n, i, j] - m[n - 1, i, j]
                    step += move.real**2 + move.imag**2
        least = 2.0 * abs(determinant[n]) / square  # the smallest singular value is not below this
        if n:
            far[n - 1] = not math.sqrt(step) <= STEP_MOST * min(least, before)
        before = least
