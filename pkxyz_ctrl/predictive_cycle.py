"""One period of the controller with the predictive law: the cycle, with a plan made between its two parts.

The plan without limits is a matter of one multiplication and mostly keeps all limits; then it is the solution. Where it
does not, OSQP solves the problem, from where it stood, with a fixed step and a bounded number of iterations. Where it
doesn't come to an end the regulator's clipped answer stands, and the record says so.
"""

from typing import Any

import numpy as np
import osqp
import scipy.linalg
import scipy.sparse
from numba import njit
from numpy.typing import NDArray

from pkxyz_ctrl import cycle as cycling
from pkxyz_ctrl.core import predictive
from pkxyz_ctrl.core.kinematics import jacobian, pulls
from pkxyz_ctrl.core.linear3 import multiply3_transposed
from pkxyz_ctrl.direct_call import direct
from pkxyz_ctrl.safety.modes import LOOP_CLOSED

Array = NDArray[np.float64]
Records = NDArray[np.void]

FORCE_UNIT_N = 1e-4
"""Unit of the variables, and of strokes in the problem: numbers that a solver likes."""
STROKE_UNIT_M = 1e-6
SOFTNESS = 100.0
"""What passing a stroke limit by a length costs, over what a position error of that length does."""
TOLERANCE = 3e-3
"""Of the solver, relative and in these units. It matters at limits only: a plan that meets none is exact."""


