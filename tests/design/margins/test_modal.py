"""A loop by its modes against substitution: the same margins, for devices that are held and those that are not."""

from dataclasses import astuple, replace
from functools import cache

import numpy as np
import pytest
from loop_rig import bus, stage

from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.law_about import law_about, law_in_parts
from pkxyz_ctrl.design.margins import sensitivity
from pkxyz_ctrl.design.margins.margins import margins, peak_and_rejection, peak_sensitivity
from pkxyz_ctrl.design.margins.modal import add_up, split
from pkxyz_ctrl.design.margins.sensitivity import Transfer
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.design.model.loop_plant import loop_plant

WIDE = load("tolerances", "wide", Tolerances)


@cache
def law(name):
    return design_law(stage(), load("controllers", name, ControllerConfig), bus(), autostart=True)


def loops(name, count, about=law_in_parts, taps=1.0):
    """Plants of devices sampled from wide tolerances, with the law about each; its taps times a factor."""
    for seed in range(count):
        case = WIDE.sample(seed)
        parts = about(stage(), law(name), case.strokes_m, case.perturbation)
        parts = replace(parts, taps=taps * parts.taps) if taps != 1.0 else parts
        yield loop_plant(stage(), bus(), case.strokes_m, case.perturbation), parts


def refuse(*_):
    return None


@pytest.mark.parametrize(("name", "taps"), [("youla", 1.0), ("youla", 4.0), ("lqg", 1.0), ("irc", 1.0), ("hinf", 1.0)])
def test_ms_is_that_by_substitution(name, taps, monkeypatch):
    asked = list(loops(name, 40, taps=taps))
    found = [peak_sensitivity(*loop) for loop in asked]
    monkeypatch.setattr(sensitivity, "split", refuse)
    assert found == pytest.approx([peak_sensitivity(*loop) for loop in asked], rel=1e-9)
    if taps > 1.0:
        assert np.isinf(found).any()


@pytest.mark.parametrize("name", ["youla", "lqg", "irc"])
def test_ms_and_rejection_alone_are_those_of_all_margins(name):
    for (plant, in_parts), (_, about) in zip(loops(name, 12), loops(name, 12, law_about), strict=True):
        expected = margins(plant, about).mimo
        assert peak_and_rejection(plant, in_parts) == (
            peak_sensitivity(plant, in_parts), pytest.approx(expected.bandwidth_hz, rel=1e-6)
        )  # fmt: skip
        assert peak_sensitivity(plant, in_parts) == pytest.approx(expected.peak_s, rel=1e-4)


@pytest.mark.parametrize("name", ["youla", "lqg", "irc"])
def test_all_margins_are_those_by_substitution(name, monkeypatch):
    asked = list(loops(name, 6, law_about))
    found = [margins(*loop) for loop in asked]
    monkeypatch.setattr(sensitivity, "split", refuse)
    for one, (plant, about) in zip(found, asked, strict=True):
        expected = margins(plant, about)
        assert one.stable == expected.stable
        for ours, theirs in zip((*one.axes, one.mimo), (*expected.axes, expected.mimo), strict=True):
            assert astuple(ours) == pytest.approx(astuple(theirs), rel=1e-9)


def test_sampled_devices_have_modes_to_go_by():
    assert all(Transfer(*transfer(*loop))._modes is not None for loop in loops("lqg", 20))


def transfer(plant, about):
    """What S is made of, without its own class."""
    n = about.order
    enters, leaves = np.vstack([-plant.b @ about.d, about.b]), np.hstack([plant.c, np.zeros((3, n))])
    return sensitivity.closed_loop(plant, about), enters, leaves, plant.period_s


def random_system(poles, seed=1):
    """A triangle with these poles, and what enters and leaves it."""
    rng = np.random.default_rng(seed)
    n = len(poles)
    triangle = np.triu(rng.normal(size=(n, n)), 1) + np.diag(poles)
    return triangle.astype(complex), rng.normal(size=(n, 2)).astype(complex), rng.normal(size=(3, n)).astype(complex)


def test_terms_add_up_to_the_resolvent_delay_lines_included():
    triangle, enters, leaves = random_system([0.9, 0.0, 0.5 + 0.3j, 0.0, -0.7, 0.0, 1.2])
    modes = split(triangle, enters, leaves)
    z = np.exp(1j * np.linspace(0.01, 3.1, 150))
    found = np.empty((len(z), 3, 2), complex)
    add_up(*modes, z, found)
    expected = [np.eye(3, 2) + leaves @ np.linalg.solve(point * np.eye(7) - triangle, enters) for point in z]
    assert np.abs(found - expected).max() < 1e-11 * np.abs(expected).max()


def test_poles_that_are_one_and_the_same_are_not_split():
    assert split(*random_system([0.9, 0.4, 0.4])) is None
    assert split(*random_system([0.9, *np.zeros(12)])) is None  # a longer delay line than there are powers for


def test_nearly_the_same_poles_go_by_substitution():
    triangle, enters, leaves = random_system([0.9, 0.4, 0.4 + 1e-9])
    transfer = Transfer(triangle.real, enters.real, leaves.real, 1e-3)
    assert transfer._modes is None
    f = np.linspace(1.0, 499.0, 40)
    z = np.exp(2j * np.pi * f * 1e-3)
    expected = [np.eye(3, 2) + leaves @ np.linalg.solve(point * np.eye(3) - triangle, enters) for point in z]
    assert transfer(f) == pytest.approx(np.array(expected), rel=1e-9)
