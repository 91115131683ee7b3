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


def solved(hessian, rows, q, lower, upper, rounds_max=1000):
    m, n = rows.shape
    v = np.full(len(q), np.nan)
    work = active_set.work(n, m)
    return active_set.solve(active_set.between(hessian, rows), work, q, lower, upper, rounds_max, v), v


def forces_of_limits(hessian, rows, q, lower, upper, v):
    """The residual of stationarity with whatever multipliers fit best, of the right sign, at limits that are met."""
    at = [row for row, value, low in zip(rows, rows @ v, lower, strict=True) if value - low < 1e-7]
    at += [-row for row, value, high in zip(rows, rows @ v, upper, strict=True) if high - value < 1e-7]
    slope = hessian @ v + q
    return scipy.optimize.nnls(np.array(at).T, slope)[1] if at else np.linalg.norm(slope)


@given(seeds, st.sampled_from([0.05, 1.0, 20.0]))
def test_no_point_between_the_limits_is_better(seed, tight):
    """Kuhn and Tucker's conditions, which are sufficient where the problem is convex."""
    hessian, rows, q, lower, upper = problem(seed, tight=tight)
    rounds, v = solved(hessian, rows, q, lower, upper)
    assert rounds > 0
    assert (rows @ v >= lower - 2e-9).all()
    assert (rows @ v <= upper + 2e-9).all()
    assert forces_of_limits(hessian, rows, q, lower, upper, v) < 1e-7 * (1.0 + np.abs(q).max())


def test_where_no_limit_is_met_it_is_a_linear_system_and_one_round():
    hessian, rows, q, lower, upper = problem(3)
    rounds, v = solved(hessian, rows, q, lower - 1e6, upper + 1e6)
    assert rounds == 1
    assert v == pytest.approx(np.linalg.solve(hessian, -q), rel=1e-10)


@given(seeds)
def test_limits_that_exclude_each_other_are_told(seed):
    """A row twice, once held above what the other allows."""
    hessian, rows, q, lower, upper = problem(seed)
    rows = np.vstack([rows, rows[-1]])
    lower, upper = np.append(lower, upper[-1] + 0.1), np.append(upper, upper[-1] + 0.2)
    rounds, v = solved(hessian, rows, q, lower, upper)
    assert rounds == active_set.IMPOSSIBLE
    assert np.isnan(v).all()


@given(seeds)
def test_rows_that_depend_on_each_other_are_no_trouble(seed):
    """Each limit three times, and the sum of two: what is held must stay independent."""
    hessian, rows, q, lower, upper = problem(seed, n=4, more=3, tight=0.2)
    rounds, v = solved(
        hessian, np.vstack([rows, rows, rows, rows[0] + rows[1]]), q,
        np.concatenate([lower, lower, lower, [lower[0] + lower[1]]]),
        np.concatenate([upper, upper, upper, [upper[0] + upper[1]]]),
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


@pytest.mark.parametrize("rounds_max", [0, 1, 2])
def test_it_stops_where_it_may_go_no_further(rounds_max):
    needs, _ = solved(*problem(5, tight=0.05))
    assert needs > 3
    stopped, v = solved(*problem(5, tight=0.05), rounds_max=rounds_max)
    assert stopped == active_set.TOO_LONG
    assert np.isnan(v).all()
    assert solved(*problem(5, tight=0.05), rounds_max=needs)[0] == needs
    assert solved(*problem(5, tight=0.05), rounds_max=needs - 1)[0] == active_set.TOO_LONG


def test_what_was_solved_before_leaves_nothing_behind():
    hessian, rows, q, lower, upper = problem(7, tight=0.1)
    m, n = rows.shape
    work, of, first, again = active_set.work(n, m), active_set.between(hessian, rows), np.empty(n), np.empty(n)
    active_set.solve(of, work, q, lower, upper, 100, first)
    active_set.solve(of, work, -3.0 * q, lower, upper, 100, again)
    active_set.solve(of, work, q, lower, upper, 100, again)
    assert (first == again).all()
