"""The predictive law's problem as a solver wants it: matrices that never change, made once."""

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from pkxyz_ctrl.core.kinematics import jacobian, pulls

Array = NDArray[np.float64]

FORCE_UNIT_N = 1e-4
"""Unit of the variables, and of strokes in the problem: numbers that a solver likes."""
STROKE_UNIT_M = 1e-6
SOFTNESS = 100.0
"""What passing a stroke limit by a length costs, over what a position error of that length does."""


class Problem:
    """minimise 1/2 v^T H v + q^T v, l <= A v <= u, over comb forces of n intervals (FORCE_UNIT_N) and one slack for all
    strokes (STROKE_UNIT_M). Rows of A: bounds (3n), slews (3n - 3), and strokes at the ends of the intervals (3n).
    """

    def __init__(self, law: NDArray[np.void]) -> None:
        """From the (1,) array of ``cycle.LAW``, whose kind is PREDICTIVE."""
        numbers = law["tick"][0]
        predictive, filter_ = numbers["predictive"], numbers["estimator"]
        n = self.horizon = int(predictive["horizon"])
        self.jacobian, self.pulls = np.empty((3, 3)), np.empty((3, 3))
        jacobian(numbers["geometry"], filter_["operating_point_m"], self.jacobian)
        pulls(numbers["geometry"], filter_["operating_point_m"], self.pulls)
        phi, gamma = filter_["transition"][:, :6], filter_["input"] @ self.pulls.T * FORCE_UNIT_N
        forced = np.zeros((6 * n, 3 * n))  # e_1 .. e_n that v leads to
        for i in range(n):
            response = gamma
            for k in range(i, n):
                forced[6 * k : 6 * k + 6, 3 * i : 3 * i + 3] = response
                response = phi @ response
        stage_cost = np.diag(np.repeat([predictive["position_weight"], predictive["velocity_weight"]], 3))
        cost = scipy.linalg.block_diag(*[stage_cost] * (n - 1), predictive["cost_to_go"])
        force_cost = self.pulls @ self.pulls.T * FORCE_UNIT_N**2
        hessian = forced.T @ cost @ forced + scipy.linalg.block_diag(*[force_cost] * n)
        unit = float(np.diag(hessian).mean())
        self.hessian = (hessian + hessian.T) / 2.0 / unit
        self.slope_scale = FORCE_UNIT_N / unit
        """q over what ``predictive.slope`` says"""
        at_combs = scipy.linalg.block_diag(*[np.hstack([self.jacobian, np.zeros((3, 3))])] * n)
        self.stroke = at_combs @ forced / STROKE_UNIT_M
        self.slack_cost = SOFTNESS * float(predictive["position_weight"]) * STROKE_UNIT_M**2 / unit

    def matrices(self) -> tuple[Array, Array]:
        """H and A, both with the slack."""
        n = self.horizon
        hessian = scipy.linalg.block_diag(self.hessian, [[self.slack_cost]])
        slew = np.eye(3 * n)[3:] - np.eye(3 * n)[:-3]
        hard = np.hstack([np.vstack([np.eye(3 * n), slew]), np.zeros((6 * n - 3, 1))])
        return hessian, np.vstack([hard, np.hstack([self.stroke, -np.ones((3 * n, 1))])])
