"""What a filter that knew the parasitic modes would be worth: the least hold, Ms, and sampled devices.

The modes are those of the plant lab, each as strong along every axis as its share says, which is more than its shape
leaves of it. Only forces drive them, so that a filter that knows both sees a sample without them.
"""

import dataclasses
from functools import cache

import numpy as np
import pytest
import scipy.linalg
from loop_rig import MIDDLE, bus, stage

from hil.studies.margins.loop import Loop
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.design.hold_floor import hold_floor_m
from pkxyz_ctrl.design.hold_noise import hold_noise_m
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.law_about import law_about
from pkxyz_ctrl.design.laws.estimator_gain import measurement_noise, shaken_covariance
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.design.model.loop_plant import NOMINAL, ParasiticMode, Perturbation, loop_plant
from pkxyz_ctrl.design.model.plant_model import linearise
from sim.config import PlantConfig

SHAKEN_M_PER_S2 = 98.1e-6
PERIOD_S = 2e-4
MODES = tuple(
    ParasiticMode(m.frequency_hz, m.quality_factor, m.compliance_share)
    for m in load("plants", "lab", PlantConfig).flexible_modes.modes
)


def in_nm(name, modes, axis):
    """A, B and C of an axis in nm, nm a period and what holds a nanometre; what shakes it (n,n), a sample's noise."""
    device, model = stage(name), linearise(stage(name), MIDDLE)
    one = loop_plant(device, bus(), MIDDLE, Perturbation(parasitic=modes)).axis(axis)
    k = one.stiffness_n_per_m[0, 0]
    motion = [1e9, 1e9 * PERIOD_S]
    lag = [1e9] if device.sense_delay_s else []
    unit = np.array([*motion, 1e9 / k, *(motion * len(modes)), *lag, 1e9 / k])
    shaken = np.zeros((len(unit), len(unit)))
    covariance = shaken_covariance(model, model.mass_kg * SHAKEN_M_PER_S2, PERIOD_S)[axis::3, axis::3]
    shaken[:2, :2] = covariance * np.outer(motion, motion)
    noise = 1e18 * measurement_noise(device, model, bus())[axis, axis]
    return unit[:, None] * one.a / unit, unit[:, None] * one.b * k * 1e-9, one.c / unit * 1e9, shaken, noise


def least_law(a, b, c, shaken, noise):
    """Filter and regulator that leave the least of the position, as A, B, C and D from measurement to force."""
    n, weight = len(a), np.zeros_like(a)
    weight[0, 0] = 1.0
    spread = scipy.linalg.solve_discrete_are(a.T, c.T, shaken + 1e-14 * np.eye(n), [[noise]])
    gain = spread @ c.T / (c @ spread @ c.T + noise)
    cost = scipy.linalg.solve_discrete_are(a, b, weight + 1e-12 * np.eye(n), [[1e-8]])
    back = np.linalg.solve(b.T @ cost @ b + 1e-8, b.T @ cost @ a)
    seen = np.eye(n) - gain @ c
    return (a - b @ back) @ seen, (a - b @ back) @ gain, back @ seen, back @ gain


def left(plant, law):
    """Deviation of the position in nm, and Ms, of a law on a plant."""
    (a, b, c, shaken, noise), (la, lb, lc, ld) = plant, law
    loop, enters = np.block([[a - b @ ld @ c, -b @ lc], [lb @ c, la]]), np.vstack([-b @ ld, lb])
    assert np.abs(np.linalg.eigvals(loop)).max() < 1.0
    added = noise * enters @ enters.T
    added[: len(a), : len(a)] += shaken
    poles, turn = np.linalg.eig(loop)
    shown, entered = (c @ turn[: len(a)])[0], np.linalg.solve(turn, enters)[:, 0]
    z = np.exp(1j * np.pi * np.linspace(1e-3, 1.0, 4000))
    s = 1.0 + (shown * entered / (z[:, None] - poles)).sum(axis=1)
    return np.sqrt(scipy.linalg.solve_discrete_lyapunov(loop, added)[0, 0]), np.abs(s).max()


def known_and_ours(name, modes, axis):
    """Deviation and Ms on the plant with the modes: by the law that knows them, and by the one that does not."""
    plant = in_nm(name, modes, axis)
    return left(plant, least_law(*plant)), left(plant, least_law(*in_nm(name, (), axis)))


@pytest.mark.parametrize("name", ["reconstructed", "lab"])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_least_hold_is_that_of_a_filter_that_knows_them(name, axis):
    (known_nm, known_s), (ours_nm, ours_s) = known_and_ours(name, MODES, axis)
    assert known_nm == pytest.approx(1e9 * hold_floor_m(stage(name), bus(), MIDDLE, SHAKEN_M_PER_S2)[axis], rel=1e-4)
    assert ours_nm == pytest.approx(known_nm, rel=1e-5)
    assert ours_s == pytest.approx(known_s, abs=1e-3)
    assert ours_s < 1.15


@cache
def default_loop(name):
    law = design_law(stage(name), load("controllers", "youla", ControllerConfig), bus(), autostart=True)
    return Loop(stage(name), bus(), law)


@pytest.mark.parametrize("name", ["reconstructed", "lab"])
def test_the_default_law_holds_and_rejects_on_them_as_without(name):
    """Which is what it would do if its filter knew them: 0.1 % of a hold, 0.002 of Ms."""
    loop, found = default_loop(name), []
    for change in (NOMINAL, Perturbation(parasitic=MODES)):
        held_m = hold_noise_m(
            loop.stage, bus(), loop_plant(loop.stage, bus(), MIDDLE, change),
            law_about(loop.stage, loop.law, MIDDLE, change),
        )  # fmt: skip
        margins = loop.margins(MIDDLE, change)
        found.append((held_m, [each.peak_s for each in margins.axes], [each.bandwidth_hz for each in margins.axes]))
    without, with_modes = found
    assert with_modes[0] == pytest.approx(without[0], rel=0.001)
    assert with_modes[1] == pytest.approx(without[1], abs=0.002)
    assert with_modes[2] == pytest.approx(without[2], rel=0.001)
    assert (with_modes[0] != without[0]).all()


def test_modes_a_hundred_times_as_strong_would_be_worth_knowing():
    strong = tuple(dataclasses.replace(m, compliance_share=100.0 * m.compliance_share) for m in MODES)
    (known_nm, _), (ours_nm, _) = known_and_ours("reconstructed", strong, 0)
    assert ours_nm > 1.001 * known_nm
    assert not default_loop("reconstructed").margins(MIDDLE, Perturbation(parasitic=strong)).stable


@pytest.mark.slow
def test_sampled_devices_would_be_no_better_off():
    """500 of them under the default law, each with its two modes and without: Ms at 95 %, 2.72, and the worst, 3.67."""
    loop, tolerances, peaks = default_loop("reconstructed"), load("tolerances", "wide", Tolerances), []
    for seed in range(1, 501):
        case = tolerances.sample(seed)
        bare = dataclasses.replace(case, perturbation=dataclasses.replace(case.perturbation, parasitic=()))
        peaks.append([loop.peak_sensitivity(case), loop.peak_sensitivity(bare)])
    with_modes, without = np.array(peaks).T
    assert np.percentile(with_modes, 95) == pytest.approx(2.72, abs=0.01)
    assert np.percentile(without, 95) == pytest.approx(np.percentile(with_modes, 95), rel=0.001)
    assert without.max() == pytest.approx(with_modes.max(), rel=0.001)
