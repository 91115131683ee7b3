"""Ms without the states of the taps against the whole loop's: values to 1e-5, and stability, also close to its end."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_rig import MIDDLE, bus, stage

from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.design.law import design_law
from pkxyz_ctrl.design.law_about import law_about, law_in_parts
from pkxyz_ctrl.design.margins.margins import margins, peak_sensitivity, spectral_radius
from pkxyz_ctrl.design.margins.sensitivity import Sensitivity
from pkxyz_ctrl.design.margins.tapped import TappedSensitivity
from pkxyz_ctrl.design.margins.tolerances import Tolerances
from pkxyz_ctrl.design.model.discrete_law import LawError, TappedLaw
from pkxyz_ctrl.design.model.loop_plant import NOMINAL, Perturbation, loop_plant

WIDE = load("tolerances", "wide", Tolerances)


@cache
def youla():
    return design_law(stage(), load("controllers", "youla", ControllerConfig), bus(), autostart=True)


def loop(strokes_m=MIDDLE, change=NOMINAL, taps=1.0):
    """A plant with the shipped law of taps, these times a factor."""
    parts = law_in_parts(stage(), youla(), strokes_m, change)
    return loop_plant(stage(), bus(), strokes_m, change), replace(parts, taps=taps * parts.taps)


def stability_ends(change=NOMINAL):
    """Factor of the taps between 1 and 64 up to which the loop of the shipped law is stable, by its eigenvalues."""
    low, high = 1.0, 64.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        p, k = loop(change=change, taps=middle)
        low, high = (middle, high) if spectral_radius(p, k.whole()) < 1.0 else (low, middle)
    return low


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.sampled_from((0.0, 0.5, 1.0, 2.0, 4.0)))
def test_ms_is_that_of_all_margins_and_stable_is_what_its_eigenvalues_say(seed, taps):
    case = WIDE.sample(seed)
    p, parts = loop(case.strokes_m, case.perturbation, taps)
    whole = margins(p, parts.whole())
    found = peak_sensitivity(p, parts)
    assert (found < np.inf) == whole.stable
    assert found == pytest.approx(whole.mimo.peak_s, rel=1e-5)


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_s_is_that_of_the_whole_law_at_every_frequency(seed):
    case = WIDE.sample(seed)
    p, parts = loop(case.strokes_m, case.perturbation)
    f = np.geomspace(0.5, 2500.0, 200)
    assert np.abs(TappedSensitivity(p, parts)(f) - Sensitivity(p, parts.whole())(f)).max() < 1e-9


@pytest.mark.parametrize(
    "change", [Perturbation(stiffness=0.1), Perturbation(quality_factor=200.0, comb_gain=(0.1, 0.1, 0.1))]
)
@pytest.mark.parametrize("closeness", [1e-3, 1e-6])
def test_stability_ends_where_that_of_the_whole_loop_does(change, closeness):
    most = stability_ends(change)
    assert np.isfinite(peak_sensitivity(*loop(change=change, taps=most * (1.0 - closeness))))
    assert peak_sensitivity(*loop(change=change, taps=most * (1.0 + closeness))) == np.inf


def test_a_loop_that_is_unstable_without_its_taps_too_is_unstable():
    p, parts = loop(change=Perturbation(delay_s=350e-6))
    base = parts.law
    assert spectral_radius(p, base) > 1.0
    assert spectral_radius(p, parts.whole()) > 1.0
    assert peak_sensitivity(p, parts) == np.inf


def test_taps_that_make_an_unstable_loop_stable_are_seen_to():
    """The same law apart in another way: too much of its taps inside, and the rest of them less than nothing."""
    change = Perturbation(quality_factor=200.0, comb_gain=(0.1, 0.1, 0.1))
    p, parts = loop(change=change)
    much = 1.5 * stability_ends(change)
    inside = replace(parts, taps=much * parts.taps).whole()
    late = np.zeros((3, inside.order - parts.law.order))
    apart = TappedLaw(inside, np.hstack([parts.seen, late]), (1.0 - much) * parts.taps)
    assert spectral_radius(p, inside) > 1.0
    assert peak_sensitivity(p, apart) == pytest.approx(peak_sensitivity(p, parts), rel=1e-5)


def test_taps_need_a_law_that_is_told_the_force():
    _, parts = loop()
    with pytest.raises(LawError, match="told what force"):
        TappedLaw(replace(parts.law, told_from=None), parts.seen, parts.taps).whole()


def test_a_law_in_parts_is_the_law_about_that_point():
    parts = law_in_parts(stage(), youla(), MIDDLE)
    about = law_about(stage(), youla(), MIDDLE)
    assert all(np.array_equal(getattr(parts.whole(), name), getattr(about, name)) for name in "abcd")
