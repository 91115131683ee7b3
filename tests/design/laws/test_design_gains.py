"""Gains by two other ways, noise models by their integrals, and the whole linear loop with its delay."""

import dataclasses
import math

import control
import numpy as np
import pytest
import scipy.linalg
from loop_rig import MIDDLE, bus, controller, controller_with, law, setup, stage

from pkxyz_ctrl.config.files import ConfigError, load
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.core.linear3 import inverse3
from pkxyz_ctrl.design.drive_limits import count_max, slew_counts
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.laws.estimator_gain import (
    measurement_matrix,
    measurement_noise,
    process_noise,
    sense_noise,
)
from pkxyz_ctrl.design.laws.regulator import regulator_gain
from pkxyz_ctrl.design.model.design_error import DesignError
from pkxyz_ctrl.design.model.plant_model import amplifier_time_constant_s, linearise, sample
from pkxyz_ctrl.stage import Stage

BUSES = ["fd_5k", "classic_2k", "local_20k"]
TAU_S = amplifier_time_constant_s(stage())


UNIT = np.repeat([1e-9, 1e-6, 1e-6], 3)


def sampled_for(bus_name, model=None, device=None):
    device = device or stage()
    return sample(model or linearise(device, MIDDLE), bus(bus_name).period_s, amplifier_time_constant_s(device))


# -- noise ------------------------------------------------------------------------------------------------------------


def test_sense_noise_is_2_nm_and_the_counts():
    """5 aF/rtHz over 2.5 kHz are 250 aF; 127.5 fF/um make 1.96 nm of it; counts of 0.53 nm add 0.15 nm."""
    assert stage().sense_gradient_f_per_m == pytest.approx(127.5e-9, rel=1e-3)
    white_m = 5e-18 * math.sqrt(2500) / stage().sense_gradient_f_per_m[0]
    count_m = 68e-18 / stage().sense_gradient_f_per_m[0] / math.sqrt(12)
    assert sense_noise(stage(), bus()) == pytest.approx(math.hypot(white_m, count_m), rel=1e-12)
    assert sense_noise(stage(), bus()) == pytest.approx(1.966e-9, rel=1e-3)
    assert sense_noise(stage(), bus("local_20k")) == pytest.approx(3.92e-9, rel=1e-2)


def test_measurement_noise_is_what_monte_carlo_finds():
    model, rng = linearise(stage(), MIDDLE), np.random.default_rng(8)
    strokes = MIDDLE + rng.normal(0, sense_noise(stage(), bus()), (40_000, 3))
    found = np.cov(stage().forward_kinematics(strokes).T)
    designed = measurement_noise(stage(), model, bus())
    assert found == pytest.approx(designed, rel=0.03, abs=0.03 * designed.max())


def test_process_noise_is_the_integral_over_the_period():
    """Q = int e^(A t) G G^T e^(A^T t) dt, by Gauss-Legendre, with the one-sided force density over root two."""
    model, weights = linearise(stage(), MIDDLE), controller().estimator
    phi, q = process_noise(model, weights, 200e-6)
    shaping = np.zeros((9, 6))
    shaping[3:6, :3] = np.eye(3) * weights.force_noise_n_per_rthz / math.sqrt(2) / model.mass_kg
    shaping[6:, 3:] = np.eye(3) * weights.disturbance_drift_n_per_rts
    nodes, gauss = np.polynomial.legendre.leggauss(12)
    total = np.zeros((9, 9))
    for x, weight in zip(nodes, gauss, strict=True):
        step = sample(model, 100e-6 * (x + 1), TAU_S).phi @ shaping
        total += 100e-6 * weight * step @ step.T
    size = np.sqrt(np.outer(np.diag(total), np.diag(total)))
    assert np.abs((q - total) / size).max() < 1e-6
    assert phi == pytest.approx(sampled_for("fd_5k", model).phi, rel=1e-9, abs=1e-12)


