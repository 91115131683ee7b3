"""The gain that leaves an axis a stated gain margin, solved on the sampled, delayed plant."""

import math

import control
import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from pkxyz_ctrl.design.model.discrete_law import LawError
from pkxyz_ctrl.design.model.loop_plant import LoopPlant

Array = NDArray[np.float64]


def gain_for_margin(axis: LoopPlant, law: control.StateSpace, margin: float) -> float:
    """k > 0 such that the loop of ``axis`` (one input) with k times ``law`` is stable up to k times ``margin`` (a
    factor), and at no larger gain.

    The law's own size does not matter. Raises ``LawError`` if the loop is unstable at small gains already.
    """
    if not margin > 1.0:
        raise LawError(f"a gain margin is a factor above 1, not {margin}")

    def excess(exponent: float) -> float:
        return radius(axis, law, math.exp(exponent)) - 1.0

    unit = abs(float(np.real(1.0 / (axis.c @ np.linalg.solve(np.eye(len(axis.a)) - axis.a, axis.b))[0, 0])))
    size = float(np.abs(law(np.exp(1j * np.geomspace(1e-3, 1.0, 50)))).min())
    start = math.log(1e-4 * unit / size)
    # Small steps, as a loop that is stable again at yet higher gains is no loop to rely on. Rounding leaves an
    # integrator's eigenvalue at 1 for the smallest gains, hence the tolerance.
    exponents = start + np.arange(0.0, math.log(1e7), 0.05)
    unstable = next((i for i, x in enumerate(exponents) if excess(x) > 1e-9), None)
    if unstable is None:
        raise LawError("no gain makes this loop unstable, so no gain leaves it a gain margin")
    if unstable == 0:
        raise LawError("the loop is unstable at any gain: the law does not suit the plant")
    limit = scipy.optimize.brentq(excess, exponents[unstable - 1], exponents[unstable], xtol=1e-10)
    return math.exp(limit) / margin


def radius(axis: LoopPlant, law: control.StateSpace, gain: float) -> float:
    """Spectral radius of the loop of an axis and ``gain`` times its law."""
    loop = np.block(
        [
            [axis.a - gain * axis.b @ law.D @ axis.c, -gain * axis.b @ law.C],
            [law.B @ axis.c, law.A],
        ]
    )
    return float(np.abs(np.linalg.eigvals(loop)).max())
