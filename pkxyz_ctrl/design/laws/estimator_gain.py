"""The Kalman filter's constant gain: filterpy discretises the noise and runs the filter,
scipy solves the Riccati equation.

The two must agree, or there is no controller: a gain that only one of them believes in is an error in the model.
"""

import math

import numpy as np
import scipy.linalg
from filterpy.common import van_loan_discretization
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import EstimatorConfig
from pkxyz_ctrl.design.model.design_error import DesignError
from pkxyz_ctrl.design.model.plant_model import LinearStage, SampledStage
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]


def process_noise(model: LinearStage, config: EstimatorConfig, period_s: float) -> tuple[Array, Array]:
    """Phi (9,9) and Q (9,9) by van Loan's method for white force noise on v and a random walk of d."""
    shaping = np.zeros((9, 6))
    shaping[3:6, 0:3] = (
        np.eye(3) * config.force_noise_n_per_rthz / (math.sqrt(2.0) * model.mass_kg)
    )  # one-sided to two-sided
    shaping[6:9, 3:6] = np.eye(3) * config.disturbance_drift_n_per_rts
    return van_loan_discretization(model.a, shaping, period_s)


def shaken_covariance(model: LinearStage, force_n_per_rthz: float, period_s: float) -> Array:
    """(6,6) that a white force on the platform, of a one-sided density, adds to position and velocity in a period."""
    shaping = np.vstack([np.zeros((3, 3)), np.eye(3) * force_n_per_rthz / (math.sqrt(2.0) * model.mass_kg)])
    return np.asarray(van_loan_discretization(model.a[:6, :6], shaping, period_s)[1])


def sense_noise(stage: Stage, bus: BusConfig) -> Array:
    """Standard deviation (3,) in m of one sample of each stroke:
    white noise up to half the sampling rate, and quantisation.
    """
    sigma_f = stage.config.sense.noise_density_f_per_rthz * math.sqrt(0.5 / bus.period_s)
    step_f = bus.analog.sense_farad_per_count
    return np.asarray(math.sqrt(sigma_f**2 + step_f**2 / 12) / stage.sense_gradient_f_per_m)


def measurement_noise(stage: Stage, model: LinearStage, bus: BusConfig) -> Array:
    """R (3,3) in m^2 in platform coordinates: J^-1 diag(sigma^2) J^-T."""
    sigma_m = sense_noise(stage, bus)
    inverse = np.linalg.inv(model.jacobian) * (sigma_m / sigma_m[0])
    return sigma_m[0] ** 2 * inverse @ inverse.T


def measurement_matrix(stage: Stage) -> Array:
    """H (3,9): a sample shows the position a sense delay ago, x - tau v."""
    h = np.zeros((3, 9))
    h[:, 0:3] = np.eye(3)
    h[:, 3:6] = -stage.sense_delay_s * np.eye(3)
    return h


# The Riccati equation is solved in nm, um/s and uN, where its numbers are within some decades of 1.
_UNITS = np.repeat([1e-9, 1e-6, 1e-6], 3)


def steady_filter(sampled: SampledStage, q: Array, h: Array, r: Array) -> tuple[Array, Array]:
    """Steady-state gain (9,3) of the measurement update, and the covariance (3,3) in m^2 of its innovations, by scipy's
    discrete Riccati solver; raises ``DesignError`` unless filterpy agrees.
    """
    scale = _UNITS
    phi, q_scaled, h_scaled, r_scaled, predicted = _steady(sampled, q, h, r)
    innovation = h_scaled @ predicted @ h_scaled.T + r_scaled
    gain: Array = np.asarray(np.linalg.solve(innovation, h_scaled @ predicted).T, dtype=np.float64)
    _agree_with_filterpy(phi, q_scaled, h_scaled, r_scaled, predicted, gain)
    return gain * scale[:, None] / 1e-9, np.asarray(innovation) * 1e-18


def _steady(sampled: SampledStage, q: Array, h: Array, r: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Phi, Q, H and R in these units, and the covariance of the steady prediction."""
    scale = _UNITS
    phi = sampled.phi * scale[None, :] / scale[:, None]
    q_scaled = q / np.outer(scale, scale)
    h_scaled = h * scale[None, :] / 1e-9
    r_scaled = r / 1e-18
    predicted = np.asarray(scipy.linalg.solve_discrete_are(phi.T, h_scaled.T, q_scaled, r_scaled), dtype=np.float64)
    return phi, q_scaled, h_scaled, r_scaled, predicted


def _agree_with_filterpy(phi: Array, q: Array, h: Array, r: Array, predicted: Array, gain: Array) -> None:
    """One step of filterpy's filter from scipy's solution must lead back to it, with the same gain; and be stable."""
    reference = KalmanFilter(dim_x=9, dim_z=3)
    reference.F, reference.Q, reference.H, reference.R = phi, q, h, r
    reference.P = predicted.copy()
    reference.update(np.zeros(3))
    reference.predict()
    error = float(np.abs(reference.K - gain).max() / np.abs(gain).max())
    drift = float(np.abs(reference.P - predicted).max() / np.abs(predicted).max())
    radius = float(np.abs(np.linalg.eigvals(phi - phi @ gain @ h)).max())
    if not (error < 1e-6 and drift < 1e-6 and radius < 1.0):
        raise DesignError(
            f"Kalman filter: scipy's steady state and filterpy's step from it differ by {max(error, drift):.1e}, "
            f"spectral radius {radius:.6f}; check the noise levels of the controller file"
        )
