"""What a tick of the predictive law takes where it solves a problem, and its solver beside OSQP."""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import osqp
import scipy.sparse
from numpy.typing import NDArray

from hil.bench.rigs.motions import setup_of
from hil.lanes.fast import run_block_in_steps
from pkxyz_ctrl.compiled.direct_call import direct
from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.loop import active_set
from pkxyz_ctrl.loop.cycle import new_memory
from pkxyz_ctrl.loop.predictive_cycle import PredictiveCycle, hold_a_period_on
from pkxyz_ctrl.loop.predictive_problem import Problem
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.trajectory import Steps

LOW_M, WAY_M = 4e-6, 31e-6
"""The full range: a jump from 4 to 35 um of height, most strokes but the last um."""
TOLERANCE = 1e-4
"""OSQP's, relative and absolute: ours has none."""

Array = NDArray[np.float64]
Records = NDArray[np.void]


class Posed(NamedTuple):
    """Problems of a law: its own records of them, (1,) of ``active_set.WORK`` each, as its solver begins."""

    problem: Problem
    works: list[Records]


def mpc_ticks_us(repeats: int) -> tuple[Array, Array, Posed]:
    """Time in us of all ticks of the far jump, called as the fast lane calls them, and of those that solve, the least
    of several runs; their problems.
    """
    jump = Steps(kind="steps", by_m=(0.0, 0.0, WAY_M), count=1, dwell_s=0.04)
    setup, _ = setup_of([jump], "mpc", "nominal", LOW_M)
    reference = reference_rows(setup.trajectory.sample(0, setup.ticks + 25, setup.bus.period_us))
    at_us = setup.bus.period_us * np.arange(setup.ticks, dtype=np.int64)
    best, rows = np.full(setup.ticks, np.inf), np.zeros(setup.ticks, ROW)
    posed = Posed(Problem(setup.law), [])
    for _ in range(repeats):
        cycle, plant, memory = PredictiveCycle(setup.law), setup.new_plant(), new_memory(Mode.IDLE)
        taken: list[float] = []
        posed.works.clear()

        def timed(*arguments: Any, cycle: PredictiveCycle = cycle, taken: list[float] = taken) -> None:
            work = cycle.planner["work"]
            guess = {name: work[name].copy() for name in ("held", "side", "count")}
            begin_s = time.perf_counter()
            cycle(*arguments)
            taken.append(time.perf_counter() - begin_s)
            if arguments[1]["row"]["solver_iterations"][0] != 0:
                one = work.copy()
                for name, value in guess.items():
                    one[name] = value
                hold_a_period_on(one[0], posed.problem.horizon)
                posed.works.append(one)

        run_block_in_steps(timed, setup.law, memory, reference, plant.params, plant.state, at_us, rows, setup.ticks)
        best = np.minimum(best, np.array(taken) * 1e6)
    return best, best[rows["solver_iterations"] != 0], posed


def solver_us(posed: Posed, repeats: int) -> Array:
    """Time of each problem in the law's own solver, from the limits that held the plan before."""
    program, work = active_set.program(*posed.problem.matrices()), np.zeros(1, active_set.WORK)
    solve = direct(_solve, program, work)

    def again(one: Records) -> float:
        work[:] = one
        begin_s = time.perf_counter()
        solve(program, work)
        return time.perf_counter() - begin_s

    return _least_us(again, posed.works, repeats)


@kernel
def _solve(program: Records, work: Records) -> None:
    active_set.solve(program[0], work[0], 100)


def osqp_us(posed: Posed, repeats: int) -> Array:
    """Time of each in OSQP below its Python layer, started from the one before, with the step that needs the fewest
    iterations here.
    """
    vectors = [posed.problem.vectors(work) for work in posed.works]
    hessian, rows = posed.problem.matrices()
    outer = osqp.OSQP()
    outer.setup(
        scipy.sparse.csc_matrix(np.triu(hessian)), np.zeros(len(hessian)), scipy.sparse.csc_matrix(rows),
        vectors[0][1], vectors[0][2], rho=0.3, adaptive_rho=False, check_termination=5, eps_abs=TOLERANCE,
        eps_rel=TOLERANCE, polishing=False, warm_starting=True, verbose=False,
    )  # fmt: skip
    solver = outer._solver

    def one_more(one: tuple[Array, Array, Array]) -> float:
        q, lower, upper = one
        begin_s = time.perf_counter()
        solver.update_data_vec(q=q, l=lower, u=upper)
        solver.solve()
        return time.perf_counter() - begin_s

    return _least_us(one_more, vectors, repeats)


def _least_us(solve: Callable[[Any], float], posed: Sequence[Any], repeats: int) -> Array:
    best = np.full(len(posed), np.inf)
    for _ in range(repeats):
        for k, one in enumerate(posed):
            best[k] = min(best[k], solve(one))
    return best * 1e6
