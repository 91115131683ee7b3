"""One period of the controller with the predictive law: the cycle, with a plan made between its two parts.

The plan without limits is a matter of a recursion and mostly keeps all limits; then it is the solution. Where it does
not, the problem is solved exactly, in a bounded number of rounds. Where that doesn't come to an end the regulator's
clipped answer stands, and the record says so.
"""

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.direct_call import direct
from pkxyz_ctrl.core import feedback, predictive
from pkxyz_ctrl.core.demand import feedforward
from pkxyz_ctrl.core.kinematics import pulls
from pkxyz_ctrl.core.linear3 import multiply3, multiply3_transposed
from pkxyz_ctrl.loop import active_set
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.predictive_problem import FORCE_UNIT_N, STROKE_UNIT_M, Problem
from pkxyz_ctrl.loop.reference import standing_still
from pkxyz_ctrl.loop.set_points import reference_row
from pkxyz_ctrl.safety.modes import LOOP_CLOSED

Array = NDArray[np.float64]
Records = NDArray[np.void]

REHEARSAL_TICKS = 10
"""Every so many ticks without a problem the last one is solved again, for nothing but that code and data stay in the
caches: a problem after a long time without one takes tens of microseconds more."""


class PredictiveCycle:
    """Stands in for ``cycle.cycle``, with the same arguments; remembers the last plan. One for each controller."""

    def __init__(self, law: NDArray[np.void]) -> None:
        self.problem = problem = Problem(law)
        n, (hessian, rows) = problem.horizon, problem.matrices()
        fixed = problem.pulls, np.linalg.inv(problem.pulls), problem.jacobian, problem.slope_scale
        tried = np.zeros((n + 2, 9)), np.zeros(6), np.zeros((n, 3))
        self.vectors = np.zeros(3 * n), np.zeros(9 * n - 3), np.zeros(9 * n - 3), np.zeros(3 * n)
        """of the last problem: q, lower and upper limits, and its solution"""
        solver = active_set.between(hessian, rows), active_set.work(3 * n + 1, 9 * n - 3)
        memory, reference = cycling.new_memory(), standing_still()
        self._own = fixed, tried, self.vectors, solver
        self._again = *solver, *self.vectors[:3], int(law["tick"]["predictive"]["iterations_max"][0]), self.vectors[3]
        self._free_ticks = 0
        self._observe = direct(cycling.observe, law, memory, reference)
        self._respond = direct(cycling.respond, law, memory)
        self._plan = direct(plan, law, memory, reference, *self._own)
        self._rehearse = direct(active_set.solve, *self._again)

    def __call__(self, law: Records, memory: Records, reference: Records) -> None:
        """One period."""
        self._observe(law, memory, reference)
        if self._plan(law, memory, reference, *self._own) == predictive.FREE:
            self._free_ticks += 1
            if self._free_ticks % REHEARSAL_TICKS == 0:
                self._rehearse(*self._again)
        self._respond(law, memory)


@njit(cache=True, error_model="numpy")
def plan(
    law_array: Records, memory_array: Records, reference: Records, fixed: Any, tried: Any, vectors: Any, solver: Any
) -> int:
    """The plan without limits, which is adopted if it keeps them, else that of the problem of this tick if there is a
    solution: ``predictive.FREE`` or ``LIMITED``, or ``NO_PLAN`` with an open loop or where the links do not reach.
    """
    law, memory = law_array[0], memory_array[0]
    rows, error, planned = tried
    n = len(planned)
    if LOOP_CLOSED[memory["mode"]] == 0:
        planned[:] = 0.0
        return predictive.NO_PLAN
    tick, state = law["tick"], memory["tick"]
    for k in range(n + 2):
        reference_row(law, memory, reference, tick["delay_periods"] + k, rows[k])
    predictive.deviation(tick, state, rows, error)
    each, both = np.empty((8, n, 3)), np.empty((2, n + 1, 6))  # at once: each piece of memory takes its time
    jump, nu, comb, stroke, low, high, about = each[0], each[1], each[2], each[3], each[4], each[5], each[6]
    scratch = predictive.scratch()
    e = both[0]
    jumps = predictive.jumps(tick["feedback"]["period_s"], rows[: n + 1], jump)
    disturbance, count = state["estimate"]["ahead"][6:9], state["count"][0]
    predictive.stroke_limits(tick, rows, low, high)
    predictive.free_plan(tick, error, jump, jumps, e, nu)
    if predictive.keeps_limits(tick, rows, e, nu, disturbance, count, low, high, comb, stroke, scratch):
        planned[:] = nu
        _hand_over(tick, state, rows, comb[0], 0)
        return predictive.FREE
    for k in range(n - 1):
        planned[k] = planned[k + 1]
    planned[n - 1] = 0.0
    predictive.predict(tick, error, jump, planned, e)
    if not predictive.forces_and_strokes(tick, rows, e, planned, disturbance, comb, stroke, scratch):
        planned[:] = 0.0
        return predictive.NO_PLAN
    (q, lower, upper, v), (between, work) = vectors, solver
    each[7] = 0.0
    predictive.predict(tick, error, jump, each[7], both[1])
    _pose(tick, count, comb, stroke, low, high, e, planned, fixed, q, lower, upper, about, both[1], scratch)
    rounds = active_set.solve(between, work, q, lower, upper, tick["predictive"]["iterations_max"], v)
    if rounds > 0:
        _adopt(tick, state, fixed[0], rows, error, v, planned, rounds, scratch)
    else:
        state["solver_iterations"] = rounds
    return predictive.LIMITED


