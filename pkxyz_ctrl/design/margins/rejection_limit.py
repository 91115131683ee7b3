"""How far disturbances can be rejected at all: the largest f with |S| < -3 dB from 0 to f and |S| <= Ms beyond.

With the plant of an axis known exactly, and stable, every stable loop has S = 1 - P Q with a stable Q, and every stable
Q is a law's (Youla). Let W be -3 dB and Ms, and W_o the stable transfer of that size without zeros outside the circle::

    S = W_o F,    |F| <= 1,    F = 1 / W_o to the order d at z = infinity, and at each zero of P outside the circle

d samples lie between force and measurement. Bode's integral is the first of these conditions alone, mean ln W >= 0;
together they are a Nevanlinna-Pick problem: with A of the eigenvalues 1/z (d of them 0), (A, e) controllable and
P = A P A^T + e e^T there is such an F where |C^-1 W_o(A)^-1 C| <= 1, P = C C^T. No noise, no force, no
other plant is asked for, so no law reaches it.
"""

import math

import numpy as np
import scipy.linalg
import scipy.optimize
from numpy.typing import NDArray

from pkxyz_ctrl.design.margins.margins import HALF_POWER
from pkxyz_ctrl.design.model.loop_plant import LoopPlant

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_NONE = 1e-9
"""Of the largest sample of an impulse response: none."""


def bode_limit_hz(period_s: float, peak_s: float) -> float:
    """What Bode's integral leaves of the band: f ln sqrt 2 = (1 / 2T - f) ln Ms."""
    return 0.5 / period_s * math.log(peak_s) / math.log(peak_s / HALF_POWER)


def delay_limit_hz(axis: LoopPlant, peak_s: float) -> float:
    """The same with the plant's delay and its zeros outside the circle, for a plant of one input (``LoopPlant.axis``).
    Raises ``ValueError`` for one that is not stable.
    """
    if not np.abs(np.linalg.eigvals(axis.a)).max() < 1.0:
        raise ValueError("the limit is that of a stable plant")
    late, outside = nature_of(axis)
    a = scipy.linalg.companion(np.poly(np.concatenate([np.zeros(late), 1.0 / outside])).real)
    entered = np.eye(len(a), 1)
    root = np.linalg.cholesky(scipy.linalg.solve_discrete_lyapunov(a, entered @ entered.T))

    def beyond(edge_rad: float) -> float:
        mixed = np.linalg.solve(root, _inverse_bound(a, edge_rad, peak_s) @ root)
        return float(np.linalg.norm(mixed, 2)) - 1.0

    return float(scipy.optimize.brentq(beyond, 1e-6, math.pi)) / (2.0 * math.pi * axis.period_s)


def nature_of(axis: LoopPlant) -> tuple[int, Complex]:
    """Samples from a force to its first effect, and the zeros outside the circle."""
    n, response, power = len(axis.a), [], axis.b
    for _ in range(n):
        response.append((axis.c @ power).item())
        power = axis.a @ power
    size = np.abs(response)
    late = int(np.argmax(size > _NONE * size.max()))
    zeros = np.roots(np.convolve(np.poly(axis.a), response)[late:n])
    outside = zeros[np.abs(zeros) > 1.0]
    return late + 1, np.asarray(outside, dtype=np.complex128)


def _inverse_bound(a: Array, edge_rad: float, peak_s: float) -> Array:
    """1 / W_o at a matrix in place of 1/z: ln W_o = ln Ms - ln(Ms sqrt 2) / pi (theta + 2 sum sin(n theta) a^n / n)."""
    eye = np.eye(len(a))
    turned = -scipy.linalg.logm(eye - np.exp(1j * edge_rad) * a).imag
    lowered = math.log(peak_s / HALF_POWER) / math.pi * (edge_rad * eye + 2.0 * turned)
    return np.asarray(scipy.linalg.expm(lowered)) / peak_s
