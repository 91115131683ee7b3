"""What `pkxyz identify` finds of a sampled device, with the errors that it has, at the cost of its last step alone.

The process' mean device is excited for real, once: its loop runs for as long as the command's, and what is fitted says
how well modes, gains and lag are known. A sampled device's own gains, those of its springs, combs, sense combs and
links as they were made, get deviates of that covariance; and the command's own `calibrate` makes a stage file of them.
So what can't be known from inside is missed here as there: one scale of all sense combs, links that are too long.

With an instrument outside, the corners of half the strokes are held and seen with ``INSTRUMENT_M`` of noise, as
``identify --reference`` asks for.

Not told here: errors of the scenario's plant other than the device's (lift, feedthrough, drift), which bias as well.
"""

import itertools
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hil.studies.identify.outside_scale import outside_scale
from pkxyz_ctrl.config.calibration import Calibration
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.design.identification.calibrate import SenseGain, calibrate, gains
from pkxyz_ctrl.design.identification.modal_fit import ModalFit
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]

INSTRUMENT_M = 5e-9
"""Standard deviation of what the instrument sees, on each axis."""
_STREAM = 1
"""Of a device's random numbers: those of its identification."""


def deviates(seed: int, device: int) -> np.random.Generator:
    """Random numbers of a device's identification, a function of both alone."""
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(seed, spawn_key=(_STREAM, device))))


def from_inside(
    drawing: StageConfig, itself: StageConfig, modes: ModalFit, farad_per_count: float, rng: np.random.Generator
) -> Calibration:
    """Calibration of a device whose truth is ``itself``, as one identification in the middle of the strokes finds it.

    ``modes``: what was really measured of another. Raises ``FitError`` for a device that is not this drawing.
    """
    return _calibrated(drawing, itself, modes, farad_per_count, rng, SenseGain(np.ones(3), np.zeros(3)))


def with_instrument(
    drawing: StageConfig, itself: StageConfig, modes: ModalFit, farad_per_count: float, rng: np.random.Generator
) -> Calibration:
    """The same, with sense gains from an instrument outside."""
    strokes = 0.5 * np.array(
        list(itertools.product((drawing.limits.stroke_min_m, drawing.limits.stroke_max_m), repeat=3))
    )
    commanded = Stage(drawing).forward_kinematics(strokes)
    seen = Stage(itself).forward_kinematics(strokes / _sense_gain(itself))
    outside = outside_scale(Stage(drawing), commanded, seen + rng.normal(scale=INSTRUMENT_M, size=seen.shape))
    sense = SenseGain(outside.sense_gain, outside.standard_error)
    return _calibrated(drawing, itself, modes, farad_per_count, rng, sense)


def _calibrated(
    drawing: StageConfig,
    itself: StageConfig,
    modes: ModalFit,
    farad_per_count: float,
    rng: np.random.Generator,
    sense: SenseGain,
) -> Calibration:
    limits, device = drawing.limits, Stage(itself)
    believed = np.full(3, 0.5 * (limits.stroke_min_m + limits.stroke_max_m))  # held by the drawing's sense gains
    exact = gains(device, believed / _sense_gain(itself), farad_per_count)
    static, sudden = exact + np.linalg.cholesky(modes.gains_covariance).dot(rng.standard_normal(18)).reshape(2, 3, 3)
    damping = 0.5 / device.quality_factor + modes.damping_standard_error * rng.standard_normal(3)
    lag_s = modes.lag_s + modes.lag_standard_error_s * rng.standard_normal()
    measured = replace(modes, static_gain=static, acceleration_gain=sudden, damping=damping, lag_s=lag_s)
    return calibrate(drawing, believed / sense.gain, measured, farad_per_count, sense).calibration


def _sense_gain(itself: StageConfig) -> Array:
    return np.array((itself.calibration or Calibration()).sense_gain)
