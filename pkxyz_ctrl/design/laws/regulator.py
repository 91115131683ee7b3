"""State feedback: a discrete linear-quadratic regulator, solved by scipy and checked by its residual."""

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from pkxyz_ctrl.config.controller import RegulatorConfig, SetPointsConfig
from pkxyz_ctrl.design.model.design_error import DesignError
from pkxyz_ctrl.design.model.plant_model import SampledStage

Array = NDArray[np.float64]


def regulator_gain(sampled: SampledStage, config: RegulatorConfig | SetPointsConfig) -> tuple[Array, Array]:
    """K_x (3,3) in N/m and K_v (3,3) in N s/m of w = -K_x x - K_v v, for Bryson weights.

    The regulator is designed for the state at the instant at which its force begins to act, which
    the filter predicts, so the loop's delay needs no further states. Raises ``DesignError`` where
    scipy's solution or stability says otherwise.
    """
    weights = (
        np.diag(np.repeat([config.position_error_m, config.velocity_error_m_per_s], 3) ** -2.0) * config.force_n**2
    )
    scale = np.repeat([config.position_error_m, config.velocity_error_m_per_s], 3)  # unit state of the scaled problem
    phi = sampled.phi[:6, :6] * scale[None, :] / scale[:, None]
    gamma = sampled.gamma[:6] * config.force_n / scale[:, None]
    q = weights * np.outer(scale, scale) / config.force_n**2
    solution = np.asarray(scipy.linalg.solve_discrete_are(phi, gamma, q, np.eye(3)))
    gain = scipy.linalg.solve(gamma.T @ solution @ gamma + np.eye(3), gamma.T @ solution @ phi)
    # Solved there, checked here: the Riccati equation's residual, by its own arithmetic.
    cost = phi.T @ solution @ (phi - gamma @ gain) + q
    error = float(np.abs(cost - solution).max() / np.abs(solution).max())
    radius = float(np.abs(np.linalg.eigvals(phi - gamma @ gain)).max())
    if not (error < 1e-6 and radius < 1.0):
        raise DesignError(
            f"regulator: the Riccati equation is fulfilled to {error:.1e} only, closed-loop spectral radius "
            f"{radius:.6f}; check the weights"
        )
    physical = gain * config.force_n / scale[None, :]
    return physical[:, :3], physical[:, 3:]


def cost_to_go(
    phi: Array, gamma: Array, gain: Array, position_weight: float, velocity_weight: float
) -> tuple[Array, Array, Array]:
    """P (6,6) of e^T P e, what the regulator w = -K e costs from a state e on for weights of position and velocity and
    a unit weight of force; Phi - Gamma K; and (1 + Gamma^T P Gamma)^-1 Gamma^T, which is K's counterpart for what is
    added to e at the end of the period.
    """
    closed = phi - gamma @ gain
    scale = np.repeat([position_weight, velocity_weight], 3) ** -0.5  # the unit state costs 1
    a, k = closed * scale[None, :] / scale[:, None], gain * scale[None, :]
    unit = scipy.linalg.solve_discrete_lyapunov(a.T, np.eye(6) + k.T @ k)
    cost = (unit + unit.T) / 2.0 / np.outer(scale, scale)
    return cost, closed, np.linalg.solve(np.eye(3) + gamma.T @ cost @ gamma, gamma.T)
