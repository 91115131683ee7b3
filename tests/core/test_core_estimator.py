"""The filter's kernels against filterpy, step by step, and its confidence against what it gets wrong."""

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from loop_rig import MIDDLE, bus, controller, new_tick_memory, stage, tick_law
from scipy.integrate import solve_ivp
from scipy.stats import chi2

from pkxyz_ctrl.config.calibration import Calibration
from pkxyz_ctrl.core import estimator as filtering
from pkxyz_ctrl.core import tick
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.laws.estimator_gain import measurement_matrix, measurement_noise, process_noise
from pkxyz_ctrl.design.model.plant_model import amplifier_time_constant_s, linearise, sample
from pkxyz_ctrl.stage import Stage

SIZE = np.repeat([1e-6, 1e-3, 1e-4], 3)  # of position, velocity and disturbance, for comparing relative to something


def model(bus_name="fd_5k"):
    linear = linearise(stage(), MIDDLE)
    return linear, sample(linear, bus(bus_name).period_s, amplifier_time_constant_s(stage()))


def filterpy_twin(record):
    """filterpy's filter with the matrices of a record of ``estimator.ESTIMATOR``."""
    twin = KalmanFilter(dim_x=9, dim_z=3, dim_u=6)
    twin.F = np.vstack([record["transition"], np.eye(9)[6:]])
    twin.B = np.vstack([np.hstack([record["input"], record["input_lag"]]), np.zeros((3, 6))])
    twin.H = np.hstack([np.eye(3), -record["sense_delay_s"] * np.eye(3), np.zeros((3, 3))])
    twin.K = record["gain"].copy()
    twin.x = np.zeros((9, 1))
    return twin


@pytest.mark.parametrize("bus_name", ["fd_5k", "classic_2k", "local_20k"])
@pytest.mark.parametrize("delay_s", [0.0, 7e-6])
def test_steps_equal_those_of_filterpy(bus_name, delay_s):
    """500 random steps with every third sample missing at random: to 1e-12 of each quantity's size."""
    record, state = tick_law(bus_name)["estimator"], new_tick_memory()["estimate"]
    record["sense_delay_s"] = delay_s
    twin, rng = filterpy_twin(record), np.random.default_rng(5)
    start = rng.normal(size=9) * SIZE
    state["predicted"][:], twin.x = start, start[:, None].copy()
    out = np.zeros(9)
    for _ in range(500):
        seen = rng.normal(size=3) * 1e-6
        has_measurement = rng.random() < 2 / 3
        filtering.update(record, state, seen + record["operating_point_m"], has_measurement)
        twin.update_steadystate(seen[:, None] if has_measurement else None)
        assert np.abs((state["filtered"] - twin.x[:, 0]) / SIZE).max() <= 1e-12 * np.abs(twin.x[:, 0] / SIZE).max()
        if has_measurement:
            assert np.abs(state["innovation_m"] - twin.y[:, 0]).max() <= 1e-12 * 1e-6
        else:
            assert not state["innovation_m"].any()
        w, w_change = rng.normal(size=3) * 1e-4, rng.normal(size=3) * 1e-5
        filtering.predict(record, state["filtered"].copy(), w, w_change, out)
        twin.predict_steadystate(np.concatenate([w, w_change])[:, None])
        assert np.abs((out - twin.x[:, 0]) / SIZE).max() <= 1e-12 * np.abs(twin.x[:, 0] / SIZE).max()
        state["predicted"][:] = out


@pytest.mark.parametrize("bus_name", ["fd_5k", "local_20k"])
def test_what_is_multiplied_by_nothing_may_be_left_out(bus_name):
    """Axes that do not act on each other give the same bits with and without the products by 0."""
    law, rng = tick_law(bus_name), np.random.default_rng(3)
    record, geometry, elasticity = law["estimator"], law["geometry"], law["elasticity"]
    assert record["decoupled"] == 1
    for _ in range(200):
        s, force, old, apart = rng.normal(size=9) * SIZE, *(np.abs(rng.normal(size=(3, 3))) * 1e-4)
        found = []
        for decoupled in (1, 0):
            record["decoupled"] = decoupled
            at, w, w_change, out = np.empty(3), np.empty(3), np.empty(3), np.empty(9)
            filtering.midway(record, s, at)
            told = 0.1 * apart
            filtering.net_input(geometry, elasticity, record, at, force, old, apart, 0.5 * apart, told, w, w_change)
            filtering.predict(record, s, w, w_change, out)
            found.append(np.concatenate([w, w_change, out]).tobytes())
        assert found[0] == found[1]


def test_axes_of_a_stage_whose_chains_differ_act_on_each_other():
    """... so nothing may be left out there."""
    config = stage().config.model_copy(update={"calibration": Calibration(slider_stiffness=(1.02, 1.0, 0.97))})
    law = design_law(Stage(config), controller(), bus(), autostart=True)["tick"][0]
    assert law["estimator"]["transition"][0, 1] != 0.0
    for name in ("estimator", "feedback", "set_points"):
        assert law[name]["decoupled"] == 0


