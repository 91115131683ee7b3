"""The predictive law: the regulator as long as no limit is met, optimal where one is, and what is left if it fails."""

import dataclasses
from functools import cache

import numpy as np
import osqp
import pytest
import scipy.linalg
import scipy.sparse
from loop_rig import bus, controller, first_difference, rows_of, setup, shortened, stage
from typer.testing import CliRunner

from hil.cli import app
from hil.lanes.excitation import excitation, tones
from hil.lanes.fast import run_block, run_block_in_steps
from hil.studies.margins.excited import at_point
from hil.studies.margins.loop import Loop, agreement
from hil.studies.margins.measured import measure
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import ConfigError, load, parse, plain
from pkxyz_ctrl.core import predictive
from pkxyz_ctrl.core.predictive import FORCE_UNIT_N, STROKE_UNIT_M
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.model.loop_plant import held_force_softening
from pkxyz_ctrl.loop import active_set, predictive_cycle, predictive_problem
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.predictive_cycle import PredictiveCycle
from pkxyz_ctrl.loop.predictive_problem import Problem
from pkxyz_ctrl.loop.reference import REFERENCE, reference_rows
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.trips import Trip
from pkxyz_ctrl.trajectory import Hold, Move, Steps, Trajectory

LOW_M, WAY_M = 4e-6, 31e-6
"""A jump over nearly all that can be reached above rest: 4 to 35 um."""


@cache
def mpc():
    return load("controllers", "mpc", ControllerConfig)


@cache
def law():
    return design_law(stage(), mpc(), bus(), autostart=True)


def far_jump(config):
    limits = {"velocity_max_m_per_s": 0.5e-3, "acceleration_max_m_per_s2": 0.05, "jerk_max_m_per_s3": 10.0}
    reference = Trajectory(
        [
            Hold(kind="hold", duration_s=0.02),
            Move(kind="move", to_m=(0.0, 0.0, LOW_M), **limits),
            Hold(kind="hold", duration_s=0.03),
            Steps(kind="steps", by_m=(0.0, 0.0, WAY_M), count=1, dwell_s=0.04),
        ]
    )
    return dataclasses.replace(setup(), controller=config, trajectory=reference, duration_s=0.27)


@cache
def jumped(name):
    return rows_of(far_jump({"mpc": mpc(), "lqg": controller()}[name]), "fast")


def settled_ms(rows, target_m, band_m=10e-9):
    """When the true height enters the band about a target for good, ms after the reference jumped there."""
    at = np.flatnonzero(np.abs(np.diff(rows["reference_m"][:, 2])) > 1e-6) + 1
    (begin,) = [i for i in at if abs(rows["reference_m"][i, 2] - target_m) < 1e-9]
    outside = np.abs(rows["position_m"][begin : begin + 185, 2] - target_m) > band_m
    return (int(np.flatnonzero(outside)[-1]) + 1) * 0.2


def test_cost_to_go_is_the_regulators():
    """P against scipy's Riccati solver, in units in which it can solve."""
    numbers = law()["tick"][0]["predictive"]
    filter_ = law()["tick"][0]["estimator"]
    scale = np.repeat([numbers["position_weight"], numbers["velocity_weight"]], 3) ** -0.5
    phi, gamma = filter_["transition"][:, :6] * scale[None, :] / scale[:, None], filter_["input"] / scale[:, None]
    unit = scipy.linalg.solve_discrete_are(phi, gamma, np.eye(6), np.eye(3))
    assert numbers["cost_to_go"] * np.outer(scale, scale) == pytest.approx(unit, rel=1e-7, abs=1e-7 * unit.max())


def slope(numbers, pulls, e):
    """Half the derivative (3n,) of the cost by v at v = 0, from where that leads: e (n+1, 6). Backwards."""
    weights = np.repeat([numbers["predictive"]["position_weight"], numbers["predictive"]["velocity_weight"]], 3)
    phi, gamma = numbers["estimator"]["transition"][:, :6], numbers["estimator"]["input"]
    adjoint, found = numbers["predictive"]["cost_to_go"] @ e[-1], []
    for at in e[-2::-1]:
        found.append(pulls @ gamma.T @ adjoint)
        adjoint = weights * at + phi.T @ adjoint
    return np.concatenate(found[::-1])


