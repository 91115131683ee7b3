"""Margins against python-control, against eigenvalues of the perturbed loop, and the default law's linear equivalent
against the tick that runs.
"""

import control
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_rig import MIDDLE, bus, law, new_tick_memory, rows_of, setup, stage

from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.core import tick
from pkxyz_ctrl.design.hold_noise import hold_noise_m
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.laws.pi_notch import PiNotch, pi_notch
from pkxyz_ctrl.design.lqg_equivalent import lqg_equivalent
from pkxyz_ctrl.design.margins.margins import (
    HALF_POWER,
    axis_margins,
    frequency_grid_hz,
    largest_singular_value,
    loop_response,
    margins,
    spectral_radius,
    structured_norm,
)
from pkxyz_ctrl.design.margins.sensitivity import Sensitivity, closed_loop
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.design.model.discrete_law import DiscreteLaw, LawError
from pkxyz_ctrl.design.model.loop_plant import NOMINAL, Perturbation, held_force_softening, loop_plant

OFF_CENTRE = np.array([7e-6, 15e-6, 11e-6])
MASS = stage().config.dynamics.mass_kg


def lqg(bus_name="fd_5k", strokes_m=MIDDLE):
    return lqg_equivalent(stage(), law(bus_name), strokes_m)


def plant(bus_name="fd_5k", strokes_m=MIDDLE, perturbation=NOMINAL):
    return loop_plant(stage(), bus(bus_name), strokes_m, perturbation)


def changed_measurement(a_law, factors):
    """The law that sees the measurements times complex factors: matrices for the eigenvalues alone."""
    return a_law.b * factors, a_law.d * factors


def radius_with_factors(a_plant, a_law, factors):
    """Spectral radius of the loop whose measurements are multiplied by complex factors (3,)."""
    b, d = changed_measurement(a_law, np.asarray(factors))
    loop = np.block([[a_plant.a - a_plant.b @ d @ a_plant.c, -a_plant.b @ a_law.c], [b @ a_plant.c, a_law.a]])
    return np.abs(np.linalg.eigvals(loop)).max()


# -- the plant --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("strokes_m", [MIDDLE, OFF_CENTRE])
def test_softening_is_what_held_forces_do_when_the_jacobian_turns(strokes_m):
    """d(J^T F)/dx by central differences of the exact Jacobian."""
    at, h = stage().forward_kinematics(strokes_m), 1e-8
    force = stage().holding_forces(at)
    columns = [
        (stage().jacobian(at + h * e).T @ force - stage().jacobian(at - h * e).T @ force) / (2 * h) for e in np.eye(3)
    ]
    g = held_force_softening(stage(), at)
    assert g == pytest.approx(np.array(columns).T, rel=1e-6, abs=1e-6)
    assert np.linalg.eigvalsh(g).min() > 1.0


@pytest.mark.parametrize("delay_periods", [1, 2])
def test_the_sampled_plant_is_the_differential_equation(delay_periods):
    """Random held forces, integrated by DOP853 with delay and amplifier: the positions of 12 samples to 1e-8."""
    perturbed = Perturbation(0.15, -0.05, 7.0, (0.1, -0.1, 0.05))
    model = loop_plant(stage(), bus("fd_5k", delay_periods), OFF_CENTRE, perturbed)
    forces = np.random.default_rng(3).normal(size=(12, 3)) * 1e-5
    state, seen = np.zeros(len(model.a)), []
    for w in forces:
        seen.append(model.c @ state)
        state = model.a @ state + model.b @ w
    at = stage().forward_kinematics(OFF_CENTRE)
    mass = MASS * 0.95
    k = 1.15 * (stage().stiffness(at) - held_force_softening(stage(), at))
    values, vectors = np.linalg.eigh(stage().stiffness(np.zeros(3)) * 1.15)
    c = vectors @ np.diag(np.sqrt(values * mass)) @ vectors.T / 7.0
    j = stage().jacobian(at)
    error = j.T @ np.diag([1.1, 0.9, 1.05]) @ np.linalg.inv(j.T)
    tau = 1 / (2 * np.pi * stage().config.amplifier.bandwidth_hz)

    def motion(w):
        return lambda t, s: np.r_[s[3:6], (s[6:9] - k @ s[:3] - c @ s[3:6]) / mass, (error @ w - s[6:9]) / tau]

    true, path = np.zeros(9), []
    for n in range(12):
        path.append(true[:3])
        w = forces[n - delay_periods] if n >= delay_periods else np.zeros(3)
        span = (0.0, bus().period_s)
        true = scipy.integrate.solve_ivp(motion(w), span, true, "DOP853", rtol=1e-11, atol=1e-18).y[:, -1]
    assert np.array(seen) == pytest.approx(np.array(path), rel=1e-6, abs=1e-8 * np.abs(path).max())


