"""Quadratic programs solved exactly: against their optimality conditions, scipy, and limits that exclude each other."""

import numpy as np
import pytest
import scipy.optimize
from hypothesis import given
from hypothesis import strategies as st

from pkxyz_ctrl.loop import active_set

seeds = st.integers(0, 2**32 - 1)


def problem(seed, n=6, more=8, tight=1.0):
    """H, A whose first n rows are the unknowns, q, and limits between which a point fits."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(n, n))
    rows = np.vstack([np.eye(n), random.normal(size=(more, n))])
    inside = rows @ random.normal(size=n)
    lower, upper = inside - tight * random.random(n + more), inside + tight * random.random(n + more)
    return root @ root.T + np.eye(n), rows, 10.0 * random.normal(size=n), lower, upper


def posed(hessian, rows, q, lower, upper):
    """Records (1,) of the program and of the work, which begins with no limit held."""
    work, m = np.zeros(1, active_set.WORK), len(rows)
    unknowns = np.zeros(len(hessian))
    unknowns[: len(q)] = q
    work["free"][0, :m], work["lower"][0, :m], work["upper"][0, :m] = (
        -rows @ np.linalg.solve(hessian, unknowns),
        lower,
        upper,
    )
    return active_set.program(hessian, rows), work


def solved(hessian, rows, q, lower, upper, rounds_max=1000, sweeps=None):
    """Rounds and the solution; NaN without one."""
    program, work = posed(hessian, rows, q, lower, upper)
    if sweeps is not None:
        program["sweeps"] = sweeps
    rounds = active_set.solve(program[0], work[0], rounds_max)
    assert rounds > 0 or work["count"][0] == 0
    return rounds, work["value"][0, : len(q)] if rounds > 0 else np.full(len(q), np.nan)


def forces_of_limits(hessian, rows, q, lower, upper, v):
    """The residual of stationarity with whatever multipliers fit best, of the right sign, at limits that are met."""
    at = [row for row, value, low in zip(rows, rows @ v, lower, strict=True) if value - low < 1e-7]
    at += [-row for row, value, high in zip(rows, rows @ v, upper, strict=True) if high - value < 1e-7]
    slope = hessian @ v + q
    return scipy.optimize.nnls(np.array(at).T, slope)[1] if at else np.linalg.norm(slope)


sweeps = st.sampled_from([0, 1, 2, 6])
"""Rounds in which many limits change at once; 0: one by one from the beginning."""


@given(seeds, st.sampled_from([0.05, 1.0, 20.0]), sweeps)
def test_no_point_between_the_limits_is_better(seed, tight, sweeps):
    """Kuhn and Tucker's conditions, which are sufficient where the problem is convex."""
    hessian, rows, q, lower, upper = problem(seed, tight=tight)
    rounds, v = solved(hessian, rows, q, lower, upper, sweeps=sweeps)
    assert rounds > 0
    assert (rows @ v >= lower - 2e-9).all()
    assert (rows @ v <= upper + 2e-9).all()
    assert forces_of_limits(hessian, rows, q, lower, upper, v) < 1e-7 * (1.0 + np.abs(q).max())


@given(seeds, sweeps, st.integers(0, 9))
def test_whatever_is_guessed_to_hold_the_solution_is_the_same(seed, sweeps, guessed):
    """Limits that hold or not, at either side, some of them twice; and their order is no matter."""
    random = np.random.default_rng(seed)
    program, work = posed(*problem(seed, tight=random.choice([0.05, 1.0])))
    program["sweeps"] = sweeps
    anew, m = work.copy(), int(program["limits"][0])
    active_set.solve(program[0], anew[0], 1000)
    work["count"] = guessed
    for k in range(guessed):
        work["held"][0, k], work["side"][0, k] = random.integers(m), random.choice([-1.0, 1.0])
    turned = work.copy()
    for name in ("held", "side"):
        turned[name][0, :guessed] = work[name][0, :guessed][::-1]
    for begun in (work, turned):
        assert active_set.solve(program[0], begun[0], 1000) > 0
        assert begun["value"][0, :m] == pytest.approx(anew["value"][0, :m], rel=0, abs=1e-8)
        found, wanted = (set(one["held"][0, : one["count"][0]].tolist()) for one in (begun, anew))
        assert found == wanted


