"""The design's models of the stage: against python-control, numerical integration and the paper's frequencies."""

import control
import numpy as np
import pytest
from finite_differences import central_differences
from loop_rig import MIDDLE, bus, stage
from scipy.integrate import solve_ivp
from sim_rig import config, plant

from pkxyz_ctrl.design.model.plant_model import amplifier_time_constant_s, linearise, sample
from sim.motion.mechanics import acceleration

TAU_S = amplifier_time_constant_s(stage())
UNIT = np.repeat([1e-6, 1e-3, 1e-4], 3)  # sizes of the states, to compare blocks of unlike units


def scaled(matrix, input_size_n=1e-4):
    columns = UNIT if matrix.shape[1] == 9 else input_size_n
    return matrix * columns / UNIT[:, None]


def test_modes_at_rest_are_the_published_ones_with_the_stage_files_damping():
    model = linearise(stage(), np.zeros(3))
    poles = np.linalg.eigvals(model.a[:6, :6])
    frequency_hz = np.sort(np.abs(poles)) / (2 * np.pi)
    assert frequency_hz == pytest.approx([630.92] * 4 + [771.75] * 2, rel=2e-4)  # paper, section V; f_z to 5 digits
    assert -poles.real / np.abs(poles) == pytest.approx(np.full(6, 1 / (2 * 20.0)), rel=1e-9)


@pytest.mark.parametrize("strokes_um", [(12.5, 12.5, 12.5), (3.0, 9.0, 6.0), (22.0, 20.0, 24.0)])
def test_the_linear_model_is_the_derivative_of_the_plants_motion(strokes_um):
    """Finite differences of the equation of motion that the plant integrates, at zero voltage: shares no code."""
    model, p = linearise(stage(), np.array(strokes_um) * 1e-6), plant(config())

    def motion(state):
        return np.array(acceleration(p.params[0], p.state[0], np.zeros(3), *state))

    at = np.r_[model.position_m, np.zeros(3)]
    numeric = central_differences(motion, at, 2e-6)
    assert model.a[3:6, :3] == pytest.approx(numeric[:, :3], rel=1e-9, abs=1e-9 * np.abs(numeric[:, :3]).max())
    assert model.a[3:6, 3:6] == pytest.approx(numeric[:, 3:], rel=1e-9, abs=1e-6 * np.abs(numeric[:, 3:]).max())


@pytest.mark.parametrize("bus_name", ["fd_5k", "classic_2k", "local_20k"])
def test_sampling_equals_python_controls(bus_name):
    model, period_s = linearise(stage(), MIDDLE), bus(bus_name).period_s
    sampled = sample(model, period_s, TAU_S)
    oracle = control.sample_system(control.ss(model.a, model.b, np.eye(9), np.zeros((9, 3))), period_s, method="zoh")
    assert np.abs(scaled(sampled.phi - oracle.A)).max() < 1e-12 * np.abs(scaled(oracle.A)).max()
    assert np.abs(scaled(sampled.gamma - oracle.B)).max() < 1e-12 * np.abs(scaled(oracle.B)).max()


@pytest.mark.parametrize("bus_name", ["fd_5k", "local_20k"])
def test_a_period_equals_the_integral_with_the_amplifiers_lag(bus_name):
    """DOP853 over s' = A s + B u, u on its exponential way from the old force to the new one."""
    model, period_s, rng = linearise(stage(), MIDDLE), bus(bus_name).period_s, np.random.default_rng(4)
    sampled = sample(model, period_s, TAU_S)
    for _ in range(5):
        state, force, old = rng.normal(size=9) * UNIT, rng.normal(size=3) * 1e-4, rng.normal(size=3) * 1e-4

        def rate(t, scaled_state, force=force, old=old):
            u = force + (old - force) * np.exp(-t / TAU_S)
            return (model.a @ (scaled_state * UNIT) + model.b @ u) / UNIT

        end = solve_ivp(rate, (0, period_s), state / UNIT, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
        found = (sampled.phi @ state + sampled.gamma @ force + sampled.gamma_lag @ (old - force)) / UNIT
        assert np.abs(found - end).max() < 1e-9


def test_lag_is_a_first_order_delay_of_the_force():
    """A force that arrives tau late moves the stage as if it were tau late: v lacks f tau / m, to order (T omega)^2."""
    model = linearise(stage(), MIDDLE)
    sampled = sample(model, 50e-6, TAU_S)
    lost = sampled.gamma_lag[3:6]  # v gained from the old force's remainder
    expected = TAU_S / model.mass_kg * np.eye(3)
    assert 0.96 < lost[0, 0] / expected[0, 0] < 1.0
    assert 0.95 < lost[2, 2] / expected[2, 2] < 1.0
    assert np.abs(lost - np.diag(np.diag(lost))).max() < 0.01 * expected[0, 0]


def test_the_disturbance_is_a_force_that_stays():
    sampled = sample(linearise(stage(), MIDDLE), 200e-6, TAU_S)
    assert np.array_equal(sampled.phi[6:], np.eye(9)[6:])
    assert sampled.phi[:6, 6:] == pytest.approx(sampled.gamma[:6], rel=1e-12)
    assert not sampled.gamma[6:].any()
    assert not sampled.gamma_lag[6:].any()
