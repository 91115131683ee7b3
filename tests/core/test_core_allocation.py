"""Allocation of comb forces: optimality conditions computed anew, all 27 active sets, and OSQP as an oracle."""

import itertools

import numpy as np
import osqp
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_rig import stage
from scipy import sparse

from pkxyz_ctrl.core import allocation
from pkxyz_ctrl.core.allocation import SCRATCH, allocate

FORCE_MAX_N = float(stage().force_max_n[0])
WORKSPACE = st.tuples(*[st.floats(-3e-6, 27e-6)] * 3).map(np.array)  # strokes, a little beyond the device's
SETS = ["".join(s) for s in itertools.product("fLU", repeat=3)]  # free, at the lower bound, at the upper one
SIZES = st.sampled_from([1e-9, 1e-6, 1e-4, 3e-3, 1e-2, 1.0])


def jacobian_at(strokes_m):
    return stage().jacobian(stage().forward_kinematics(strokes_m))


def solve(jacobian, demand_n, lower_n, upper_n):
    force = np.full(3, np.nan)
    room = np.zeros(1, SCRATCH)[0]
    tries = allocate(jacobian, np.linalg.inv(jacobian), demand_n, lower_n, upper_n, force, room)
    return force, tries


def residual_n(jacobian, demand_n, lower_n, upper_n, force_n):
    """How far a feasible force would still move along the gradient before the bounds stop it: 0 only at the optimum."""
    gradient = jacobian @ (jacobian.T @ force_n - demand_n)
    largest = np.linalg.eigvalsh(jacobian @ jacobian.T)[-1]
    return np.abs(force_n - np.clip(force_n - gradient / largest, lower_n, upper_n)).max()


@st.composite
def bounds(draw):
    """Lower and upper (3,), either of any of them equal, from nothing to far beyond what a comb gives."""
    lower = np.array(draw(st.tuples(*[st.floats(0, FORCE_MAX_N)] * 3)))
    width = np.array(draw(st.tuples(*[st.one_of(st.just(0.0), st.floats(0, 2 * FORCE_MAX_N))] * 3)))
    return lower * draw(st.sampled_from([0.0, 1.0])), lower + width


@settings(max_examples=300)
@given(WORKSPACE, st.tuples(*[st.floats(-1, 1)] * 3), SIZES, bounds())
def test_optimal_feasible_and_in_bounded_tries(strokes_m, direction, size_n, limits):
    jacobian, demand, (lower, upper) = jacobian_at(strokes_m), np.array(direction) * size_n, limits
    force, tries = solve(jacobian, demand, lower, upper)
    assert np.all((lower <= force) & (force <= upper))
    scale = max(np.abs(jacobian @ demand).max(), upper.max(), 1e-12)
    assert residual_n(jacobian, demand, lower, upper, force) <= 1e-12 * scale
    assert 1 <= tries <= 27
    free = np.linalg.solve(jacobian.T, demand)
    clear = 1e-12 * scale
    if np.all((lower + clear < free) & (free < upper - clear)):
        assert tries == 1
    if np.any((free < lower - clear) | (free > upper + clear)):
        assert tries > 1


@settings(max_examples=100)
@given(WORKSPACE, st.tuples(*[st.floats(-1, 1)] * 3), bounds())
def test_asking_for_what_was_given_gives_the_same(strokes_m, direction, limits):
    jacobian, (lower, upper) = jacobian_at(strokes_m), limits
    given_n, _ = solve(jacobian, np.array(direction) * 3e-3, lower, upper)
    again, _ = solve(jacobian, jacobian.T @ given_n, lower, upper)
    assert again == pytest.approx(given_n, rel=0, abs=1e-13 * max(upper.max(), 1e-3))


@pytest.mark.parametrize("state", SETS)
def test_every_active_set_is_found(state):
    """The demand that makes a chosen set optimal, from the conditions themselves: J^T F - J^-1 (multipliers)."""
    rng = np.random.default_rng(SETS.index(state))
    lower, upper = np.full(3, 0.2e-3), np.array([1.0e-3, 1.5e-3, 2.0e-3])
    for _ in range(20):
        jacobian = jacobian_at(rng.uniform(0, 25e-6, 3))
        inner = lower + (upper - lower) * rng.uniform(0.1, 0.9, 3)
        force = np.array(
            [{"f": f, "L": lo, "U": up}[s] for s, f, lo, up in zip(state, inner, lower, upper, strict=True)]
        )
        sign = np.array([{"f": 0, "L": 1, "U": -1}[s] for s in state])
        demand = jacobian.T @ force - np.linalg.solve(jacobian, sign * rng.uniform(0.05e-3, 1e-3, 3))
        found, tries = solve(jacobian, demand, lower, upper)
        assert found == pytest.approx(force, rel=1e-12)
        assert np.array_equal(found[sign == 1], lower[sign == 1])  # at a bound means on it, to the last bit
        assert np.array_equal(found[sign == -1], upper[sign == -1])
        assert tries == 1 + sum("fLU".index(s) * 3**comb for comb, s in enumerate(state))  # in their order