@njit(cache=True, error_model="numpy")
def _pose(
    law: np.void, count: Array, comb: Array, stroke: Array, low: Array, high: Array, e: Array, nu: Array, fixed: Any,
    q: Array, lower: Array, upper: Array, about: Array, own: Array, scratch: predictive.Scratch,
) -> None:  # fmt: skip
    """Vectors of the problem about a plan nu (n,3) that leads to e (n+1, 6) and takes comb forces (n,3); without one
    it is ``own`` (n+1, 6), which becomes what v adds. ``about`` (n,3): the comb forces less v.
    """
    pulls0, inverse0, jacobian0, scale = fixed
    n = len(nu)
    v, added = scratch[2], scratch[3]
    predictive.slope(law, pulls0, own, q)
    for i in range(3 * n):
        q[i] *= scale
    for k in range(n):
        multiply3_transposed(inverse0, nu[k], v)
        for i in range(3):
            about[k, i] = comb[k, i] - v[i]
            own[k + 1, i] = e[k + 1, i] - own[k + 1, i]
        multiply3(jacobian0, own[k + 1, 0:3], added)
        for i in range(3):
            at = 6 * n - 3 + 3 * k + i
            lower[at] = (low[k, i] - stroke[k, i] + added[i]) / STROKE_UNIT_M
            upper[at] = (high[k, i] - stroke[k, i] + added[i]) / STROKE_UNIT_M
    predictive.comb_bounds(law["drive"], count, about, lower, upper)
    predictive.slew_bounds(law["drive"], about, comb, lower[3 * n :], upper[3 * n :])
    for i in range(6 * n - 3):
        lower[i] /= FORCE_UNIT_N
        upper[i] /= FORCE_UNIT_N


@njit(cache=True, error_model="numpy")
def _adopt(
    tick: np.void, state: np.void, pulls0: Array, rows: Array, error: Array, v: Array, planned: Array, rounds: int,
    scratch: predictive.Scratch,
) -> None:  # fmt: skip
    """Make a solution v (3n,) this tick's plan."""
    part, comb = scratch[2], np.empty(3)
    for k in range(len(planned)):
        for i in range(3):
            part[i] = v[3 * k + i] * FORCE_UNIT_N
        multiply3_transposed(pulls0, part, planned[k])
    disturbance = state["estimate"]["ahead"][6:9]
    predictive.comb_forces(tick, rows[0], rows[1], error, planned[0], disturbance, comb, scratch)
    _hand_over(tick, state, rows, comb, rounds)


@njit(cache=True, error_model="numpy")
def _hand_over(law: np.void, state: np.void, rows: Array, comb_n: Array, iterations: int) -> None:
    """Give the law what comb forces (3,) add to its feed-forward at the platform."""
    row, ahead_n, at_row = np.empty(9), np.empty(3), np.empty((3, 3))
    feedback.ahead(law["feedback"], rows[0], rows[1], row)
    feedforward(law, row, ahead_n)
    pulls(law["geometry"], row[0:3], at_row)
    multiply3_transposed(at_row, comb_n, state["plan_n"])
    for i in range(3):
        state["plan_n"][i] -= ahead_n[i]
    state["plan_known"] = 1
    state["solver_iterations"] = iterations
