"""From measured gains to a stage's calibration: which combs, springs and lift make the model's response the stage's.

Slow and sudden changes of the squared voltages move the counts of the chains by::

    static        S J (K - G)^-1 B^T C          acceleration        S J M^-1 B^T C

S counts per metre and C newtons per V^2 (diagonal), J the strokes' gradients, B the combs' pulls (J with lift), K the
springs' stiffness, G what the held forces take off it. Two times nine numbers, measured with their covariance
(``modal_fit``), against ten unknowns by least squares: three comb gains, lift, the out-of-plane hinges, and for the
six springs of the chains a common factor and two differences each of sliders and of cranks, as the response does not
tell their common factors apart. Where a slow sense chain leaves the acceleration gains in doubt, the resonances are
fitted as well. The mass is the drawing's: with all forces, stiffnesses and the mass doubled, nothing would look
different. So are the metres per farad, unless they are given. Damping and delay are one number each: that of all modes
together.
"""

import math
from dataclasses import dataclass

import numpy as np
import scipy.optimize
from numpy.typing import NDArray
from pydantic import ValidationError

from pkxyz_ctrl.config.calibration import Calibration, StandardErrors
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.design.identification.modal_fit import FitError, ModalFit, combined
from pkxyz_ctrl.design.model.loop_plant import held_force_softening
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]

UNKNOWNS = 10

SIGNIFICANT = 13.8
"""Chi-square of two ratios that noise alone passes once in a thousand."""
TOLD_APART = 1e-6
"""Least of a fit's singular values over the greatest: 0.06 on the shipped drawing, 1e-14 where springs ran away."""

_DIFFERENCES = np.array([[2.0, -1.0, -1.0], [0.0, 1.0, -1.0]]) / np.array([[6.0], [2.0]]) ** 0.5
"""Orthonormal, sum 0: how three springs, or three sense gains, may differ."""


@dataclass(frozen=True)
class SenseGain:
    """(3,) capacitance per stroke by that of the drawing, and its standard error; 0 where it is assumed."""

    gain: Array
    error: Array

    @property
    def assumed(self) -> bool:
        """Nobody measured it."""
        return not self.error.any()


@dataclass(frozen=True)
class Calibrated:
    """Numbers that explain a measured response, and how well."""

    calibration: Calibration
    """with standard errors, without provenance"""
    chi_square: float
    """mean square of what they leave, 1 where noise alone is left; standard errors are scaled with its root"""
    reciprocal: SenseGain
    """sense gains that make the response reciprocal (what comb i does to stroke k, comb k does to stroke i), with the
    product of those that were given: that is all that can be told of them from inside
    """
    differ: bool
    """whether that is significantly other than what was given"""


def calibrate(
    config: StageConfig, strokes_m: Array, modes: ModalFit, farad_per_count: float, sense: SenseGain
) -> Calibrated:
    """Fit to what was measured about ``strokes_m`` (3,), true to ``sense``. Gains of the sense combs that were only
    assumed give way to reciprocity, if that contradicts them. Raises ``FitError`` for another device.
    """
    seen, root = _measured(modes)

    def misses(unknown: Array) -> Array:
        stage = Stage(config.model_copy(update={"calibration": _numbers(unknown, sense.gain)}))
        return np.asarray(np.linalg.solve(root, _told(stage, strokes_m, farad_per_count, modes) - seen))

    def fitted(start: Array) -> tuple[Array, Array, float]:
        fit = scipy.optimize.least_squares(misses, start, x_scale=0.01)
        singular = np.linalg.svd(fit.jac, compute_uv=False)
        if singular[-1] < TOLD_APART * singular[0]:
            raise FitError("the stage is not this drawing: no springs, no gains answer so; give the right --stage")
        chi_square = float(fit.fun @ fit.fun) / (len(seen) - len(start))
        return fit.x, np.linalg.inv(fit.jac.T @ fit.jac) * max(1.0, chi_square), chi_square

    unknown, covariance, chi_square = fitted(np.array([0.0] * 3 + [0.0, 1.0] + [0.0] * 4 + [1.0]))
    freed, freed_covariance, freed_chi_square = fitted(np.append(unknown, [0.0, 0.0]))
    ratios, of_ratios = freed[UNKNOWNS:], freed_covariance[UNKNOWNS:, UNKNOWNS:]
    apart = sense.gain * np.exp(_DIFFERENCES.T @ ratios)
    reciprocal = SenseGain(apart, apart * np.sqrt(np.diag(_DIFFERENCES.T @ of_ratios @ _DIFFERENCES)))
    differ = bool(ratios @ np.linalg.solve(of_ratios, ratios) > SIGNIFICANT)
    if differ and sense.assumed:
        sense, unknown, covariance, chi_square = reciprocal, freed, freed_covariance, freed_chi_square
        comb_error = np.zeros(3)
    else:
        comb_error = sense.error / sense.gain
    numbers = _numbers(unknown[:UNKNOWNS], sense.gain)
    springs = np.sqrt(np.diag(_SPRINGS @ covariance[:UNKNOWNS, :UNKNOWNS] @ _SPRINGS.T))
    damping, damping_error = combined(
        modes.damping[modes.apart], np.diag(modes.damping_standard_error[modes.apart] ** 2)
    )
    amplifier_s = 0.5 / (math.pi * config.amplifier.bandwidth_hz)
    errors = StandardErrors(
        comb_gain=_triple(np.hypot(np.sqrt(np.diag(covariance)[:3]), comb_error) * np.array(numbers.comb_gain)),
        lift=float(np.sqrt(covariance[3, 3])),
        sense_gain=_triple(sense.error),
        slider_stiffness=_triple(springs[:3]),
        crank_stiffness=_triple(springs[3:]),
        link_stiffness=float(np.sqrt(covariance[9, 9])),
        quality_factor=0.5 / damping**2 * damping_error,
        sense_delay_s=modes.lag_standard_error_s,
    )
    found = numbers.model_dump() | {
        "quality_factor": 0.5 / damping, "sense_delay_s": max(0.0, modes.lag_s - amplifier_s), "standard_error": errors,
    }  # fmt: skip
    try:
        return Calibrated(Calibration.model_validate(found), chi_square, reciprocal, differ)
    except ValidationError as error:
        wrong = ", ".join(f"{item['loc'][0]} = {item['input']:.3g}" for item in error.errors())
        raise FitError(f"the stage is not this drawing: {wrong} by it; give the right --stage") from None


