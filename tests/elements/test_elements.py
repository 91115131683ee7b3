"""Flexures and combs: each formula against its law or plain arithmetic."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pkxyz_ctrl.elements import combs, flexures
from pkxyz_ctrl.stage import Stage

MODEST = settings(max_examples=60)


def test_folded_spring_is_two_pairs_of_beams_in_series() -> None:
    """Eq. 25 twice for each length, in series: 2.9398 N/m, 44938 times that across."""
    f = Stage.load("reconstructed").config.flexures
    beams = [
        flexures.clamped_beam_stiffness(f.youngs_modulus_pa, f.leaf_height_m, f.leaf_thickness_m, length)
        for length in (f.leaf_inner_length_m, f.leaf_outer_length_m)
    ]
    along, across = (1 / sum(1 / (2 * pair[axis]) for pair in beams) for axis in (0, 1))
    assert flexures.folded_spring_stiffness(f) == pytest.approx(along, rel=1e-14)
    assert flexures.folded_spring_lateral_stiffness(f) == pytest.approx(across, rel=1e-14)
    assert along == pytest.approx(2.93984, rel=1e-5)
    assert across / along == pytest.approx((1.375**3 + 1.895**3) / (1.375 + 1.895) / 0.008**2, rel=1e-12)


def test_beam_against_euler_bernoulli() -> None:
    """A clamped-guided beam has 12 E I / l^3 with I = h t^3 / 12, that is E h t^3 / l^3: Eq. 25 counts two of them."""
    E, h, t, length = 150e9, 90e-6, 8e-6, 1.5e-3
    inertia = h * t**3 / 12
    along, across = flexures.clamped_beam_stiffness(E, h, t, length)
    assert along == pytest.approx(2 * 12 * E * inertia / length**3, rel=1e-14)
    assert across == pytest.approx(2 * E * h * t / length, rel=1e-14)


def test_hinge_range_is_where_the_surface_breaks() -> None:
    """M_max / K (Eq. 29, 30, 32) equals strain at the surface t theta / 2l times E at the strength."""
    f = Stage.load("reconstructed").config.flexures
    for stiffness, limit, width, thickness, length in [
        (flexures.crank_hinge_stiffness(f), flexures.crank_hinge_range_rad(f), f.crank_hinge_height_m, 6e-6, 100e-6),
        (flexures.link_hinge_stiffness(f), flexures.link_hinge_range_rad(f), f.link_hinge_width_m, 10e-6, 100e-6),
    ]:
        moment = flexures.hinge_moment_max_n_m(f.fracture_strength_pa, width, thickness)
        assert moment / stiffness == pytest.approx(limit, rel=1e-12)
        assert f.youngs_modulus_pa * limit * thickness / 2 / length == pytest.approx(f.fracture_strength_pa, rel=1e-12)


@MODEST
@given(st.floats(0, 1.57))
def test_crank_tip_retreat(turn_rad: float) -> None:
    assert flexures.crank_tip_retreat_m(0.5, turn_rad) == pytest.approx(0.5 * (1 - math.cos(turn_rad)), abs=1e-15)


@MODEST
@given(st.floats(0, 1e-2))
def test_voltage_for_force_inverts_equation_33(force_n: float) -> None:
    comb = Stage.load("reconstructed").config.drive_comb
    voltage = combs.voltage_for_force_v(comb, force_n)
    assert combs.force_gain_n_per_v2(comb) * voltage**2 == pytest.approx(force_n, rel=1e-14)
    assert np.isnan(combs.voltage_for_force_v(comb, -1e-9))


@MODEST
@given(st.floats(1e-6, 20e-6), st.floats(1e2, 1e6), st.floats(1, 1e2), st.floats(0, 100e-6))
def test_pull_in_is_where_the_side_stiffness_vanishes(
    gap_m: float, lateral: float, axial: float, overlap_m: float
) -> None:
    stroke = combs.pull_in_stroke_m(gap_m, lateral, axial, overlap_m)
    force = axial * stroke
    assert 2 * force * (overlap_m + stroke) / gap_m**2 == pytest.approx(lateral, rel=1e-9)
    assert stroke >= combs.pull_in_stroke_printed_m(gap_m, lateral, axial, overlap_m) * (1 - 1e-12)