def test_osqp_finds_the_same_forces():
    """In mN, where its tolerances mean something. Fixed rho and no scaling by time: the same iterations every run."""
    rng = np.random.default_rng(20)
    limited = 0
    for _ in range(40):
        jacobian = jacobian_at(rng.uniform(0, 25e-6, 3))
        demand = rng.uniform(-4, 4, 3)
        lower = rng.choice([0.0, 0.3], 3)
        upper = lower + rng.choice([0.0, 0.5, 1.5], 3)
        solver = osqp.OSQP()
        solver.setup(
            sparse.csc_matrix(np.triu(jacobian @ jacobian.T)), -jacobian @ demand, sparse.identity(3, format="csc"),
            lower, upper, verbose=False, eps_abs=1e-12, eps_rel=1e-12, max_iter=100_000, adaptive_rho=False, rho=1.0,
        )  # fmt: skip
        expected = solver.solve(raise_error=True).x
        force, tries = solve(jacobian, demand * 1e-3, lower * 1e-3, upper * 1e-3)
        assert force * 1e3 == pytest.approx(expected, rel=0, abs=1e-9)
        limited += tries > 1
    assert 20 <= limited <= 40


@pytest.mark.parametrize(
    "demand_n", [(np.nan, 0.0, 0.0), (np.inf, 0.0, 0.0), (0.0, -np.inf, 0.0), (np.inf, -np.inf, np.nan)]
)
def test_a_demand_that_is_no_number_ends_within_the_tries(demand_n):
    """What it gives is nobody's business but the voltages', which make 0 V of it; that it comes back at all is ours."""
    _, tries = solve(jacobian_at(np.full(3, 12.5e-6)), np.array(demand_n), np.zeros(3), np.full(3, FORCE_MAX_N))
    assert 2 <= tries <= 27


def test_at_a_bound_is_within_it():
    """At rest, no force is asked for and none is the least there is: no search. Nor where nothing may be given."""
    jacobian = jacobian_at(np.full(3, 12.5e-6))
    for upper in (FORCE_MAX_N, 0.0):
        force, tries = solve(jacobian, np.zeros(3), np.zeros(3), np.full(3, upper))
        assert (force.tolist(), tries) == ([0.0, 0.0, 0.0], 1)


def test_more_force_is_never_nearer():
    """No random feasible force does better, anywhere in the workspace."""
    rng = np.random.default_rng(3)
    for _ in range(100):
        jacobian, demand = jacobian_at(rng.uniform(0, 25e-6, 3)), rng.uniform(-3e-3, 3e-3, 3)
        lower, upper = np.zeros(3), np.full(3, FORCE_MAX_N)
        force, _ = solve(jacobian, demand, lower, upper)
        others = rng.uniform(lower, upper, (200, 3))
        near = np.clip(force + rng.normal(0, 1e-6, (200, 3)), lower, upper)
        cost = np.linalg.norm(np.vstack([others, near]) @ jacobian - demand, axis=1)
        assert np.linalg.norm(jacobian.T @ force - demand) <= cost.min() * (1 + 1e-12)


@pytest.mark.parametrize("power", [-40, -20, 20])
def test_the_unit_of_the_forces_changes_no_bit(power):
    """What counts as rounding goes with the forces themselves."""
    rng, unit = np.random.default_rng(7), 2.0**power
    for _ in range(100):
        jacobian, demand = jacobian_at(rng.uniform(0, 25e-6, 3)), rng.uniform(-3e-3, 3e-3, 3)
        lower = rng.choice([0.0, 0.3e-3], 3)
        upper = lower + rng.choice([0.0, 0.5e-3, 1.5e-3], 3)
        force, tries = solve(jacobian, demand, lower, upper)
        scaled, tries_scaled = solve(jacobian, demand * unit, lower * unit, upper * unit)
        assert scaled.tobytes() == (force * unit).tobytes()
        assert tries_scaled == tries


def test_nobody_changes_the_order_of_the_sets():
    with pytest.raises(ValueError, match="read-only"):
        allocation._SETS[0, 0] = 1