def test_a_device_that_cannot_be_is_refused():
    for arguments in ({"stiffness": -1.0}, {"mass": -2.0}, {"comb_gain": (0.0, -1.0, 0.0)}, {"quality_factor": 0.0}):
        with pytest.raises(ValueError, match=r"no stage|positive"):
            Perturbation(**arguments)


# -- margins against python-control, axis by axis ---------------------------------------------------------------------


@settings(max_examples=5)
@given(st.floats(3.0, 12.0), st.floats(0.0, 300e-6), st.floats(0.4, 1.0), st.integers(0, 2))
def test_margins_of_one_axis_are_those_of_python_control(margin_db, integral_time_s, damping, i):
    """Uncoupled at the centre of the workspace, so an axis is a loop with one input: of order 9."""
    config = PiNotch(gain_margin_db=margin_db, integral_time_s=integral_time_s, notch_damping=damping)
    a_law = pi_notch(plant(), MASS, config)
    found = margins(plant(), a_law).axes[i]
    axis, rows = plant().axis(i), slice(5 * i, 5 * i + 5)
    k = control.ss(a_law.a[rows, rows], a_law.b[rows, i], a_law.c[i, rows], a_law.d[i, i], plant().period_s)
    loop = control.ss(axis.a, axis.b, axis.c, 0.0, plant().period_s) * k
    omega = np.unique(
        np.r_[np.geomspace(1.0, np.pi / plant().period_s * 0.9999, 500), 2 * np.pi * np.linspace(200, 900, 400)]
    )
    data = control.frd(loop(np.exp(1j * omega * plant().period_s)), omega)
    gain, phase, _, _, _, _ = control.stability_margins(data)
    disk, _, _ = control.disk_margins(loop, omega)
    assert found.gain_margin == pytest.approx(gain, rel=2e-3)
    assert found.phase_margin_rad == pytest.approx(np.deg2rad(phase), rel=2e-3)
    assert disk * (1 - 2e-3) <= found.disk_margin <= disk * (1 + 1e-6)  # on the grid it is not quite found
    s = 1 / (1 + data.frdata[0, 0])
    assert found.peak_s == pytest.approx(np.abs(s).max(), rel=2e-3)
    assert found.peak_t == pytest.approx(np.abs(1 - s).max(), rel=2e-3)
    assert found.bandwidth_hz == pytest.approx(omega[np.argmax(np.abs(s) >= HALF_POWER)] / 2 / np.pi, rel=2e-2)


def test_a_loop_with_known_margins():
    """Integrator with one sample of delay, L = k T / (z (z - 1)): stable to k T = 1, where z = exp(i pi / 3)."""
    period, kt = 1e-3, 0.4
    grid = np.geomspace(0.5, 500.0, 4000)

    def sensitivity(f):
        z = np.exp(2j * np.pi * f * period)
        return 1 / (1 + kt / (z * (z - 1)))

    found = axis_margins(grid, np.array([sensitivity(f) for f in grid]), sensitivity)
    assert found.gain_margin == pytest.approx(1 / kt, rel=1e-6)
    assert found.gain_reduction == 0.0
    crossing = 2 * np.arcsin(kt / 2)  # of |L| = 1
    assert found.phase_margin_rad == pytest.approx(np.pi / 2 - 1.5 * crossing, rel=1e-6)
    assert found.delay_margin_s == pytest.approx((np.pi / 2 - 1.5 * crossing) / crossing * period, rel=1e-6)


# -- margins against the eigenvalues of loops that have used them up --------------------------------------------------


