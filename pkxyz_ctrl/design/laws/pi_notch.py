"""The commercial baseline: on each axis an integrator with a proportional part behind two
notches, one at each of the stage's frequencies.

    K(s) = k (1/s + t_i) N(w_1) N(w_2),   N(w) = (s^2 + (w/Q) s + w^2) / (s^2 + 2 zeta w s + w^2)

The gain is what leaves the gain margin on the sampled, delayed plant.
"""

import math

import control
import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.config.laws import PiNotch
from pkxyz_ctrl.design.margins.gain_margin import gain_for_margin
from pkxyz_ctrl.design.model.discrete_law import DiscreteLaw, LawError, discretise, siso, stack
from pkxyz_ctrl.design.model.loop_plant import LoopPlant

Array = NDArray[np.float64]


def pi_notch(plant: LoopPlant, mass_kg: float, config: PiNotch | None = None) -> DiscreteLaw:
    """The law for a plant, with notches at the two frequencies of ``mode_frequencies_hz``. Raises ``LawError`` where
    no gain leaves the margin.
    """
    config = config or PiNotch()
    low, high = mode_frequencies_hz(plant, mass_kg)
    axes = []
    for i in range(3):
        axis = plant.axis(i)
        shape = siso(control.tf([config.integral_time_s, 1.0], [1.0, 0.0]))
        discrete = discretise(shape, plant.period_s)
        for frequency in (low, high):
            discrete = discrete * _notch(frequency, config, plant.period_s)
        gain = gain_for_margin(axis, discrete, 10.0 ** (config.gain_margin_db / 20.0))
        axes.append(gain * discrete)
    return stack(plant.period_s, axes)


def mode_frequencies_hz(plant: LoopPlant, mass_kg: float) -> tuple[float, float]:
    """The two frequencies in Hz of the stage under its holding forces that notches are put at: the in-plane modes'
    mean (a pair at the centre of the workspace), and the third.
    """
    eigenvalues = np.linalg.eigvalsh(plant.stiffness_n_per_m)
    if eigenvalues[0] <= 0.0:
        raise LawError(
            "the stage has no stable rest at this point: its stiffness under the holding forces is not positive"
        )
    frequency = np.sqrt(eigenvalues / mass_kg) / (2.0 * math.pi)
    return float(frequency[:2].mean()), float(frequency[2])


def _notch(frequency_hz: float, config: PiNotch, period_s: float) -> control.StateSpace:
    w = 2.0 * math.pi * frequency_hz
    notch = control.tf([1.0, w / config.quality_factor, w * w], [1.0, 2.0 * config.notch_damping * w, w * w])
    return discretise(siso(notch), period_s, prewarp_rad_per_s=w)
