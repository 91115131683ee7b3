"""The predictive law's problem as a solver wants it: matrices that never change, made once."""

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.core.kinematics import jacobian, pulls
from pkxyz_ctrl.core.predictive import FORCE_UNIT_N, STROKE_UNIT_M
from pkxyz_ctrl.loop import active_set

Array = NDArray[np.float64]

SOFTNESS = 100.0
"""What passing a stroke limit by a length costs, over what a position error of that length does."""
REHEARSAL_TICKS = 10
"""Every so many ticks without a problem one is posed and solved for nothing but that code and data stay in the caches:
a problem after a long time without one takes tens of microseconds more."""

PROBLEM = np.dtype(
    [
        ("pulls", "f8", (3, 3)),  # B_0
        ("inverse", "f8", (3, 3)),  # of that
        ("jacobian", "f8", (3, 3)),  # at the same place
        ("rehearsal_ticks", "i4"),
        ("program", active_set.PROGRAM),  # last, as a short horizon needs little of it
    ],
    align=True,
)


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
        cost = np.kron(np.eye(n), stage_cost)
        cost[-6:, -6:] = predictive["cost_to_go"]
        force_cost = self.pulls @ self.pulls.T * FORCE_UNIT_N**2
        hessian = forced.T @ cost @ forced + np.kron(np.eye(n), force_cost)
        unit = float(np.diag(hessian).mean())
        self.hessian = (hessian + hessian.T) / 2.0 / unit
        self.slope_scale = FORCE_UNIT_N / unit
        """q over half the derivative of the cost by v in N"""
        at_combs = np.kron(np.eye(n), np.hstack([self.jacobian, np.zeros((3, 3))]))
        self.stroke = at_combs @ forced / STROKE_UNIT_M
        self.slack_cost = SOFTNESS * float(predictive["position_weight"]) * STROKE_UNIT_M**2 / unit

    def matrices(self) -> tuple[Array, Array]:
        """H and A, both with the slack."""
        n = self.horizon
        hessian = np.diag(np.append(np.zeros(3 * n), self.slack_cost))
        hessian[:-1, :-1] = self.hessian
        slew = np.eye(3 * n)[3:] - np.eye(3 * n)[:-3]
        hard = np.hstack([np.vstack([np.eye(3 * n), slew]), np.zeros((6 * n - 3, 1))])
        return hessian, np.vstack([hard, np.hstack([self.stroke, -np.ones((3 * n, 1))])])

    def vectors(self, work: NDArray[np.void]) -> tuple[Array, Array, Array]:
        """q, with the slack's, l and u of a problem in ``work`` (1,) of ``active_set.WORK``, where A v is by how much
        strokes differ from those of another plan; here it is by how much from those without any force.
        """
        n, m = 3 * self.horizon, 9 * self.horizon - 3
        free, lower, upper = work["free"][0, :m], work["lower"][0, :m].copy(), work["upper"][0, :m].copy()
        offset = self.stroke @ free[:n] - free[-n:]
        lower[-n:] += offset
        upper[-n:] += offset
        return np.append(-self.hessian @ free[:n], 0.0), lower, upper

    def record(self) -> NDArray[np.void]:
        """(1,) of ``PROBLEM``."""
        made = np.zeros(1, PROBLEM)
        made["pulls"], made["inverse"], made["jacobian"] = self.pulls, np.linalg.inv(self.pulls), self.jacobian
        made["rehearsal_ticks"], made["program"] = REHEARSAL_TICKS, active_set.program(*self.matrices())
        return made
