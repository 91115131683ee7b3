"""The shipped robust laws against all their goals, over every changed plant, and the search that found them on a small
problem with a known answer.
"""

import numpy as np
import pytest
from loop_rig import MIDDLE, bus, law, stage

from hil.studies.margins.loop import Loop, over_changed_plants
from hil.studies.tune.minimax import AxisLaw, Bounds, _Problem, axis_law, minimax
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.design.hold_noise import hold_noise_m
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.law_about import law_about
from pkxyz_ctrl.design.lqg_equivalent import lqg_equivalent
from pkxyz_ctrl.design.margins.margins import frequency_grid_hz, loop_response
from pkxyz_ctrl.design.margins.sensitivity import closed_loop
from pkxyz_ctrl.design.margins.tolerances import Case, Tolerances
from pkxyz_ctrl.design.model.discrete_law import LawError, response
from pkxyz_ctrl.design.model.loop_plant import LoopPlant, Perturbation, loop_plant


def shipped(name, bus_name):
    designed = design_law(stage(), load("controllers", name, ControllerConfig), bus(bus_name), autostart=True)
    return Loop(stage(), bus(bus_name), designed)


def noise_nm(loop):
    plant = loop_plant(stage(), loop.bus, MIDDLE)
    return hold_noise_m(stage(), loop.bus, plant, law_about(stage(), loop.law, MIDDLE)) * 1e9


def effort(plant, about):
    """Largest |K S| of an axis over the stage's stiffness there."""
    f = np.unique(np.r_[np.linspace(1.0, 2499.9, 5000), frequency_grid_hz(plant, about)])[:-1]
    k = response(about.a, about.b, about.c, about.d, np.exp(2j * np.pi * f * plant.period_s))
    size = np.abs(k @ loop_response(plant, about, f).s).max(axis=0)
    return (np.diag(size) / np.diag(plant.stiffness_n_per_m)).max()


def test_the_robust_law_reaches_200_hz_with_margins_on_every_changed_plant():
    """All the figures that are asked for at once; two-sided, as an unexplained improvement is an error too."""
    loop = shipped("robust", "fd_5k")
    found = loop.margins(MIDDLE)
    for part in (found.mimo, *found.axes):
        assert 200.0 <= part.bandwidth_hz < 215.0
        assert 1.6 < part.peak_s <= 2.0
        assert 0.6 <= part.disk_margin < 0.8
    assert 1.2 < noise_nm(loop).max() <= 1.5
    plant, about = loop_plant(stage(), bus(), MIDDLE), law_about(stage(), loop.law, MIDDLE)
    slowest = np.abs(np.linalg.eigvals(closed_loop(plant, about))).max()
    assert 1e-3 < -bus().period_s / np.log(slowest) <= 2e-3
    assert 6.0 < effort(plant, about) <= 8.2  # between the points of the search's grid it may be a little more
    changed = over_changed_plants(loop, load("tolerances", "wide", Tolerances).cases())
    assert len(changed.peak_s) == 135
    assert 2.4 < changed.worst[1] <= 3.0


def test_the_robust_law_is_stable_on_devices_with_everything_changed_at_once():
    """200 sampled ones, and the ends of the tolerances together: soft, heavy and hardly damped, and the opposite."""
    loop, tolerances = shipped("robust", "fd_5k"), load("tolerances", "wide", Tolerances)
    searched = tolerances.model_copy(
        update={"delay_s": 0.0, "amplifier_bandwidth": 0.0, "sense_bandwidth_hz": None, "parasitic": ()}
    )  # what it was searched for; 50 us of delay to either side came later, and are more than it has margins for
    sampled = [loop.peak_sensitivity(searched.sample(seed)) for seed in range(1, 201)]
    assert max(sampled) < 6.0
    assert 2.5 < np.percentile(sampled, 95) < 3.0
    assert 3.5 < np.percentile([loop.peak_sensitivity(tolerances.sample(seed)) for seed in range(1, 51)], 95) < 8.0
    for sign in (1, -1):
        for comb in (0.1, -0.1):
            change = Perturbation(-0.2 * sign, 0.1 * sign, 200.0, (comb, comb, comb))
            assert loop.peak_sensitivity(Case("ends", MIDDLE, change)) <= 4.1


def test_without_a_bus_the_first_resonance_is_within_the_band():
    found = shipped("robust_20k", "local_20k").margins(MIDDLE)
    for part in (found.mimo, *found.axes):
        assert 631.0 <= part.bandwidth_hz < 900.0
        assert part.peak_s <= 2.0
        assert part.disk_margin >= 0.6


