"""What a tick of the predictive law takes where it solves a problem, and its solver beside OSQP."""

import time
from typing import Any

import numpy as np
import osqp
import scipy.sparse
from numpy.typing import NDArray

from hil.bench.rigs.motions import setup_of
from hil.lanes.fast import run_block_in_steps
from pkxyz_ctrl.loop import active_set
from pkxyz_ctrl.loop.cycle import new_memory
from pkxyz_ctrl.loop.predictive_cycle import PredictiveCycle
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.trajectory import Steps

LOW_M, WAY_M = 4e-6, 31e-6
"""The full range: a jump from 4 to 35 um of height, most strokes but the last um."""
TOLERANCE = 1e-4
"""OSQP's, relative and absolute: ours has none."""

Array = NDArray[np.float64]
Posed = tuple[Array, Array, Array]


def mpc_ticks_us(repeats: int) -> tuple[Array, Array, list[Posed], PredictiveCycle]:
    """Time in us of all ticks of the far jump, called as the fast lane calls them, and of those that solve, the least
    of several runs; their problems; who posed them.
    """
    jump = Steps(kind="steps", by_m=(0.0, 0.0, WAY_M), count=1, dwell_s=0.04)
    setup, _ = setup_of([jump], "mpc", "nominal", LOW_M)
    reference = reference_rows(setup.trajectory.sample(0, setup.ticks + 25, setup.bus.period_us))
    at_us = setup.bus.period_us * np.arange(setup.ticks, dtype=np.int64)
    best, rows = np.full(setup.ticks, np.inf), np.zeros(setup.ticks, ROW)
    posed: list[Posed] = []
    for _ in range(repeats):
        cycle, plant, memory = PredictiveCycle(setup.law), setup.new_plant(), new_memory(Mode.IDLE)
        taken: list[float] = []
        posed.clear()

        def timed(*arguments: Any, cycle: PredictiveCycle = cycle, taken: list[float] = taken) -> None:
            begin_s = time.perf_counter()
            cycle(*arguments)
            taken.append(time.perf_counter() - begin_s)
            if arguments[1]["row"]["solver_iterations"][0] != 0:
                q, lower, upper, _ = cycle.vectors
                posed.append((q.copy(), lower.copy(), upper.copy()))

        run_block_in_steps(timed, setup.law, memory, reference, plant.params, plant.state, at_us, rows, setup.ticks)
        best = np.minimum(best, np.array(taken) * 1e6)
    return best, best[rows["solver_iterations"] != 0], posed, cycle


def solver_us(cycle: PredictiveCycle, posed: list[Posed], repeats: int) -> Array:
    """Time of each problem in the law's own solver."""
    hessian, rows = cycle.problem.matrices()
    between, work, v = active_set.between(hessian, rows), active_set.work(*rows.shape[::-1]), np.empty(len(posed[0][0]))
    return _least_us(lambda one: active_set.solve(between, work, *one, 100, v), posed, repeats)


def osqp_us(cycle: PredictiveCycle, posed: list[Posed], repeats: int) -> Array:
    """Time of each in OSQP below its Python layer, started from the one before, with the step that needs the fewest
    iterations here.
    """
    hessian, rows = cycle.problem.matrices()
    outer = osqp.OSQP()
    outer.setup(
        scipy.sparse.csc_matrix(np.triu(hessian)), np.zeros(len(hessian)), scipy.sparse.csc_matrix(rows),
        posed[0][1], posed[0][2], rho=0.3, adaptive_rho=False, check_termination=5, eps_abs=TOLERANCE,
        eps_rel=TOLERANCE, polishing=False, warm_starting=True, verbose=False,
    )  # fmt: skip
    solver = outer._solver

    def one_more(one: Posed) -> None:
        q, lower, upper = one
        solver.update_data_vec(q=np.append(q, 0.0), l=lower, u=upper)
        solver.solve()

    return _least_us(one_more, posed, repeats)


def _least_us(solve: Any, posed: list[Posed], repeats: int) -> Array:
    best = np.full(len(posed), np.inf)
    for _ in range(repeats):
        for k, one in enumerate(posed):
            begin_s = time.perf_counter()
            solve(one)
            best[k] = min(best[k], time.perf_counter() - begin_s)
    return best * 1e6