class Problem:
    """minimise 1/2 v^T H v + q^T v, l <= A v <= u, over comb forces of n intervals (FORCE_UNIT_N) and one slack for
    each stroke (STROKE_UNIT_M), with q = error (e, c). H and A never change.
    """

    def __init__(self, law: NDArray[np.void]) -> None:
        """From the (1,) array of ``cycle.LAW``, whose kind is PREDICTIVE."""
        numbers = law["tick"][0]
        predictive_, filter_ = numbers["predictive"], numbers["estimator"]
        n = self.horizon = int(predictive_["horizon"])
        jacobian0, pulls0 = np.empty((3, 3)), np.empty((3, 3))
        jacobian(numbers["geometry"], filter_["operating_point_m"], jacobian0)
        pulls(numbers["geometry"], filter_["operating_point_m"], pulls0)
        phi, gamma = filter_["transition"][:, :6], filter_["input"] @ pulls0.T * FORCE_UNIT_N
        stage_cost = np.diag(np.repeat([predictive_["position_weight"], predictive_["velocity_weight"]], 3))
        force_cost = pulls0 @ pulls0.T * FORCE_UNIT_N**2
        end_cost = _riccati(phi, filter_["input"], stage_cost)
        # e_1 .. e_n = free e_0 + forced v + jumped c
        powers = [np.eye(6)]
        for _ in range(n):
            powers.append(phi @ powers[-1])
        free = np.vstack(powers[1:])
        forced, jumped = np.zeros((6 * n, 3 * n)), np.zeros((6 * n, 3 * n))
        for k in range(n):
            for i in range(k + 1):
                forced[6 * k : 6 * k + 6, 3 * i : 3 * i + 3] = powers[k - i] @ gamma
                jumped[6 * k : 6 * k + 6, 3 * i : 3 * i + 3] = powers[k - i][:, :3]
        cost = scipy.linalg.block_diag(*[stage_cost] * (n - 1), end_cost)
        hessian = forced.T @ cost @ forced + scipy.linalg.block_diag(*[force_cost] * n)
        unit = float(np.diag(hessian).mean())
        self.hessian = (hessian + hessian.T) / 2.0 / unit
        self.linear_error = forced.T @ cost @ free / unit
        self.linear_jump = forced.T @ cost @ jumped / unit
        self.answer_error = -np.linalg.solve(self.hessian, self.linear_error)
        self.answer_jump = -np.linalg.solve(self.hessian, self.linear_jump)
        at_combs = scipy.linalg.block_diag(*[np.hstack([jacobian0, np.zeros((3, 3))])] * n)
        at_combs = at_combs.reshape(n, 3, 6 * n)[1::2].reshape(-1, 6 * n)  # every other interval is close enough
        self.stroke_error, self.stroke_jump = at_combs @ free, at_combs @ jumped
        self.stroke_force = at_combs @ forced
        self.pulls = pulls0
        self.slack_cost = SOFTNESS * float(predictive_["position_weight"]) * STROKE_UNIT_M**2 / unit

    def matrices(self) -> tuple[scipy.sparse.csc_matrix, scipy.sparse.csc_matrix]:
        """H and A with the slacks: rows are bounds (3n), slews (3n - 3), and strokes at the end of
        every other interval (3 (n // 2)).
        """
        n = self.horizon
        hessian = scipy.linalg.block_diag(self.hessian, self.slack_cost * np.eye(3))
        slew = np.eye(3 * n)[3:] - np.eye(3 * n)[:-3]
        stroke = np.hstack([self.stroke_force / STROKE_UNIT_M, -np.vstack([np.eye(3)] * (n // 2))])
        rows = np.vstack([np.hstack([np.vstack([np.eye(3 * n), slew]), np.zeros((6 * n - 3, 3))]), stroke])
        return scipy.sparse.csc_matrix(np.triu(hessian)), scipy.sparse.csc_matrix(rows)


def _riccati(phi: Array, gamma: Array, cost: Array) -> Array:
    """P of the regulator: unit force cost. Solved in units in which the cost is one, as its sizes are far apart."""
    scale = 1.0 / np.sqrt(np.diag(cost))
    a, b = phi * scale[None, :] / scale[:, None], gamma / scale[:, None]
    unit = scipy.linalg.solve_discrete_are(a, b, np.eye(6), np.eye(3))
    return np.asarray(unit / np.outer(scale, scale))


class PredictiveCycle:
    """Stands in for ``cycle.cycle``, with the same arguments; remembers the last plan. One for each controller."""

    def __init__(self, law: NDArray[np.void]) -> None:
        self.problem = problem = Problem(law)
        n = problem.horizon
        self._rows = np.zeros((n + 2, 9))
        self._q, self._v = np.zeros(3 * n + 3), np.zeros(3 * n)
        limits = 6 * n - 3 + 3 * (n // 2)
        self._lower, self._upper = np.zeros(limits), np.zeros(limits)
        self._planned = np.zeros((n, 3))
        self._matrices = tuple(
            np.ascontiguousarray(m)
            for m in (
                problem.answer_error, problem.answer_jump, problem.linear_error, problem.linear_jump,
                problem.stroke_error, problem.stroke_jump, problem.stroke_force, problem.pulls,
            )
        )  # fmt: skip
        self._work = self._rows, self._q, self._v, self._lower, self._upper, self._planned
        self._solver = _solver(problem, law["tick"]["predictive"][0])
        self._cold = np.zeros(3 * n + 3), np.zeros(limits)
        self._is_cold = True
        memory, reference = cycling.new_memory(), np.zeros((1, 9))
        self._observe = direct(cycling.observe, law, memory, reference)
        self._respond = direct(cycling.respond, law, memory)
        self._plan = direct(plan, law, memory, reference, self._matrices, self._work)
        self._adopt = direct(adopt, law, memory, self._v, problem.pulls, self._planned, 1)

    def __call__(self, law: Records, memory: Records, reference: Array) -> None:
        """One period."""
        self._observe(law, memory, reference)
        found = self._plan(law, memory, reference, self._matrices, self._work)
        if found == predictive.LIMITED:
            self._solve(law, memory)
        elif found == 0:
            self._is_cold = True
        self._respond(law, memory)

    def on(
        self, law: Records, memory: Records, reference: Array, event: int, sense_status: int, node_events: int,
        overrun: int, count_1: int, count_2: int, count_3: int,
    ) -> tuple[int, int, int, int]:  # fmt: skip
        """One period with its input handed in, as ``cycle.cycle_on``: mode and drive counts."""
        seen = memory["input"][0]
        seen["event"], seen["sense_status"], seen["node_events"] = event, sense_status, node_events
        seen["overrun"], seen["sense_count"] = overrun, (count_1, count_2, count_3)
        self(law, memory, reference)
        a, b, c = memory["row"]["drive_count"][0].tolist()
        return int(memory["mode"][0]), a, b, c

    def _solve(self, law: Records, memory: Records) -> None:
        solver = self._solver
        if self._is_cold:
            solver.warm_start(*self._cold)
            self._is_cold = False
        solver.update_data_vec(q=self._q, l=self._lower, u=self._upper)
        solver.solve()
        info = solver.info
        if info.status_val == osqp.SolverStatus.OSQP_SOLVED:
            self._v[:] = solver.solution.x[:-3]
            self._adopt(law, memory, self._v, self.problem.pulls, self._planned, info.iter)
        else:
            memory["tick"]["solver_iterations"] = -info.iter
            self._is_cold = True


def _solver(problem: Problem, numbers: np.void) -> Any:
    """OSQP's own object, below its Python layer: 10 us a call less."""
    hessian, rows = problem.matrices()
    m, n = rows.shape
    solver = osqp.OSQP()
    solver.setup(
        hessian, np.zeros(n), rows, np.full(m, -1.0), np.full(m, 1.0),
        rho=float(numbers["rho"]), adaptive_rho=False, max_iter=int(numbers["iterations_max"]), check_termination=5,
        eps_abs=TOLERANCE, eps_rel=TOLERANCE, polishing=False, warm_starting=True, verbose=False,
    )  # fmt: skip
    return solver._solver


@njit(cache=True)
def plan(law_array: Records, memory_array: Records, reference: Array, matrices: tuple[Array, ...], work: Any) -> int:
    """The problem of this tick: its vectors, and its solution without limits, which is adopted if it keeps them.

    0 with an open loop, else ``predictive.FREE`` or ``predictive.LIMITED``.
    """
    law, memory = law_array[0], memory_array[0]
    rows, q, v, lower, upper, planned = work
    n = len(v) // 3
    if LOOP_CLOSED[memory["mode"]] == 0:
        planned[:] = 0.0
        return 0
    state, pulls0 = memory["tick"], matrices[7]
    for k in range(n + 2):
        cycling.reference_row(law, memory, reference, law["tick"]["delay_periods"] + k, rows[k])
    feedforward, comb, error = np.empty((n, 3)), np.empty((n, 3)), np.empty(6)
    predictive.feedforwards(law["tick"], rows[: n + 1], feedforward, comb)
    predictive.deviation(law["tick"], state, rows, feedforward, error)
    v[:] = matrices[0] @ error
    q[: 3 * n] = matrices[2] @ error
    stroke = matrices[4] @ error
    jump = np.empty((n, 3))
    if predictive.jumps(law["tick"]["feedback"]["period_s"], rows[: n + 1], jump):
        flat = jump.reshape(3 * n)
        v += matrices[1] @ flat
        q[: 3 * n] += matrices[3] @ flat
        stroke += matrices[5] @ flat
    offset = np.empty(3)
    offset[:] = np.linalg.solve(pulls0.T, state["estimate"]["ahead"][6:9])
    predictive.comb_bounds(law["tick"]["drive"], state["count"][0], comb, offset, lower, upper)
    predictive.slew_bounds(law["tick"]["drive"], comb, planned, lower[3 * n :], upper[3 * n :])
    predictive.stroke_bounds(law["tick"], rows[2 : n + 1 : 2].copy(), stroke, lower[6 * n - 3 :], upper[6 * n - 3 :])
    for i in range(6 * n - 3):
        lower[i] /= FORCE_UNIT_N
        upper[i] /= FORCE_UNIT_N
    for i in range(6 * n - 3, len(lower)):
        lower[i] /= STROKE_UNIT_M
        upper[i] /= STROKE_UNIT_M
    # what of the feed-forward a plan is about, for whoever adopts it
    for k in range(n):
        for i in range(3):
            planned[k, i] = comb[k, i] - offset[i]
    slewed = v[3:] - v[:-3]
    stroked = matrices[6] @ v / STROKE_UNIT_M
    if not predictive.is_inside(lower, upper, slewed, stroked, v, n):
        return predictive.LIMITED
    adopt(law_array, memory_array, v, pulls0, planned, 0)
    return predictive.FREE


@njit(cache=True)
def adopt(law_array: Records, memory_array: Records, v: Array, pulls0: Array, planned: Array, iterations: int) -> None:
    """Make a plan v (3n,) this tick's: its first force less the disturbance goes to the law, all of it is kept."""
    state = memory_array[0]["tick"]
    first = v[0:3] * FORCE_UNIT_N
    multiply3_transposed(pulls0, first, state["plan_n"])
    for i in range(3):
        state["plan_n"][i] -= state["estimate"]["ahead"][6 + i]
    state["plan_known"] = 1
    state["solver_iterations"] = iterations
    for k in range(len(planned)):
        for i in range(3):
            planned[k, i] += v[3 * k + i] * FORCE_UNIT_N