def integrator_behind_a_delay():
    """y(k+1) = y(k) - ... with one period of delay: P = 1 / (z (z - 0.5)), of unit stiffness."""
    a = np.array([[0.5, 1.0], [0.0, 0.0]])
    return LoopPlant(1e-3, a, np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]]), np.zeros(3), np.eye(1))


def test_slopes_are_those_of_the_values():
    """By central differences; noise, effort and ringing included."""
    plants = [loop_plant(stage(), bus(), MIDDLE).axis(0)]
    start = axis_law(lqg_equivalent(stage(), law(), MIDDLE), 0)
    problem = _Problem(plants, Bounds(100.0, 1e-9, 1.6e-9, 3.7e-8, effort=5.0, ring_s=5e-3), [np.array([123.0])], [3.0])
    size = len(start.numerator)
    x = np.concatenate([start.numerator / problem.unit, np.polydiv(start.denominator, [1.0, -1.0])[0][1:]])
    _, slopes = problem.evaluate(x, size)
    for i in range(len(x)):
        h = 1e-6 * np.eye(len(x))[i]
        difference = (problem.evaluate(x + h, size)[0] - problem.evaluate(x - h, size)[0]) / 2e-6
        assert slopes[:, i] == pytest.approx(difference, rel=1e-4, abs=1e-5 * np.abs(slopes[:, i]).max())


def test_the_search_keeps_bounds_that_the_start_does_not():
    """From a timid integrator, K = 0.05 z / (z - 1), to 80 Hz: ten times as far."""
    plant = integrator_behind_a_delay()
    timid = AxisLaw(np.array([0.05, 0.0, 0.0]), np.array([1.0, -1.0, 0.0]))
    bounds = Bounds(80.0, 2e-9, 1e-9, 0.0)
    found, worst = minimax([plant], timid, bounds)
    assert worst <= 0.975
    f = np.linspace(0.5, 499.5, 4000)
    z = np.exp(2j * np.pi * f * 1e-3)
    k = np.polyval(found.numerator, z) / np.polyval(found.denominator, z)
    s = 1 / (1 + k / (z * (z - 0.5)))
    assert np.abs(s).max() <= 2.0
    assert np.abs(s - 0.5).max() <= 1 / 0.6
    assert np.abs(s[f <= 80.0]).max() <= np.sqrt(0.5)
    assert np.sqrt(np.mean(np.abs(1 - s) ** 2)) <= 2.0


def test_the_bounds_on_effort_and_ringing_are_what_the_loop_has():
    """To 45 Hz. Free, the search ends at |K S| = 0.87 with a pole of 190 periods; both are used where nobody asks."""
    plant = integrator_behind_a_delay()
    timid = AxisLaw(np.array([0.05, 0.0, 0.0]), np.array([1.0, -1.0, 0.0]))

    def found(**bounds):
        a_law, worst = minimax([plant], timid, Bounds(45.0, 5e-9, 1e-9, 0.0, **bounds))
        z = np.exp(2j * np.pi * np.linspace(0.5, 499.5, 4000) * 1e-3)
        k = np.polyval(a_law.numerator, z) / np.polyval(a_law.denominator, z)
        poles = np.roots(np.polyadd(np.polymul(a_law.denominator, [1.0, -0.5, 0.0]), a_law.numerator))
        return worst, np.abs(k / (1 + k / (z * (z - 0.5)))).max(), -1.0 / np.log(np.abs(poles).max())

    _, most, slowest = found()
    assert most > 0.7
    assert slowest > 50.0
    worst, most, slowest = found(effort=0.6, ring_s=8e-3)
    assert worst <= 1.05
    assert most <= 0.6 * worst * 1.001
    assert slowest <= 8.0 / (2.0 - worst) * 1.001


def test_starts_that_cannot_be_are_refused():
    plant = integrator_behind_a_delay()
    with pytest.raises(LawError, match="start from a law that all plants are stable with"):
        minimax([plant], AxisLaw(np.array([3.0, 0.0]), np.array([1.0, -1.0])), Bounds(10.0, 1e-9, 1e-9, 0.0))
    coupled = lqg_equivalent(stage(), law(), np.array([7e-6, 15e-6, 11e-6]))
    with pytest.raises(LawError, match="coupled"):
        axis_law(coupled, 0)