# -- gains ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bus_name", BUSES)
def test_kalman_gain_against_python_control(bus_name):
    model, unit = linearise(stage(), MIDDLE), UNIT
    sampled = sampled_for(bus_name, model)
    _, q = process_noise(model, controller().estimator, bus(bus_name).period_s)
    h, r = measurement_matrix(stage()), measurement_noise(stage(), model, bus(bus_name))
    phi, hs = sampled.phi * unit / unit[:, None], h * unit / 1e-9
    q, r = (0.5 * (m + m.T) for m in (q / np.outer(unit, unit), r / 1e-18))  # python-control wants it to the last bit
    predictor = np.asarray(control.dlqe(phi, np.eye(9), hs, q, r)[0])  # of x+ = Phi x + L (y - H x): Phi times ours
    designed = law(bus_name)["tick"]["estimator"]["gain"][0] * 1e-9 / unit[:, None]
    assert phi @ designed == pytest.approx(predictor, rel=1e-6, abs=1e-6 * np.abs(predictor).max())


def test_a_gain_that_filterpy_does_not_confirm_is_refused(monkeypatch):
    """scipy hands back a covariance that is a ten-thousandth off."""
    solve = scipy.linalg.solve_discrete_are
    monkeypatch.setattr(scipy.linalg, "solve_discrete_are", lambda *given: solve(*given) * (1 + 1e-4))
    with pytest.raises(DesignError, match=r"scipy's steady state and filterpy's step from it differ by .*; check the"):
        design_law(stage(), controller(), bus(), autostart=True)


def test_a_filter_that_hardly_believes_in_noise_is_accepted():
    """It takes seconds to settle, and is sound all the same."""
    weights = {"force_noise_n_per_rthz": 1e-12, "disturbance_drift_n_per_rts": 1e-10}
    slow = design_law(stage(), controller_with(estimator=weights), bus(), autostart=True)
    gain = slow["tick"]["estimator"]["gain"][0]
    assert 0 < gain[0, 0] < 0.01


@pytest.mark.parametrize("bus_name", BUSES)
def test_regulator_gain_is_where_the_riccati_recursion_ends(bus_name):
    """Dynamic programming, backwards from nothing, in plain numpy: the definition of the regulator."""
    sampled, weights = sampled_for(bus_name), controller().regulator
    kx, kv = regulator_gain(sampled, weights)
    unit = np.repeat([weights.position_error_m, weights.velocity_error_m_per_s], 3)
    phi, gamma = sampled.phi[:6, :6] * unit / unit[:, None], sampled.gamma[:6] * weights.force_n / unit[:, None]
    cost, gain = np.zeros((6, 6)), np.zeros((3, 6))
    for _ in range(5000):
        gain = np.linalg.solve(np.eye(3) + gamma.T @ cost @ gamma, gamma.T @ cost @ phi)
        cost = np.eye(6) + phi.T @ cost @ (phi - gamma @ gain)
    found = np.hstack([kx, kv]) * unit / weights.force_n
    assert found == pytest.approx(gain, rel=1e-7, abs=1e-7 * np.abs(gain).max())


# -- the loop ---------------------------------------------------------------------------------------------------------


def closed_loop(designed, believed, real, delay_periods):
    """Matrix of one period of everything that remembers: plant (6), prediction (9), the forces under way (3 each).

    ``designed``: record of ``tick.LAW``; ``believed``, ``real``: sampled models of the filter and of the plant.
    """
    record, gains = designed["estimator"], designed["feedback"]
    h = np.hstack([np.eye(3), -record["sense_delay_s"] * np.eye(3), np.zeros((3, 3))])
    n_force = delay_periods + 1
    size = 6 + 9 + 3 * n_force
    x, s, f = slice(0, 6), slice(6, 15), [slice(15 + 3 * i, 18 + 3 * i) for i in range(n_force)]  # newest first
    eye = np.eye(size)

    def moved(model, state, age):
        """State a period on, under the force of that age, with the one before it fading."""
        lead = len(state)
        return (
            model.phi[:lead, :lead] @ state
            + model.gamma[:lead] @ eye[f[age]]
            + model.gamma_lag[:lead] @ (eye[f[age + 1]] - eye[f[age]])
        )

    filtered = eye[s] + record["gain"] @ (h[:, :6] @ eye[x] - h @ eye[s])
    states = [filtered]
    for age in range(delay_periods - 1, -1, -1):
        states.append(moved(believed, states[-1], age))
    ahead = states[-1]
    command = -(gains["position_gain_n_per_m"] @ ahead[:3] + gains["velocity_gain_n_s_per_m"] @ ahead[3:6] + ahead[6:])
    step = np.zeros((size, size))
    step[x] = moved(real, eye[x], delay_periods - 1)
    step[s] = states[1]
    step[f[0]] = command
    for older in range(1, n_force):
        step[f[older]] = eye[f[older - 1]]
    return step


