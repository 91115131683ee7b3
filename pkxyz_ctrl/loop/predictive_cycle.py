"""One period of the controller with the predictive law: the cycle, with a plan made between its two parts; compiled.

The plan without limits is a matter of a recursion and mostly keeps all limits; then it is the solution. Where it does
not, the problem is solved exactly, in a bounded number of rounds, from the limits that held the last plan. Where that
doesn't come to an end the regulator's clipped answer stands, and the record says so.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.direct_call import direct
from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.core import predictive
from pkxyz_ctrl.core.linear3 import multiply3, multiply3_transposed
from pkxyz_ctrl.core.predictive import FORCE_UNIT_N, STROKE_UNIT_M
from pkxyz_ctrl.loop import active_set
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.predictive_problem import Problem
from pkxyz_ctrl.loop.reference import standing_still
from pkxyz_ctrl.loop.set_points import reference_row
from pkxyz_ctrl.safety.modes import LOOP_CLOSED

Array = NDArray[np.float64]
Records = NDArray[np.void]

PLANNER = np.dtype(
    [
        ("plan", predictive.PLAN),
        ("free_ticks", "i4"),  # whose plan without limits kept them
        ("work", active_set.WORK),  # last, as a short horizon needs little of it
    ],
    align=True,
)
"""What a planner remembers, and works with."""

_REHEARSED: Final = 6
_REHEARSAL_ROUNDS: Final = 3


class PredictiveCycle:
    """Stands in for ``cycle.cycle``, with the same arguments; remembers the last plan. One for each controller.
    ``problem`` (1,) of ``predictive_problem.PROBLEM``, ``planner`` (1,) of ``PLANNER``.
    """

    def __init__(self, law: Records) -> None:
        self.problem, self.planner = Problem(law).record(), np.zeros(1, PLANNER)
        self._cycle = direct(cycle, law, cycling.new_memory(), standing_still(), self.problem, self.planner)

    def __call__(self, law: Records, memory: Records, reference: Records) -> None:
        """One period."""
        self._cycle(law, memory, reference, self.problem, self.planner)


@kernel
def cycle(law: Records, memory: Records, reference: Records, problem: Records, planner: Records) -> None:
    """One period: ``cycle.cycle`` with a plan."""
    cycling.observe(law, memory, reference)
    plan(law, memory, reference, problem, planner)
    cycling.respond(law, memory)


@kernel
def plan(
    law_array: Records, memory_array: Records, reference: Records, problem_array: Records, planner_array: Records
) -> int:
    """The plan without limits, which is adopted if it keeps them, else that of the problem of this tick if there is a
    solution: ``predictive.FREE`` or ``LIMITED``, or ``NO_PLAN`` with an open loop or where the links do not reach.
    """
    law, memory, problem, planner = law_array[0], memory_array[0], problem_array[0], planner_array[0]
    numbers, state, made, work = law["tick"], memory["tick"], planner["plan"], planner["work"]
    n, planned, jump, error = numbers["predictive"]["horizon"], made["planned_n"], made["jump_m"], made["error"]
    free, nu, count = made["free"], made["free_n"], state["count"][0]
    if LOOP_CLOSED[memory["mode"]] == 0:
        _forget(planner)
        return predictive.NO_PLAN
    for k in range(n + 2):
        reference_row(law, memory, reference, numbers["delay_periods"] + k, made["rows"][k])
    predictive.look_ahead(numbers, state, made)
    predictive.deviation(numbers, state, made)
    jumps = predictive.jumps(numbers["feedback"]["period_s"], made["rows"], n, jump)
    predictive.free_plan(numbers, error, jump, jumps, free, nu, made["scratch"])
    if predictive.keeps_limits(numbers, made, free, nu, count):
        _hand_over(state, made, 0)
        planner["free_ticks"] += 1
        if planner["free_ticks"] >= problem["rehearsal_ticks"]:
            planner["free_ticks"] = 0
            _solve(numbers, planner, problem, count, True)
        work["count"] = 0
        for k in range(n):
            for i in range(3):
                planned[k, i] = nu[k, i]
        return predictive.FREE
    rounds = _solve(numbers, planner, problem, count, False)
    if rounds == 0:
        _forget(planner)
        return predictive.NO_PLAN
    state["solver_iterations"] = rounds
    if rounds > 0:
        _adopt(numbers, state, planner, problem["pulls"], rounds)
    return predictive.LIMITED


@kernel
def _forget(planner: np.void) -> None:
    """There is no last plan."""
    planner["work"]["count"] = 0
    planned = planner["plan"]["planned_n"]
    for k in range(predictive.HORIZON_MOST):
        for i in range(3):
            planned[k, i] = 0.0


@kernel
def _solve(law: np.void, planner: np.void, problem: np.void, count: Array, rehearses: bool) -> int:
    """Pose the problem about the last plan, a period on, and solve it; returns the solver's rounds, 0 where the links
    do not reach. It ``rehearses`` with some limits passed.
    """
    made, work, n = planner["plan"], planner["work"], law["predictive"]["horizon"]
    planned, along, free, lower, upper = made["planned_n"], made["along"], work["free"], work["lower"], work["upper"]
    for k in range(n):
        for i in range(3):
            planned[k, i] = planned[k + 1, i] if k < n - 1 else 0.0
    predictive.predict(law, made["error"], made["jump_m"], planned, along)
    if not predictive.forces_and_strokes(law, made, along, planned):
        return 0
    hold_a_period_on(work, n)
    _pose(made, problem, n, work)
    predictive.comb_bounds(law["drive"], n, count, made["about_n"], lower, upper)
    predictive.slew_bounds(law["drive"], n, made["about_n"], made["comb_n"], lower, upper)
    if rehearses:
        for k in range(0, _REHEARSED * 3, 3):
            free[k] = upper[k] + 1.0
    rounds_max = _REHEARSAL_ROUNDS if rehearses else law["predictive"]["iterations_max"]
    rounds: int = active_set.solve(problem["program"], work, rounds_max)
    return rounds


@kernel
def _pose(made: np.void, problem: np.void, n: int, work: np.void) -> None:
    """What the plan without limits would be in the problem, the limits of strokes, and ``about_n``."""
    inverse0, jacobian0, comb, about = problem["inverse"], problem["jacobian"], made["comb_n"], made["about_n"]
    v, more, free, lower, upper = (
        made["scratch"]["off"],
        made["scratch"]["force"],
        work["free"],
        work["lower"],
        work["upper"],
    )
    for k in range(n):
        multiply3_transposed(inverse0, made["planned_n"][k], v)
        for i in range(3):
            about[k, i] = comb[k, i] - v[i]
            more[i] = made["free"][k + 1, i] - made["along"][k + 1, i]
        multiply3_transposed(inverse0, made["free_n"][k], v)
        at, slew, stroke = 3 * k, 3 * n + 3 * k - 3, 6 * n - 3 + 3 * k
        for i in range(3):
            free[at + i] = v[i] / FORCE_UNIT_N
            if k > 0:
                free[slew + i] = free[at + i] - free[at - 3 + i]
        multiply3(jacobian0, more, v)
        for i in range(3):
            free[stroke + i] = v[i] / STROKE_UNIT_M
            lower[stroke + i] = (made["stroke_min_m"][k, i] - made["stroke_m"][k, i]) / STROKE_UNIT_M
            upper[stroke + i] = (made["stroke_max_m"][k, i] - made["stroke_m"][k, i]) / STROKE_UNIT_M


@kernel
def hold_a_period_on(work: np.void, n: int) -> None:
    """What held the last plan is taken to hold this one, each limit an interval sooner; what was the first slew within
    the plan is one after the last counts.
    """
    held, side, count = work["held"], work["side"], 0
    slews, strokes = 3 * n, 6 * n - 3
    for k in range(work["count"]):
        limit = held[k]
        if slews <= limit < slews + 3:
            limit -= slews
        elif 3 <= limit < slews or slews + 3 <= limit < strokes or strokes + 3 <= limit:
            limit -= 3
        else:
            continue
        held[count], side[count] = limit, side[k]
        count += 1
    work["count"] = count


@kernel
def _adopt(law: np.void, state: np.void, planner: np.void, pulls0: Array, rounds: int) -> None:
    """Make the solution this tick's plan."""
    made, value = planner["plan"], planner["work"]["value"]
    part, end, planned = made["scratch"]["off"], made["scratch"]["end"], made["planned_n"]
    for k in range(law["predictive"]["horizon"]):
        for i in range(3):
            part[i] = value[3 * k + i] * FORCE_UNIT_N
        multiply3_transposed(pulls0, part, planned[k])
    predictive.step(law["estimator"], made["error"], planned[0], made["jump_m"][0], end)
    predictive.comb_forces(law, made, 0, made["error"], end, planned[0])
    _hand_over(state, made, rounds)


@kernel
def _hand_over(state: np.void, made: np.void, iterations: int) -> None:
    """Give the law what comb forces in the first interval add to its feed-forward at the platform."""
    multiply3_transposed(made["first_pulls"], made["comb_n"][0], state["plan_n"])
    for i in range(3):
        state["plan_n"][i] -= made["first_n"][i]
    state["plan_known"] = 1
    state["solver_iterations"] = iterations
