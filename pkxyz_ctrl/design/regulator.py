"""State feedback: a discrete linear-quadratic regulator, solved by python-control and checked by its residual."""

import control
import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.controller_config import RegulatorConfig
from pkxyz_ctrl.design.design_error import DesignError
from pkxyz_ctrl.design.plant_model import SampledStage

Array = NDArray[np.float64]


def regulator_gain(sampled: SampledStage, config: RegulatorConfig) -> tuple[Array, Array]:
    """K_x (3,3) in N/m and K_v (3,3) in N s/m of w = -K_x x - K_v v, for Bryson weights.

    The regulator is designed for the state at the instant at which its force begins to act, which the filter
    predicts, so the loop's delay needs no further states. Raises ``DesignError`` where scipy's solution or stability
    says otherwise.
    """
    weights = (
        np.diag(np.repeat([config.position_error_m, config.velocity_error_m_per_s], 3) ** -2.0) * config.force_n**2
    )
    scale = np.repeat([config.position_error_m, config.velocity_error_m_per_s], 3)  # unit state of the scaled problem
    phi = sampled.phi[:6, :6] * scale[None, :] / scale[:, None]
    gamma = sampled.gamma[:6] * config.force_n / scale[:, None]
    q = weights * np.outer(scale, scale) / config.force_n**2
    gain, solution, _ = (np.asarray(part) for part in control.dlqr(phi, gamma, q, np.eye(3)))
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