@pytest.mark.parametrize("jumping", [False, True])
def test_the_recursions_solve_the_problem_without_limits(jumping):
    """The plan without limits minimises what the solver is given; slopes and strokes are those of its matrices."""
    problem, numbers, random = Problem(law()), law()["tick"][0], np.random.default_rng(3)
    n = problem.horizon
    error = np.concatenate([random.normal(size=3) * 1e-6, random.normal(size=3) * 1e-3])
    jump = np.zeros((n, 3))
    if jumping:
        jump[[4, 7]] = random.normal(size=(2, 3)) * 1e-5
    e, unforced, nu = np.empty((n + 1, 6)), np.empty((n + 1, 6)), np.empty((n, 3))
    predictive.free_plan(numbers, error, jump, jumping, e, nu, np.zeros(1, predictive.SCRATCH)[0])
    predictive.predict(numbers, error, jump, np.zeros((n, 3)), unforced)
    v = np.linalg.solve(problem.hessian, -problem.slope_scale * slope(numbers, problem.pulls, unforced))
    assert nu == pytest.approx(v.reshape(n, 3) @ problem.pulls * FORCE_UNIT_N, rel=0, abs=1e-12 * np.abs(nu).max())
    added_m = ((e - unforced)[1:, :3] @ problem.jacobian.T).ravel()
    assert problem.stroke @ v * STROKE_UNIT_M == pytest.approx(added_m, rel=0, abs=1e-12 * np.abs(added_m).max())


def test_on_the_default_scan_it_solves_nothing():
    """No limit is near: the plan without limits is the solution, and as accurate as lqg."""
    rows, result = rows_of(dataclasses.replace(shortened(setup(), 2200), controller=mpc()), "fast")
    scan = rows[rows["reference_tick"] > 1000]
    assert len(scan) > 500
    assert not scan["solver_iterations"].any()
    rms_nm = np.sqrt(np.mean((scan["position_m"] - scan["reference_m"]) ** 2, axis=0)) * 1e9
    assert (rms_nm > 0.3).all()
    assert (rms_nm < 2.0).all()
    assert result.faults == ()


def test_one_tick_of_it_asks_for_what_lqg_asks_for():
    """Both laws from the same memory in mid-scan, on the same sample. They differ by what the stiffness under held
    forces makes of the deviation in mid-interval, which lqg leaves out and the plan takes into account.
    """
    run = setup()
    led_by_its_own, tick = run.law.copy(), run.law["tick"]
    for name in ("position_gain_n_per_m", "velocity_gain_n_s_per_m"):
        led_by_its_own["tick"]["set_points"][name] = tick["feedback"][name]
    plant, memory = run.new_plant(), cycling.new_memory(Mode.IDLE)
    reference = reference_rows(run.trajectory.sample(0, run.ticks + 25, 200))
    rows, numbers = np.zeros(2000, ROW), law()["tick"][0]
    filter_, feedback = numbers["estimator"], numbers["feedback"]
    gains = np.hstack([feedback["position_gain_n_per_m"], feedback["velocity_gain_n_s_per_m"]])
    for end in (1500, 1700, 2000):
        at_us = plant.t_us + 200 * np.arange(1, end - int(memory["tick_index"][0]) + 1, dtype=np.int64)
        run_block(led_by_its_own, memory, reference, plant.params, plant.state, at_us, rows, len(at_us))
        demands = []
        for law_array, period in ((led_by_its_own, cycling.cycle), (law(), PredictiveCycle(law()))):
            own = memory.copy()
            period(law_array, own, reference)
            demands.append(own["row"]["demand_n"][0].copy())
        assert own["row"]["trips"][0] == 0
        now, ahead = own["now"][0], own["tick"]["estimate"]["ahead"][0]
        begin = ahead[:6] - now[:6] + np.append(filter_["operating_point_m"], np.zeros(3))
        end_ = filter_["transition"][:, :6] @ begin - filter_["input"] @ (gains @ begin)
        middle_m = 0.5 * (begin + end_)[:3] + 200e-6 / 8 * (begin - end_)[3:]
        felt = stage().stiffness(now[:3]) - held_force_softening(stage(), now[:3], own["row"]["force_n"][0])
        difference = (felt - filter_["stiffness_n_per_m"]) @ middle_m
        assert np.abs(difference).max() > 1e-9
        assert demands[1] - demands[0] == pytest.approx(difference, rel=0, abs=0.05 * np.abs(difference).max())
        assert np.abs(demands[0]).max() > 1e-4