@pytest.mark.parametrize("delay_periods", [1, 2])
def test_the_tick_predicts_with_the_exact_forces(delay_periods):
    """``tick.estimate`` whole, for counts that changed in every tick: w from Stage in numpy, the steps by filterpy."""
    law, memory, rng = tick_law(), new_tick_memory(), np.random.default_rng(9)
    law["delay_periods"] = delay_periods
    record, state, device = law["estimator"], memory["estimate"], stage()
    origin, twin = record["operating_point_m"].copy(), filterpy_twin(law["estimator"])
    holding = device.holding_voltages(origin) / law["drive"]["volt_per_count"]
    count = np.round(holding + np.array([[60, -50, 20], [-20, 70, -10], [10, -80, 0]])).astype(np.int32)
    memory["count"][:] = count
    state["predicted"][:] = rng.normal(size=9) * np.repeat([1e-7, 3e-4, 1e-6], 3)
    memory["measurement_m"][:] = origin + state["predicted"][:3] + rng.normal(size=3) * 1e-8
    twin.x = state["predicted"].copy()[:, None]
    twin.update_steadystate((memory["measurement_m"] - origin)[:, None])
    tick.estimate(law, memory, True)
    force = device.comb_force(count * law["drive"]["volt_per_count"])
    steps = []
    for age in range(delay_periods - 1, -1, -1):
        s = twin.x[:, 0]
        at = origin + s[:3] + 0.5e-6 * bus().period_us * s[3:6]  # in mid-period
        jacobian = device.jacobian(at)
        w = jacobian.T @ force[age] - device.energy_gradient(at) + record["stiffness_n_per_m"] @ (at - origin)
        twin.predict_steadystate(np.concatenate([w, jacobian.T @ (force[age + 1] - force[age])])[:, None])
        assert not filtering.goes_far(record, s, twin.x[:, 0])
        steps.append(twin.x[:, 0].copy())
    for name, expected in (("predicted", steps[0]), ("ahead", steps[-1])):
        assert np.abs((state[name] - expected) / SIZE).max() <= 1e-11, name
    assert (np.abs(state["ahead"] - state["predicted"]).max() > 0) == (delay_periods == 2)


@pytest.mark.parametrize("seed", range(8))
def test_far_ways_are_predicted_by_simpsons_rule(seed):
    """Ways of some um in a period, at up to 50 mm/s and under forces that are out of balance by up to half: the
    differential equation, solved by scipy, is met three times as well as with the input of mid-period, and to 6 nm.
    """
    law, rng = tick_law(), np.random.default_rng(seed)
    record, device = law["estimator"], stage()
    linear, origin = model()[0], record["operating_point_m"]
    s = np.concatenate([rng.uniform(-6e-6, 6e-6, 3), rng.uniform(-1, 1, 3) * [5e-3, 5e-3, 5e-2], np.zeros(3)])
    old = device.holding_forces(origin + s[:3])
    force, tau_s = old * rng.uniform(0.6, 1.4), amplifier_time_constant_s(device)

    def motion(t_s, state):
        acting = force + (old - force) * np.exp(-t_s / tau_s)
        at = origin + state[:3]
        pull = device.jacobian(at).T @ acting - device.energy_gradient(at) - linear.damping_n_s_per_m @ state[3:]
        return np.concatenate([state[3:], pull / linear.mass_kg])

    exact = solve_ivp(motion, (0.0, bus().period_s), s[:6], rtol=1e-10, atol=1e-14).y[:, -1]
    middle, w, w_change, once, twice = np.empty(3), np.empty(3), np.empty(3), np.empty(9), np.empty(9)
    filtering.midway(record, s, middle)
    none = np.zeros(3)
    filtering.net_input(law["geometry"], law["elasticity"], record, middle, force, old, none, none, none, w, w_change)
    filtering.predict(record, s, w, w_change, once)
    twice[:] = once
    room = np.zeros(1, filtering.FAR)[0]
    filtering.predict_far(law["geometry"], law["elasticity"], record, s, force, old, none, none, none, room, twice)
    assert filtering.goes_far(record, s, once)
    worst = [np.abs((out[:6] - exact) / np.repeat([1e-9, 5e-6], 3)).max() for out in (once, twice)]  # 1 nm a period
    assert worst[1] < min(worst[0] / 3.0, 6.0)
    assert worst[0] > 5.0


def riccati_by_filterpy(bus_name="fd_5k"):
    """Phi, Q, H, R and what filterpy's covariance settles at, in nm, um/s and uN."""
    linear, sampled = model(bus_name)
    unit = np.repeat([1e-9, 1e-6, 1e-6], 3)
    _, q = process_noise(linear, controller().estimator, bus(bus_name).period_s)
    twin = KalmanFilter(dim_x=9, dim_z=3)
    twin.F, twin.Q = sampled.phi * unit / unit[:, None], q / np.outer(unit, unit)
    twin.H = measurement_matrix(stage()) * unit / 1e-9
    twin.R = measurement_noise(stage(), linear, bus(bus_name)) / 1e-18
    twin.P = np.eye(9) * 100.0
    for _ in range(3000):
        twin.predict()
        twin.update(np.zeros(3))
    return twin, unit


