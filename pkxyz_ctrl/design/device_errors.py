"""What devices differ in from their stage file: how far beforehand, and what was learnt of one. Light to import."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.config.adaptation import Start
from pkxyz_ctrl.config.calibration import Calibration, EachChain
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.core import adaptation as learning
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]


def within(start: Start, spread: Array) -> Array:
    """(PARAMETERS, PARAMETERS) in spreads: no number is known worse than beforehand."""
    covariance = np.array(start.covariance) / np.outer(spread, spread)
    shrunk = np.sqrt(np.minimum(1.0, 1.0 / np.diag(covariance)))
    return np.asarray(covariance * np.outer(shrunk, shrunk))


def calibrated(stage: StageConfig, values: Sequence[float]) -> StageConfig:
    """The stage with what was learnt (``PARAMETERS``,) as a calibration: what it takes to move that device.

    The growth of the pull is taken at half the stroke.
    """
    learnt, before = np.asarray(values), stage.calibration or Calibration()
    grown = 1.0 + 0.5 * learnt[learning.FRINGE]

    def each(old: EachChain, by: Array) -> EachChain:
        a, b, c = (float(o * b) for o, b in zip(old, by, strict=True))
        return a, b, c

    combs, sliders, cranks = (learnt[first : first + 3] for first in (learning.COMB, learning.SLIDER, learning.CRANK))

    found = before.model_copy(
        update={
            "comb_gain": each(before.comb_gain, grown / (1.0 - combs)),  # learnt is how much less is asked of it
            "slider_stiffness": each(before.slider_stiffness, 1.0 + sliders),
            "crank_stiffness": each(before.crank_stiffness, 1.0 + cranks),
            "link_stiffness": float(before.link_stiffness * (1.0 + learnt[learning.LINK])),
            "lift": float(before.lift + learnt[learning.LIFT]),
        }
    )
    return stage.model_copy(update={"calibration": found})


def spreads(controller: ControllerConfig, stage: Stage) -> Array:
    """(PARAMETERS,): one standard deviation of each number, in its unit. How a sense chain of a delay tau bends is
    not known: tau^2 / 2 for a pure delay, tau^2 for a pole.
    """
    config = controller.adaptation
    spread = np.empty(learning.PARAMETERS)
    spread[learning.COMB : learning.SLIDER] = config.comb_gain
    spread[learning.SLIDER : learning.FRINGE] = config.stiffness
    spread[learning.FRINGE], spread[learning.LIFT] = config.fringe, config.lift
    spread[learning.DAMPING], spread[learning.DELAY] = config.damping, config.sense_delay_s
    spread[learning.BEND] = max(config.sense_delay_s, stage.sense_delay_s) ** 2
    return spread
