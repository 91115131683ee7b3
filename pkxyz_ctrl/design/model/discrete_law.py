"""A linear law as the tick runs it: numbers of a difference equation, whatever it was designed as.

    x+ = A x + B e,   w = -(C x + D e),   e = y - r

e (3,) is the measured position less the reference at a sample, m; w (3,) the force in N that is added to the
feed-forward. Platform axes x, y, z.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import control
import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

ORDER_MAX = 24
"""States for which the tick has room."""


class LawError(ValueError):
    """A law that can't be used; the message says why and what would help."""


@dataclass(frozen=True)
class DiscreteLaw:
    """Matrices of the law: A (n,n), B (n,3) in 1/m, C (3,n) in N, D (3,3) in N/m; n at most ``order_max``. Read-only.

    Raises ``LawError`` for other shapes, numbers that are not finite, and more states than there is room for.
    """

    period_s: float
    a: Array
    b: Array
    c: Array
    d: Array
    told_from: int | None = None
    """first of the three states that are told what force was really given, where a law has such"""
    set_point_gain: Array | None = None
    """(3,6) of position and velocity: the regulator of the model that is told so, where it is that"""
    order_max: int = ORDER_MAX
    """more where the tick does not run these matrices, but what they are equivalent to"""

    def __post_init__(self) -> None:
        order = len(np.atleast_1d(self.a))
        if order > self.order_max:
            raise LawError(f"the law has {order} states and the tick has room for {self.order_max}; reduce its order")
        if not self.period_s > 0.0:
            raise LawError(f"period_s must be positive, not {self.period_s}")
        for name, shape in (("a", (order, order)), ("b", (order, 3)), ("c", (3, order)), ("d", (3, 3))):
            matrix = np.array(getattr(self, name), dtype=np.float64)  # a copy: nobody else can write to it
            if matrix.size == 0:
                matrix = matrix.reshape(shape)
            if matrix.shape != shape:
                raise LawError(f"matrix {name} of the law has shape {matrix.shape}; it must be {shape}")
            if not np.isfinite(matrix).all():
                raise LawError(f"matrix {name} of the law has entries that are not finite")
            matrix.flags.writeable = False
            object.__setattr__(self, name, matrix)

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.a)


@dataclass(frozen=True)
class TappedLaw:
    """A law with a filter of taps over its innovations beside it, as two parts: w = -(C x + D e + sum of tap_k i(-k)),
    i = e - H x, of the innovations now and before. The law is told the force that follows from both (``told_from``).

    ``whole`` is the same as one law, whose order the taps make several times as large.
    """

    law: DiscreteLaw
    seen: Array
    """H (3,n): what a sample shows of the law's state"""
    taps: Array
    """(k,3) of each axis, in N/m, the newest first"""

    def whole(self) -> DiscreteLaw:
        """With the innovations of the last k - 1 samples as states."""
        law, order, late = self.law, self.law.order, 3 * (len(self.taps) - 1)
        innovation = np.hstack([-self.seen, np.zeros((3, late))])
        force = np.zeros((3, order + late))  # over states; what is seen now adds taps[0]
        force[:, order:] = np.hstack([np.diag(tap) for tap in self.taps[1:]])
        force += self.taps[0][:, None] * innovation
        a, b = np.zeros((order + late, order + late)), np.zeros((order + late, 3))
        a[:order, :order], b[:order] = law.a, law.b
        a[self.told] -= force
        b[self.told] -= np.diag(self.taps[0])
        if late:
            a[order : order + 3], b[order : order + 3] = innovation, np.eye(3)
            a[order + 3 :, order : order + late - 3] = np.eye(late - 3)
        c = np.hstack([law.c, np.zeros((3, late))]) + force
        return replace(law, a=a, b=b, c=c, d=law.d + np.diag(self.taps[0]), order_max=order + late)

    @property
    def told(self) -> slice:
        """The states that are told the force. Raises ``LawError`` for a law that is told none."""
        if self.law.told_from is None:
            raise LawError("a filter of taps needs a law that is told what force was given")
        return slice(self.law.told_from, self.law.told_from + 3)


def siso(system: control.lti.LTI) -> control.StateSpace:
    """A python-control system of one input and one output as state space; raises ``LawError`` for others."""
    if (system.ninputs, system.noutputs) != (1, 1):
        raise LawError(f"an axis law has one input and one output, not {system.ninputs} and {system.noutputs}")
    if isinstance(system, control.TransferFunction) and len(system.num[0][0]) > len(system.den[0][0]):
        raise LawError("the law has more zeros than poles: add poles, as no sampled law can differentiate")
    return control.ss(system)


def discretise(
    system: control.StateSpace, period_s: float, method: str = "tustin", prewarp_rad_per_s: float | None = None
) -> control.StateSpace:
    """A continuous system sampled by "tustin" or "zoh"; Tustin may be made exact at one angular frequency.

    Raises ``LawError`` for another method, prewarping of "zoh", or a frequency beyond half the sampling rate.
    """
    if method not in ("tustin", "zoh"):
        raise LawError(f"method must be 'tustin' or 'zoh', not {method!r}")
    if prewarp_rad_per_s is not None and not (method == "tustin" and 0.0 < prewarp_rad_per_s * period_s < np.pi):
        raise LawError("only 'tustin' can be made exact at a frequency, and only below half the sampling rate")
    return control.sample_system(system, period_s, method=method, prewarp_frequency=prewarp_rad_per_s)


def stack(period_s: float, axes: Sequence[control.StateSpace]) -> DiscreteLaw:
    """Three discrete axis laws (force in N that answers a deviation in m, positive against it) as one law."""
    if len(axes) != 3:
        raise LawError(f"there are three axes, not {len(axes)}")
    order = sum(axis.nstates for axis in axes)
    if order > ORDER_MAX:
        raise LawError(f"the three axis laws have {order} states and the tick has room for {ORDER_MAX}")
    a, b, c, d = (scipy.linalg.block_diag(*[getattr(axis, name) for axis in axes]) for name in "ABCD")
    return DiscreteLaw(period_s, a, b, c, d)


def response(a: Array, b: Array, c: Array, d: Array, z: ArrayLike) -> NDArray[np.complex128]:
    """C (z I - A)^-1 B + D at points z (m,) of the plane: (m, outputs, inputs)."""
    points = np.asarray(z, dtype=np.complex128)
    if len(a) == 0:
        return np.broadcast_to(d.astype(np.complex128), (len(points), *d.shape))
    resolvent = points[:, None, None] * np.eye(len(a)) - a
    state = np.linalg.solve(resolvent, np.broadcast_to(b.astype(np.complex128), (len(points), *b.shape)))
    return np.asarray(c @ state + d, dtype=np.complex128)
