"""Integral resonant control: a loop that damps the resonance, and a PI law around it that tracks.

Feedthrough past the plant, y + D w with D below minus the plant's gain at rest, puts a pair of zeros below the
resonance, and an integrator around it damps the poles on their way there (Aphale, Fleming, Moheimani 2007; Fleming,
Aphale, Moheimani 2010). Without the feedthrough written apart it is a first-order law with positive feedback::

    w = C_d(s) (e - v),   C_d = g / (s + g |D|),   v = k (t_i + 1/s) e

so from e to force it is one law, w = -C_d (k t_i + k / s - 1) e. The integrator's gain g is taken
from the root locus, as in that literature, but of the sampled, delayed plant: where the resonance is
damped most. k is what the gain margin leaves.
"""

import math

import control
import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from pkxyz_ctrl.config.laws import Irc
from pkxyz_ctrl.design.margins.gain_margin import radius
from pkxyz_ctrl.design.model.discrete_law import DiscreteLaw, LawError, discretise, siso, stack
from pkxyz_ctrl.design.model.loop_plant import LoopPlant

Array = NDArray[np.float64]


def irc(plant: LoopPlant, config: Irc | None = None) -> DiscreteLaw:
    """The law for a plant, damping first, then tracking to the gain margin. Raises
    ``LawError`` where either can't be had.
    """
    config = config or Irc()
    if not config.feedthrough > 1.0:
        raise LawError(
            f"feedthrough must be above 1, not {config.feedthrough:g}: it has to outweigh the stage's compliance"
        )
    return stack(plant.period_s, [_axis_law(plant.axis(i), config) for i in range(3)])


def damping_law(axis: LoopPlant, config: Irc) -> tuple[control.StateSpace, float]:
    """C_d for an axis, and the damping ratio that the least damped pole has with it."""
    compliance = float(1.0 / axis.stiffness_n_per_m[0, 0])

    def law(exponent: float) -> control.StateSpace:
        corner = math.exp(exponent)
        gain = corner / (config.feedthrough * compliance)
        return discretise(siso(control.tf([gain], [1.0, corner])), axis.period_s)

    def undamped(exponent: float) -> float:
        return -least_damping(axis, law(exponent))

    corners = np.log(2.0 * math.pi * np.geomspace(10.0, 5.0 / axis.period_s, 80))
    best = corners[int(np.argmin([undamped(x) for x in corners]))]
    found = scipy.optimize.minimize_scalar(undamped, bounds=(best - 0.2, best + 0.2), method="bounded")
    return law(float(found.x)), -float(found.fun)


def least_damping(axis: LoopPlant, positive_feedback: control.StateSpace) -> float:
    """Smallest damping ratio among the poles of an axis with a law that feeds back positively; negative if unstable."""
    poles = np.linalg.eigvals(_inner(axis, positive_feedback).a)
    poles = np.log(poles[np.abs(poles) > 1e-6].astype(complex))
    return float((-poles.real / np.abs(poles)).min())


def _inner(axis: LoopPlant, damping: control.StateSpace) -> LoopPlant:
    """The damped axis, w = C_d (y - v), from v to -y: so that a positive law closes the tracking loop."""
    a = np.block(
        [
            [axis.a + axis.b @ damping.D @ axis.c, axis.b @ damping.C],
            [damping.B @ axis.c, damping.A],
        ]
    )
    b = np.vstack([axis.b @ damping.D, damping.B])
    c = np.hstack([axis.c, np.zeros((1, damping.nstates))])
    return LoopPlant(axis.period_s, a, -b, -c, axis.strokes_m, axis.stiffness_n_per_m)


def _axis_law(axis: LoopPlant, config: Irc) -> control.StateSpace:
    damping, ratio = damping_law(axis, config)
    own = least_damping(axis, 0.0 * damping)
    if not ratio > 1.1 * own:
        raise LawError(
            f"integral resonant control does not damp this axis (ratio {ratio:.3f}, {own:.3f} without it): "
            "the loop's delay turns its phase too far; use a faster bus or another law"
        )
    tracking = discretise(siso(control.tf([config.integral_time_s, 1.0], [1.0, 0.0])), axis.period_s)
    margin = 10.0 ** (config.gain_margin_db / 20.0)

    def composed(gain: float) -> control.StateSpace:
        return damping * (gain * tracking - 1.0)

    def bears(gain: float) -> bool:
        law = composed(gain)
        return all(radius(axis, law, float(factor)) < 1.0 for factor in np.linspace(margin, 1.0, 4))

    gains = 2.0 * math.pi * np.geomspace(1.0, 0.5 / axis.period_s, 60)
    good = [gain for gain in gains if bears(float(gain))]
    if not good:
        raise LawError(
            f"integral resonant control: no tracking gain leaves {config.gain_margin_db:g} dB of gain margin"
        )
    low, high = max(good), max(good) * gains[1] / gains[0]
    for _ in range(30):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if bears(middle) else (low, middle)
    return composed(low)