@pytest.mark.parametrize(("bus_name", "strokes_m"), [("fd_5k", MIDDLE), ("fd_5k", OFF_CENTRE), ("local_20k", MIDDLE)])
def test_the_default_laws_margins_are_where_stability_ends(bus_name, strokes_m):
    """Gain and phase of one measurement, the others as they are; a phase is a complex factor on it."""
    p, k = plant(bus_name, strokes_m), lqg(bus_name, strokes_m)
    found = margins(p, k)
    assert found.stable
    for i, axis in enumerate(found.axes):
        for just, stable in ((0.999, True), (1.001, False)):
            factors = np.ones(3, complex)
            factors[i] = axis.gain_margin**just
            assert (radius_with_factors(p, k, factors) < 1.0) == stable
            turns = []
            for sign in (-1, 1):
                factors[i] = np.exp(1j * sign * axis.phase_margin_rad * just)
                turns.append(radius_with_factors(p, k, factors) < 1.0)
            assert all(turns) == stable


def test_every_factor_within_the_disk_is_borne_and_one_on_it_is_not():
    """Of the three measurements at once: random ones within, and the worst ones, found by search, on the edge."""
    p, k = plant(strokes_m=OFF_CENTRE), lqg(strokes_m=OFF_CENTRE)
    alpha, rng = margins(p, k).mimo.disk_margin, np.random.default_rng(7)
    for _ in range(300):
        delta = alpha * 0.999 * np.exp(2j * np.pi * rng.random(3))
        assert radius_with_factors(p, k, (1 + delta / 2) / (1 - delta / 2)) < 1.0
    frequency = frequency_grid_hz(p, k, 3000)
    s = loop_response(p, k, frequency).s
    at = s[np.argmax(np.linalg.norm(s - np.eye(3) / 2, 2, axis=(1, 2)))] - np.eye(3) / 2
    worst = 0.0
    for phases in rng.random((4000, 2)):
        delta = np.exp(2j * np.pi * np.append(phases, 0.0))
        worst = max(worst, np.abs(np.linalg.eigvals(at * delta)).max())
    assert 0.98 / worst < alpha * 1.02
    assert alpha <= 1 / worst * 1.0001  # the search finds no smaller one than the least


@settings(max_examples=6)
@given(st.integers(0, 10_000))
def test_the_structured_norm_is_the_largest_radius_over_all_phases(seed):
    """mu = max over diagonal unitary U of rho(U M): a lower bound that is reached, against the upper one."""
    rng = np.random.default_rng(seed)
    m = rng.normal(size=(3, 3)) + 1j * rng.normal(size=(3, 3))

    def minus_radius(phases):
        return -np.abs(np.linalg.eigvals(np.exp(1j * np.append(phases, 0.0))[:, None] * m)).max()

    starts = sorted((rng.random((60, 2)) * 2 * np.pi).tolist(), key=minus_radius)[:6]
    best = max(-scipy.optimize.minimize(minus_radius, x, method="Nelder-Mead").fun for x in starts)
    assert best <= structured_norm(m) * (1 + 1e-6)
    assert structured_norm(m) == pytest.approx(best, rel=1e-3)
    assert structured_norm(m) <= np.linalg.norm(m, 2) * (1 + 1e-9)


def test_mimo_figures_are_those_of_a_dense_sweep():
    p, k = plant(strokes_m=OFF_CENTRE), lqg(strokes_m=OFF_CENTRE)
    found, frequency = margins(p, k).mimo, np.linspace(0.5, 2500.0, 12_500)
    size = np.linalg.norm(loop_response(p, k, frequency).s, 2, axis=(1, 2))
    assert found.peak_s == pytest.approx(size.max(), rel=1e-5)
    assert found.bandwidth_hz == pytest.approx(frequency[np.argmax(size >= HALF_POWER)], abs=0.21)


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_the_sensitivity_of_many_frequencies_is_the_inverse_of_one_and_the_loop(seed):
    """By the Schur form against (I + L)^-1 from two linear systems; and its poles against the eigenvalues."""
    tolerances = load("tolerances", "wide", Tolerances).sample(seed)
    p = plant(strokes_m=tolerances.strokes_m, perturbation=tolerances.perturbation)
    k = lqg_equivalent(stage(), law(), tolerances.strokes_m, tolerances.perturbation)
    f = frequency_grid_hz(p, k, 100)[:-1]
    found = Sensitivity(p, k)
    assert np.abs(found(f) - loop_response(p, k, f).s).max() < 1e-9
    assert found(np.empty(0)).shape == (0, 3, 3)
    assert found.spectral_radius == pytest.approx(spectral_radius(p, k), rel=1e-9)
    size = largest_singular_value(found(f))
    assert size == pytest.approx(np.linalg.norm(found(f), 2, axis=(1, 2)), rel=1e-7)