def test_where_no_limit_is_met_it_is_a_linear_system_and_one_round():
    hessian, rows, q, lower, upper = problem(3)
    rounds, v = solved(hessian, rows, q, lower - 1e6, upper + 1e6)
    assert rounds == 1
    assert v == pytest.approx(np.linalg.solve(hessian, -q), rel=1e-10)


@given(seeds, sweeps)
def test_limits_that_exclude_each_other_are_told(seed, sweeps):
    """A row twice, once held above what the other allows."""
    hessian, rows, q, lower, upper = problem(seed)
    rows = np.vstack([rows, rows[-1]])
    lower, upper = np.append(lower, upper[-1] + 0.1), np.append(upper, upper[-1] + 0.2)
    rounds, v = solved(hessian, rows, q, lower, upper, sweeps=sweeps)
    assert rounds == active_set.IMPOSSIBLE
    assert np.isnan(v).all()


@given(seeds, sweeps)
def test_rows_that_depend_on_each_other_are_no_trouble(seed, sweeps):
    """Each limit three times, and the sum of two: what is held must stay independent."""
    hessian, rows, q, lower, upper = problem(seed, n=4, more=3, tight=0.2)
    rounds, v = solved(
        hessian, np.vstack([rows, rows, rows, rows[0] + rows[1]]), q,
        np.concatenate([lower, lower, lower, [lower[0] + lower[1]]]),
        np.concatenate([upper, upper, upper, [upper[0] + upper[1]]]), sweeps=sweeps,
    )  # fmt: skip
    assert rounds > 0
    assert v == pytest.approx(solved(hessian, rows, q, lower, upper)[1], abs=1e-8)


def test_an_unknown_without_a_slope_needs_no_row():
    """A slack: it costs, limits lean on it, and it is not asked for."""
    hessian = np.diag([1.0, 1.0, 100.0])
    rows = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, -1.0]])
    low, high = np.array([-9.0, -9.0, -9.0]), np.array([9.0, 9.0, 1.0])
    rounds, v = solved(hessian, rows, np.array([-1.0, -2.0]), low, high)
    full = scipy.optimize.minimize(
        lambda x: x @ hessian @ x / 2 - x[0] - 2 * x[1], np.zeros(3), method="SLSQP", options={"ftol": 1e-14},
        constraints={"type": "ineq", "fun": lambda x: 1.0 - rows[2] @ x},
    )  # fmt: skip
    assert rounds == 2
    assert v == pytest.approx(full.x[:2], abs=1e-6)


@pytest.mark.parametrize(("sweeps", "least"), [(0, 4), (1, 3), (6, 2)])
def test_it_stops_where_it_may_go_no_further(sweeps, least):
    needs, _ = solved(*problem(5, tight=0.05), sweeps=sweeps)
    assert needs >= least
    for rounds_max in range(needs):
        stopped, v = solved(*problem(5, tight=0.05), rounds_max=rounds_max, sweeps=sweeps)
        assert stopped == active_set.TOO_LONG
        assert np.isnan(v).all()
    assert solved(*problem(5, tight=0.05), rounds_max=needs, sweeps=sweeps)[0] == needs


def test_what_was_solved_before_leaves_nothing_behind_but_what_held():
    program, work = posed(*problem(7, tight=0.1))
    _, other = posed(*problem(8, tight=0.1))
    first, again = work.copy(), work.copy()
    active_set.solve(program[0], first[0], 100)
    for name in ("free", "lower", "upper"):
        again[name] = other[name]
    active_set.solve(program[0], again[0], 100)
    for name in ("free", "lower", "upper", "count"):
        again[name] = work[name]
    active_set.solve(program[0], again[0], 100)
    assert (first["value"] == again["value"]).all()


def test_as_many_as_there_may_be_fit():
    """The longest horizon: 61 unknowns, 177 limits, all unknowns held."""
    hessian, rows, q, lower, upper = problem(1, 61, 116, 1e-3)
    program, work = posed(hessian, rows, q, lower, upper)
    assert active_set.solve(program[0], work[0], 1000) > 0
    assert 55 < work["count"][0] <= program["held_most"][0] <= active_set.HELD_MOST
