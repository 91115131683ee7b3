"""Where the rounding of the voltages may make noise: not at 0 Hz, and not at the stage's modes."""

import math

import numpy as np

from pkxyz_ctrl.design.model.plant_model import LinearStage

FIRST_ORDER = (1.0, 0.0, 0.0)
"""A zero at 0 Hz alone: the least noise where something else moves the counts."""


def shaping_between_modes(model: LinearStage, period_s: float) -> tuple[float, float, float]:
    """s_1, s_2, s_3 of ``core.voltage``: zeros at 0 Hz, and on the circle between the lowest and the highest mode of
    the stage, as far from either in the cosine of their angles. Modes above half the sampling rate are met by a held
    force, too, and their zero is where they fold to.
    """
    angle = np.sqrt(np.linalg.eigvalsh(model.stiffness_n_per_m) / model.mass_kg) * period_s
    twice_c = math.cos(float(angle[0])) + math.cos(float(angle[-1]))
    return 1.0 + twice_c, -1.0 - twice_c, 1.0