def test_its_margins_are_those_of_the_running_loop():
    """Far from limits it is a linear law: what was computed, measured in the running loop, noise alone between them."""
    added = excitation(
        "multisine", tones(2000, 20, 3), period_ticks=2000, periods=4, amplitude_m=8e-9, first_tick=0, seed=3
    )
    strokes = np.array([7e-6, 15e-6, 11e-6])
    seen = measure(at_point(dataclasses.replace(setup(), controller=mpc()), strokes, added), "fast")
    for name, kind in (("mpc", law()), ("lqg", setup().law)):
        computed = Loop(stage(), bus(), kind).response(strokes, seen.frequency_hz)
        compared = agreement(seen, computed)
        excess, spread = compared.mean_square - compared.expected_mean_square, 8.0 / np.sqrt(seen.s.size)
        assert (abs(excess) < spread) == (name == "mpc")  # lqg is another law, and it shows
    middle = Loop(stage(), bus(), law()).margins(np.full(3, 12.5e-6))
    assert middle.stable
    assert 1.3 < middle.mimo.peak_s < 1.8


def test_margins_say_where_they_hold():
    shown = CliRunner().invoke(app, ["margins", "--controller", "mpc"])
    assert shown.exit_code == 0
    assert "holds while no plan meets a limit" in shown.output
    assert "limit" not in CliRunner().invoke(app, ["margins", "--controller", "lqg"]).output


def test_both_lanes_have_the_same_bits_while_it_solves():
    near = shortened(far_jump(mpc()), 1100)
    fast, _ = rows_of(near, "fast")
    lockstep, _ = rows_of(near, "lockstep")
    assert (fast["solver_iterations"] > 0).sum() > 20
    assert first_difference(fast, lockstep) is None


def test_a_full_range_move_that_saturates():
    """Voltage, slew and strokes keep their limits, and it is in place no later than the
    regulator that takes its time, upward and downward."""
    planned, result = jumped("mpc")
    clipped, _ = jumped("lqg")
    assert planned["saturated"].sum() > 3  # what it is about
    assert result.faults == ()
    step_v = np.abs(np.diff(planned["voltage_v"], axis=0)).max()
    assert planned["voltage_v"].min() >= 0.0
    assert planned["voltage_v"].max() <= 200.0
    assert 15.0 < step_v <= 20.0
    assert planned["stroke_m"].max() <= 25e-6
    assert planned["stroke_m"].min() >= -0.1e-6
    up, down = (settled_ms(planned, z) for z in (LOW_M + WAY_M, LOW_M))
    assert 1.0 < up <= settled_ms(clipped, LOW_M + WAY_M)
    assert 1.0 < down <= settled_ms(clipped, LOW_M)
    solved = planned["solver_iterations"]
    assert (solved > 0).sum() > 30
    assert (solved < 0).sum() == 0
    assert 4 <= solved.max() <= 20
    assert np.mean(solved[solved > 0]) < 4.0  # from the limits that held the plan before


def test_rehearsals_change_no_bit(monkeypatch):
    """What is solved for the caches alone leaves nothing behind."""
    monkeypatch.setattr(predictive_problem, "REHEARSAL_TICKS", 3)
    often, _ = rows_of(far_jump(mpc()), "fast")
    assert first_difference(often, jumped("mpc")[0]) is None


def test_limits_of_the_last_plan_are_taken_an_interval_sooner():
    """Bounds, slews and strokes each among themselves; the first slew becomes a bound, what has passed is forgotten."""
    n, work = 10, np.zeros(1, active_set.WORK)
    was = {2: -1.0, 3: 1.0, 29: 1.0, 30: -1.0, 34: 1.0, 56: -1.0, 57: 1.0, 61: -1.0, 86: 1.0}
    work["held"][0, : len(was)], work["side"][0, : len(was)], work["count"] = list(was), list(was.values()), len(was)
    predictive_cycle.hold_a_period_on(work[0], n)
    count = int(work["count"][0])
    now = dict(zip(work["held"][0, :count].tolist(), work["side"][0, :count].tolist(), strict=True))
    assert now == {0: -1.0, 26: 1.0, 31: 1.0, 53: -1.0, 58: -1.0, 83: 1.0}
    assert count == 7  # 3 and 30 have become the same one, which the solver takes once