@pytest.mark.parametrize("bus_name", BUSES)
@pytest.mark.parametrize("delay_periods", [1, 2])
def test_filter_delay_and_regulator_together_are_stable(bus_name, delay_periods):
    """All eigenvalues well inside the unit circle, and none so far inside that the numbers could not be meant: the
    slowest is the filter's disturbance, which settles within milliseconds, not within a period."""
    sampled = sampled_for(bus_name)
    radius = np.abs(np.linalg.eigvals(closed_loop(law(bus_name)["tick"][0], sampled, sampled, delay_periods))).max()
    settling_s = -bus(bus_name).period_s / math.log(radius)
    assert radius < 1
    assert 0.3e-3 < settling_s < 10e-3


@pytest.mark.parametrize("bus_name", BUSES)
@pytest.mark.parametrize("delay_periods", [1, 2])
def test_the_loop_is_its_filter_and_its_regulator_and_nothing_else(bus_name, delay_periods):
    """The separation principle, which holds if and only if the bookkeeping of the delay is right: eigenvalues of the
    whole are those of the two apart, and zeros. Compared by the sums of their powers, which are traces. With an
    amplifier so fast that its lag is nothing, as the regulator is designed without it."""
    quick = stage().config.amplifier.model_copy(update={"bandwidth_hz": 1e9})
    device = Stage(stage().config.model_copy(update={"amplifier": quick}))
    designed = design_law(device, controller(), bus(bus_name, delay_periods), autostart=True)["tick"][0]
    sampled, gains = sampled_for(bus_name, device=device), designed["feedback"]
    k = np.hstack([gains["position_gain_n_per_m"], gains["velocity_gain_n_s_per_m"]])
    of_regulator = sampled.phi[:6, :6] - sampled.gamma[:6] @ k
    of_filter = sampled.phi @ (np.eye(9) - designed["estimator"]["gain"] @ measurement_matrix(device))
    unit = np.r_[UNIT[:6], UNIT, np.tile([1e-6] * 3, delay_periods + 1)]
    whole = closed_loop(designed, sampled, sampled, delay_periods) * unit / unit[:, None]
    for power in range(1, 20):
        parts = sum(np.trace(np.linalg.matrix_power(m, power)) for m in (of_regulator, of_filter))
        assert np.trace(np.linalg.matrix_power(whole, power)) == pytest.approx(parts, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("factor", [0.8, 0.9, 1.1, 1.2])
@pytest.mark.parametrize("what", ["stiffness", "mass", "damping"])
def test_stable_on_a_stage_that_is_not_quite_the_one_designed_for(what, factor):
    model = linearise(stage(), MIDDLE)
    other = {
        "stiffness": {"stiffness_n_per_m": model.stiffness_n_per_m * factor},
        "mass": {"mass_kg": model.mass_kg * (1 + (factor - 1) / 2)},
        "damping": {"damping_n_s_per_m": model.damping_n_s_per_m * (factor - 0.75) * 4},
    }[what]
    truth = sampled_for("fd_5k", dataclasses.replace(model, **other))
    whole = closed_loop(law()["tick"][0], sampled_for("fd_5k"), truth, 1)
    assert 0.5 < np.abs(np.linalg.eigvals(whole)).max() < 1


# -- from files to numbers --------------------------------------------------------------------------------------------


def test_the_law_is_read_only_and_holds_the_files_numbers():
    designed = law("fd_5k")
    with pytest.raises(ValueError, match="read-only"):
        designed["period_us"] = 1
    record = designed[0]
    assert record["period_us"] == 200
    assert record["homing_ticks"] == 250
    assert record["autostart"] == 1
    assert record["tick"]["delay_periods"] == 1
    assert record["tick"]["drive"]["count_max"] == 32767
    assert record["tick"]["drive"]["count_slew_max"] == math.floor(20 / (200 / 32767))
    assert record["tick"]["feedback"]["mass_kg"] == 4.833e-6
    assert record["limits"]["stale_count"] == controller().monitors.stale_count
    assert record["limits"]["innovation_max_m"].tolist() == [0.5e-6] * 3
    # a step of exactly the slew limit never trips, one count more does
    volts = record["tick"]["drive"]["volt_per_count"]
    slew = record["tick"]["drive"]["count_slew_max"]
    assert slew * volts < record["limits"]["voltage_step_max_v"] < (slew + 1) * volts
    assert np.array_equal(design_law(stage(), controller(), bus(), autostart=True), designed)  # same files, same bits


def test_operating_point_of_the_law_is_where_the_file_says():
    record = law("fd_5k")["tick"]["estimator"][0]
    assert record["operating_point_m"] == pytest.approx(stage().forward_kinematics(MIDDLE), rel=1e-12)
    assert record["stiffness_n_per_m"] == pytest.approx(stage().stiffness(record["operating_point_m"]), rel=1e-12)


def test_limits_in_counts_never_exceed_those_in_volts():
    for limit_v in (10.0, 130.0, 199.99, 200.0):
        counts = count_max(stage(), controller_with(limits={"voltage_max_v": limit_v}), bus())
        assert counts * (200 / 32767) <= limit_v * (1 + 1e-12) < (counts + 1) * (200 / 32767)
    for slew in (1e3, 1e5, 2.5e5):
        counts = slew_counts(controller_with(limits={"slew_max_v_per_s": slew}), bus())
        assert counts * (200 / 32767) <= slew * 200e-6 * (1 + 1e-9) < (counts + 1) * (200 / 32767)


def test_where_a_tick_is_long_a_step_may_be_all_that_a_frame_carries():
    """At 100 Hz the shipped 100 kV/s are 1000 V a tick, which no gate takes as a number of counts."""
    slow = bus().model_copy(update={"period_us": 10_000})
    assert slew_counts(controller(), slow) == 32767


def test_a_stage_that_bears_less_than_the_controller_allows_sets_the_limit():
    config = load("stages", "reconstructed", StageConfig)
    weak = Stage(config.model_copy(update={"limits": config.limits.model_copy(update={"voltage_max_v": 150.0})}))
    assert count_max(weak, controller(), bus()) * (200 / 32767) <= 150.0
    assert count_max(weak, controller(), bus()) == count_max(
        stage(), controller_with(limits={"voltage_max_v": 150.0}), bus()
    )
    run = dataclasses.replace(setup(), stage=weak.config)
    assert run.gate.count_max == count_max(weak, controller(), bus())


def test_limits_that_contradict_each_other_are_refused():
    with pytest.raises(ConfigError, match=r"'lqg'.*voltage_max_v = 201 V.*200 V of stage 'reconstructed'; lower it"):
        design_law(stage(), controller_with(limits={"voltage_max_v": 201.0}), bus(), autostart=True)
    with pytest.raises(ConfigError, match=r"slew_max_v_per_s allows less than one count a tick; raise it"):
        design_law(stage(), controller_with(limits={"slew_max_v_per_s": 20.0}), bus(), autostart=True)


def test_three_by_three_inverse():
    """Against numpy; a singular matrix is told by its determinant, 0."""
    rng, out = np.random.default_rng(1), np.zeros((3, 3))
    for _ in range(100):
        matrix = rng.normal(size=(3, 3))
        determinant = inverse3(matrix, out)
        assert determinant == pytest.approx(np.linalg.det(matrix), rel=1e-9)
        assert out @ matrix == pytest.approx(np.eye(3), abs=1e-12 * np.linalg.cond(matrix))
    assert inverse3(np.ones((3, 3)), out) == 0.0