@pytest.mark.parametrize("bus_name", ["fd_5k", "classic_2k", "local_20k"])
def test_the_gain_is_the_one_filterpy_settles_at(bus_name):
    twin, unit = riccati_by_filterpy(bus_name)
    gain = twin.K * unit[:, None] / 1e-9
    designed = tick_law(bus_name)["estimator"]["gain"]
    scale = np.abs(gain).reshape(3, 3, 3).max(axis=(1, 2)).repeat(3)[:, None]
    assert np.abs((designed - gain) / scale).max() < 1e-6
    # between believing nothing and everything: of a position error some tenths are taken over at once
    assert 0.05 < np.diag(designed[:3]).min() <= np.diag(designed[:3]).max() < 0.95


def test_confidence_is_deserved():
    """Runs of the linear model with the noise that the design believes in, filtered by the compiled kernels.

    Squared errors of the prediction, by its covariance (NEES), and of the innovations, by theirs (NIS), are chi-square
    if gain and covariance belong to model and noise: within the two-sided 99.9 % of it. Innovations are white.
    """
    twin, unit = riccati_by_filterpy()
    record, state = tick_law()["estimator"], new_tick_memory()["estimate"]
    rng = np.random.default_rng(11)
    prior = twin.F @ twin.P @ twin.F.T + twin.Q  # of the prediction
    of_innovation = twin.H @ prior @ twin.H.T + twin.R
    root_prior, root_q, root_r = (np.linalg.cholesky(m + 1e-12 * np.diag(np.diag(m))) for m in (prior, twin.Q, twin.R))
    runs, steps, nothing, out = 250, 40, np.zeros(3), np.zeros(9)
    nees, nis, products = [], [], []
    for _ in range(runs):
        truth = rng.normal(size=9) * 10
        state["predicted"][:] = (truth + root_prior @ rng.normal(size=9)) * unit
        last = None
        for _ in range(steps):
            seen = (twin.H @ truth + root_r @ rng.normal(size=3)) * 1e-9
            filtering.update(record, state, seen + record["operating_point_m"], True)
            innovation = np.linalg.solve(np.linalg.cholesky(of_innovation), state["innovation_m"] / 1e-9)
            nis.append(innovation @ innovation)
            if last is not None:
                products.append(innovation * last)
            last = innovation
            filtering.predict(record, state["filtered"], nothing, nothing, out)
            state["predicted"][:] = out
            truth = twin.F @ truth + root_q @ rng.normal(size=9)
        error = out / unit - truth
        nees.append(error @ np.linalg.solve(prior, error))
    for values, dimension in ((nees, 9), (nis, 3)):
        low, high = chi2.ppf([0.0005, 0.9995], dimension * len(values)) / len(values)
        assert low < np.mean(values) < high
    correlation = np.mean(products, axis=0) * np.sqrt(len(products))
    assert np.abs(correlation).max() < 3.5  # standard normal if white


def test_without_samples_the_prediction_stands():
    law, memory = tick_law(), new_tick_memory()
    state = memory["estimate"]
    state["predicted"][:] = np.arange(1, 10) * 1e-9
    memory["measurement_m"][:] = np.nan  # must not even be looked at
    expected = state["predicted"].copy()
    tick.estimate(law, memory, False)
    assert np.array_equal(state["filtered"], expected)
    assert np.isfinite(state["predicted"]).all()
    assert not state["innovation_m"].any()


def test_a_held_position_is_held_in_the_prediction():
    """At equilibrium under the holding voltages the filter expects to stay, wherever that is, to 1 pm a period: the
    input has the exact gradient, where a linearisation about the operating point would be off by nanometres.

    With counts of 6 uV, because the real ones' rounding alone is 0.35 nm.
    """
    device, law = stage(), tick_law()
    law["drive"]["volt_per_count"] /= 1000
    for strokes_m in ([12.5e-6] * 3, [5e-6, 8e-6, 7e-6], [20e-6, 18e-6, 22e-6]):
        memory = new_tick_memory()
        at = device.forward_kinematics(strokes_m)
        memory["count"][:] = np.round(device.holding_voltages(at) / law["drive"]["volt_per_count"])
        tick.set_position(law, memory, at)
        tick.estimate(law, memory, False)
        predicted = memory["estimate"]["predicted"] + np.r_[law["estimator"]["operating_point_m"], np.zeros(6)]
        assert np.abs(predicted[:3] - at).max() < 1e-12
        assert np.abs(predicted[3:6]).max() < 1e-12 / 1e-4
        assert not predicted[6:].any()