def test_where_the_links_do_not_reach_there_is_no_plan():
    """An estimate out of this world: no square root of a negative number, no plan."""
    period, memory, reference = PredictiveCycle(law()), cycling.new_memory(Mode.TRACKING), np.zeros(4, REFERENCE)
    for far_m in (0.0, 1e-3):
        memory["tick"]["estimate"]["ahead"][0, 2] = far_m - law()["tick"][0]["estimator"]["operating_point_m"][2]
        found = predictive_cycle.plan(law(), memory, reference, period.problem, period.planner)
        assert (found == predictive.NO_PLAN) == (far_m > 0.0)


@cache
def problems_of_the_far_jump():
    """q, lower, upper and solution of every tick that solved one; and their matrices."""
    run = far_jump(mpc())
    problems, problem, period = [], Problem(run.law), PredictiveCycle(run.law)

    def kept(law_array, memory, reference):
        period(law_array, memory, reference)
        if memory["row"]["solver_iterations"][0] != 0:
            work = period.planner["work"]
            problems.append((*problem.vectors(work), work["value"][0, : 3 * problem.horizon].copy()))

    plant, memory = run.new_plant(), cycling.new_memory(Mode.IDLE)
    rows, reference = np.zeros(run.ticks, ROW), reference_rows(run.trajectory.sample(0, run.ticks + 25, 200))
    at_us = 200 * np.arange(run.ticks, dtype=np.int64)
    run_block_in_steps(kept, run.law, memory, reference, plant.params, plant.state, at_us, rows, run.ticks)
    return problems, problem


def test_solutions_are_osqps_to_nine_digits():
    """The whole move, against the same problems given to OSQP, polished."""
    problems, problem = problems_of_the_far_jump()
    assert len(problems) > 30
    hessian, matrix = problem.matrices()
    solver = osqp.OSQP()
    solver.setup(
        scipy.sparse.csc_matrix(np.triu(hessian)), np.zeros(len(hessian)), scipy.sparse.csc_matrix(matrix),
        problems[0][1], problems[0][2], eps_abs=1e-8, eps_rel=1e-8, max_iter=10_000, polishing=True, verbose=False,
    )  # fmt: skip
    for q, lower, upper, v in problems:
        solver.update(q=q, l=lower, u=upper)
        assert v == pytest.approx(solver.solve(raise_error=True).x[:-1], rel=0, abs=1e-9 * max(np.abs(v).max(), 1.0))


def test_without_a_solution_the_regulator_stands_in_and_it_is_counted():
    """One round is never enough: the clipped regulator answers until the monitor
    has seen five such ticks in a row."""
    config = mpc().model_copy(update={"mpc": mpc().mpc.model_copy(update={"iterations_max": 1})})
    failing, result = rows_of(far_jump(config), "fast")
    bad = failing["solver_iterations"] < 0
    tripped = np.flatnonzero(failing["trips"] & int(Trip.SOLVER))[0]
    in_a_row = np.convolve(bad, np.ones(5), "valid") == 5
    assert np.flatnonzero(in_a_row)[0] == tripped - 4
    assert len(result.faults) == 1
    assert "(SOLVER)" in result.faults[0]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"horizon": 9}, "mpc.horizon"),
        ({"horizon": 21}, "mpc.horizon"),
        ({"iterations_max": 0}, "mpc.iterations_max"),
        ({"stroke_min_m": 26e-6}, "stroke_min_m must lie below stroke_max_m"),
    ],
)
def test_numbers_that_make_no_sense_are_refused(change, reason):
    data = plain(mpc())
    data["mpc"] |= change
    with pytest.raises(ConfigError, match=reason):
        parse(data, ControllerConfig, "x.toml")


@pytest.mark.parametrize("horizon", [10, 11, 20])
def test_every_horizon_fits(horizon):
    config = mpc().model_copy(update={"mpc": mpc().mpc.model_copy(update={"horizon": horizon})})
    record = design_law(stage(), config, bus(), autostart=True)
    problem = Problem(record)
    hessian, matrix = problem.matrices()
    assert hessian.shape == (3 * horizon + 1,) * 2
    assert matrix.shape == (9 * horizon - 3, 3 * horizon + 1)
    assert np.linalg.eigvalsh(problem.hessian)[0] > 0.0
    period, memory = PredictiveCycle(record), cycling.new_memory(Mode.IDLE)
    period(record, memory, np.zeros(4, REFERENCE))
    assert memory["mode"][0] == Mode.HOMING