def _measured(modes: ModalFit) -> tuple[Array, Array]:
    """What is fitted to, (18,), and the root of its covariance; resonances too, (18 + n,), where a sense chain's pole
    leaves sudden gains in doubt by per cents.
    """
    seen = np.concatenate([modes.static_gain.ravel(), modes.acceleration_gain.ravel()])
    covariance = modes.gains_covariance
    if modes.resonances_covariance is not None:
        seen, covariance = np.append(seen, modes.frequency_hz[modes.apart]), modes.resonances_covariance
    return seen, np.asarray(np.linalg.cholesky(covariance))


def _told(stage: Stage, strokes_m: Array, farad_per_count: float, modes: ModalFit) -> Array:
    """The same by the model."""
    told = gains(stage, strokes_m, farad_per_count).ravel()
    if modes.resonances_covariance is None:
        return told
    return np.append(told, resonances_hz(stage, strokes_m, modes.apart))


def gains(stage: Stage, strokes_m: Array, farad_per_count: float) -> Array:
    """Static gain in counts/V^2 and acceleration gain in counts/s^2 per V^2 (2, 3, 3) by the model, about strokes."""
    position = stage.forward_kinematics(strokes_m)
    rows, pulls = stage.jacobian(position), stage.pulls(position)
    held = stage.stiffness(position) - held_force_softening(stage, position)
    moved = np.stack([np.linalg.solve(held, pulls.T), pulls.T / stage.mass_kg])
    count_per_m = stage.sense_gradient_f_per_m / farad_per_count
    return np.asarray(count_per_m[:, None] * (rows @ moved) * stage.force_gain_n_per_v2)


def resonances_hz(stage: Stage, strokes_m: Array, apart: NDArray[np.bool_]) -> Array:
    """Natural frequencies by the model, about strokes, of the modes that are ``apart`` (3,): of those that coincide the
    mean, (n,) ascending.
    """
    position = stage.forward_kinematics(strokes_m)
    held = stage.stiffness(position) - held_force_softening(stage, position)
    hz = np.sqrt(np.linalg.eigvalsh(held) / stage.mass_kg) / (2.0 * math.pi)
    first = np.flatnonzero(apart)
    return np.asarray(np.add.reduceat(hz, first) / np.diff(first, append=len(apart)))


_SPRINGS = np.zeros((6, UNKNOWNS))
_SPRINGS[:, 4] = 1.0
_SPRINGS[:3, 5:7] = _SPRINGS[3:, 7:9] = _DIFFERENCES.T


def _numbers(unknown: Array, sense_gain: Array) -> Calibration:
    """From the fit's unknowns, (10,), or (12,) with the ratios of the sense gains."""
    ratios = unknown[UNKNOWNS:]
    gain = sense_gain * np.exp(_DIFFERENCES.T @ ratios) if len(ratios) else sense_gain
    springs = _SPRINGS @ unknown[:UNKNOWNS]
    return Calibration.model_construct(
        comb_gain=_triple(np.exp(unknown[:3])),
        lift=float(unknown[3]),
        sense_gain=_triple(gain),
        slider_stiffness=_triple(springs[:3]),
        crank_stiffness=_triple(springs[3:]),
        link_stiffness=float(unknown[9]),
    )


def _triple(values: Array) -> tuple[float, float, float]:
    a, b, c = (float(v) for v in values)
    return a, b, c