def test_an_unstable_loop_has_no_margins():
    k = lqg()
    found = margins(plant(), DiscreteLaw(k.period_s, k.a, k.b, -k.c, -k.d))
    assert not found.stable
    assert found.spectral_radius > 1.0
    assert found.mimo.disk_margin == found.axes[0].phase_margin_rad == found.mimo.bandwidth_hz == 0.0
    assert found.mimo.peak_s == np.inf


def test_another_bus_is_another_law():
    with pytest.raises(LawError, match="period of 200 us and the bus 50 us"):
        closed_loop(plant("local_20k"), lqg())


# -- the default law's linear equivalent ------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "delay_periods"), [("lqg", 1), ("lqg", 2), ("youla", 1)])
@pytest.mark.parametrize("strokes_m", [MIDDLE, OFF_CENTRE])
def test_the_linear_equivalent_is_what_the_tick_does(name, delay_periods, strokes_m):
    """80 ticks of the compiled tick on random measurements of 1 nm, with counts 50 000 times finer: the force that
    it asks for beyond the one that holds, to 1e-3.
    """
    shipped = load("controllers", name, ControllerConfig).model_copy(update={"learn": "off"})  # learning is not linear
    designed = design_law(stage(), shipped, bus("fd_5k", delay_periods), autostart=True)
    expected = lqg_equivalent(stage(), designed, strokes_m)
    numbers = designed["tick"].copy()[0]
    numbers["drive"]["volt_per_count"] /= 50_000
    numbers["drive"]["count_max"], numbers["drive"]["count_slew_max"] = 2**31 - 2, 2**30  # and one more is a count
    numbers["drive"]["noise_shaping"] = 0
    memory, at = new_tick_memory(), stage().forward_kinematics(strokes_m)
    memory["count"][:] = np.round(stage().holding_voltages(at) / numbers["drive"]["volt_per_count"])
    tick.set_position(numbers, memory, at)
    memory["set_point_model"]["applied_n"][:] = stage().holding_forces(at)
    row = np.r_[at, np.zeros(6)]
    state, rng = np.zeros(expected.order), np.random.default_rng(2)
    holding = stage().energy_gradient(at)
    asked, linear = [], []
    for _ in range(80):
        y = rng.normal(size=3) * 1e-9
        memory["measurement_m"][:] = at + y
        tick.estimate(numbers, memory, True)
        assert not tick.act(numbers, memory, row, row, row)
        asked.append(memory["demand_n"] - holding)
        linear.append(-(expected.c @ state + expected.d @ y))
        state = expected.a @ state + expected.b @ y
    assert np.array(linear) == pytest.approx(np.array(asked), rel=0, abs=1e-3 * np.abs(asked).max())
    assert np.abs(asked).max() > 1e-9


def test_the_default_laws_margins():
    """As shipped, on the default bus; docs/understand/margins.md has these figures."""
    found = margins(plant(), lqg())
    assert found.mimo.peak_s < 2.0
    assert found.mimo.disk_margin > 0.6
    assert spectral_radius(plant(), lqg()) < 1.0


def test_hold_noise_is_that_of_the_running_loop():
    """Solved against the fast lane's true position in the last 70 ms of the default scenario, all axes together."""
    run = setup()
    rows, _ = rows_of(run, "fast")
    held = rows[rows["t_us"] > 1_100_000 - 70_000]
    strokes = stage().inverse_kinematics(held["reference_m"][-1])
    solved = hold_noise_m(stage(), bus(), plant(strokes_m=strokes), lqg(strokes_m=strokes))
    seen = (held["position_m"] - held["reference_m"]).std(axis=0)
    assert 0.75 < np.sqrt((seen**2).mean() / (solved**2).mean()) < 1.25
