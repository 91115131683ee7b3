"""The paper's kinematics: the sextic against Newton and against Eq. 5, three Jacobians against finite differences."""

import math

import numpy as np
import pytest
from finite_differences import assert_derivative
from hypothesis import given, settings
from hypothesis import strategies as st
from stage_strategies import any_stage, positions, stage_with

from pkxyz_ctrl.elements.errors import GeometryError, require_positive
from pkxyz_ctrl.mechanics.jacobians import exact_jacobians, joint_angles, nominal_jacobians, stroke_curvature_per_m
from pkxyz_ctrl.mechanics.sextic import (
    appendix_coefficients,
    closure_polynomial,
    link_projections_m,
    position_by_sextic,
    rest_slider_m,
)
from pkxyz_ctrl.stage import Stage

MODEST = settings(max_examples=60)
STROKES = st.tuples(*[st.floats(-5e-6, 25e-6)] * 3).map(np.array)


@MODEST
@given(any_stage(), STROKES)
def test_sextic_and_newton_agree(stage: Stage, strokes_m: np.ndarray) -> None:
    by_root = position_by_sextic(stage.config.geometry, strokes_m)
    # 1e-12 m is asked for
    np.testing.assert_allclose(by_root, stage.forward_kinematics(strokes_m), rtol=0, atol=1e-17)


def open_by(stage: Stage, strokes_m: np.ndarray, delta: complex) -> float:
    """How far Eq. 5 is from closed for a delta, over L1^2: the shadow p of two differences of the three equations
    |p + rho_i e_i| = L1, put into all of them; infinite where it is undefined.
    """
    geometry, e = stage.config.geometry, stage.geometry["e"][0]
    rho = geometry.crank_length_m + geometry.projection_rest_m - strokes_m - delta
    point = rho[:, None] * e
    matrix = 2 * (point[:2] - point[2])
    if abs(np.linalg.det(matrix)) < 1e-6 * geometry.crank_length_m**2:
        return math.inf
    shadow = np.linalg.solve(matrix, rho[2] ** 2 - rho[:2] ** 2)
    return float(np.abs(((point + shadow) ** 2).sum(axis=1) / geometry.crank_length_m**2 - 1).max())


@MODEST
@given(any_stage(), STROKES)
def test_every_root_closes_the_loop_of_equation_5(stage: Stage, strokes_m: np.ndarray) -> None:
    """Each of the six deltas, complex ones too, has a shadow p with (p + rho_i e_i)^2 = L1^2 for the three chains.

    As well as rounding lets it: a root of a polynomial with coefficients rounded by some eps lies off by that over
    the slope, little for the root of the device, a lot for the four that merge at rest.
    """
    geometry = stage.config.geometry
    slope = np.polynomial.Polynomial(closure_polynomial(geometry, strokes_m)).deriv()
    deltas = link_projections_m(geometry, strokes_m)
    assert deltas.shape == (6,)
    closed_to = []
    for delta in deltas:
        tau = 1 + (geometry.projection_rest_m - strokes_m.mean() - delta) / geometry.crank_length_m
        if open_by(stage, strokes_m, delta) == math.inf or slope(tau) == 0:
            continue  # the roots about tau = 0 merge near rest, and their shadow is undefined
        off = 8 * np.finfo(float).eps / abs(slope(tau)) * geometry.crank_length_m
        rounding = max(open_by(stage, strokes_m, delta + shift) for shift in (off, -off)) + 4 * np.finfo(float).eps
        if rounding < 1e-3:
            assert open_by(stage, strokes_m, delta) < rounding
            closed_to.append(rounding)
    assert min(closed_to) < 1e-13  # that of the device


@MODEST
@given(any_stage(), STROKES)
def test_depressed_and_printed_polynomial_are_the_same(stage: Stage, strokes_m: np.ndarray) -> None:
    """Appendix A, expanded in delta in mm, is 16 x 27 L1^6 times the depressed one, at any delta."""
    geometry = stage.config.geometry
    crank_mm = geometry.crank_length_m * 1e3
    sliders_mm = (rest_slider_m(geometry) + strokes_m) * 1e3
    expanded = np.polynomial.Polynomial(appendix_coefficients(geometry.base_radius_m * 1e3, crank_mm, sliders_mm))
    depressed = np.polynomial.Polynomial(closure_polynomial(geometry, strokes_m))
    mean_mm = geometry.base_radius_m * 1e3 - sliders_mm.mean()
    scale = 16 * 27 * crank_mm**6
    for tau in (-1.7, -0.4, 0.3, 0.9, 1.0, 1.6):
        size = float(np.abs(expanded.coef * np.abs(mean_mm - tau * crank_mm) ** np.arange(7)).sum())
        assert expanded(mean_mm - tau * crank_mm) == pytest.approx(scale * depressed(tau), rel=1e-9, abs=1e-14 * size)


def test_appendix_a_is_for_another_radius() -> None:
    """c_6 = 432 and c_5 = -432 (16.24 - 2 sum lambda) as printed, for r = 2 + 1/sqrt(2) mm; r = 2.5 gives 15 in
    place of 16.24.
    """
    at_rest = appendix_coefficients(2 + math.sqrt(0.5), 1.0, [0.0, 0.0, 0.0])
    assert at_rest[6] == 432
    assert at_rest[5] == pytest.approx(-432 * 16.24, rel=2e-4)
    assert appendix_coefficients(2.5, 1.0, [0.0, 0.0, 0.0])[5] == pytest.approx(-432 * 15.0, rel=1e-12)
    moved = appendix_coefficients(2 + math.sqrt(0.5), 1.0, [0.1, 0.2, 0.4])
    assert moved[5] - at_rest[5] == pytest.approx(432 * 2 * 0.7, rel=1e-12)


def test_six_real_roots_generically_and_one_in_reach() -> None:
    stage = Stage.load("reconstructed")
    deltas = link_projections_m(stage.config.geometry, [3e-6, 11e-6, 24e-6])
    assert np.abs(deltas.imag).max() < 1e-12
    assert ((deltas.real > 0) & (deltas.real < stage.geometry["link_m"][0])).sum() == 1


def test_no_root_is_a_named_error_with_the_inequality() -> None:
    geometry = Stage.load("reconstructed").config.geometry
    with pytest.raises(GeometryError, match=r"0 < delta < L2 = 588\.83 um is violated: at strokes"):
        position_by_sextic(geometry, [600e-6, 600e-6, 600e-6])
    with pytest.raises(GeometryError, match="three finite strokes"):
        position_by_sextic(geometry, [0.0, 0.0, math.nan])
    with pytest.raises(GeometryError, match="gap_m > 0 is violated: gap_m = -1"):
        require_positive(gap_m=-1.0)


@settings(max_examples=25)
@given(any_stage(), positions())
def test_crank_and_link_jacobians_are_derivatives_of_the_angles(stage: Stage, position_m: np.ndarray) -> None:
    def crank(x: np.ndarray) -> np.ndarray:
        return joint_angles(stage, x)[0]

    def link(x: np.ndarray) -> np.ndarray:
        return joint_angles(stage, x)[1]

    assert_derivative(crank, lambda x: exact_jacobians(stage, x).crank_rad_per_m, position_m, step=2e-6, rtol=1e-8)
    assert_derivative(link, lambda x: exact_jacobians(stage, x).link_rad_per_m, position_m, step=2e-6, rtol=1e-8)


@settings(max_examples=25)
@given(any_stage(), positions())
def test_curvature_is_the_derivative_of_the_jacobian(stage: Stage, position_m: np.ndarray) -> None:
    assert_derivative(stage.jacobian, lambda x: stroke_curvature_per_m(stage, x), position_m, step=1e-6, rtol=1e-7)


@MODEST
@given(any_stage())
def test_exact_jacobians_at_rest_are_equation_12(stage: Stage) -> None:
    nominal, exact = nominal_jacobians(stage.config.geometry), exact_jacobians(stage, np.zeros(3))
    for by_paper, by_closure in zip(nominal, exact, strict=True):
        np.testing.assert_allclose(by_closure, by_paper, rtol=1e-12, atol=1e-15 * np.abs(by_paper).max())


@MODEST
@given(any_stage())
def test_properties_that_the_paper_lists_below_equation_12(stage: Stage) -> None:
    stroke, crank, link = nominal_jacobians(stage.config.geometry)
    np.testing.assert_allclose(crank.sum(axis=0), 0, atol=1e-12 * np.abs(crank).max())
    np.testing.assert_allclose(stroke.sum(axis=0)[:2], 0, atol=1e-15)
    assert np.ptp(stroke[:, 2]) == 0
    assert np.array_equal(link[:2], [0, 0])


def test_leading_axes() -> None:
    stage = Stage.load("printed")
    points = np.full((2, 4, 3), 5e-6)
    stroke, crank, link = exact_jacobians(stage, points)
    assert (stroke.shape, crank.shape, link.shape) == ((2, 4, 3, 3), (2, 4, 3, 3), (2, 4, 3))
    assert stroke_curvature_per_m(stage, points).shape == (2, 4, 3, 3, 3)
    assert [a.shape for a in joint_angles(stage, points)] == [(2, 4, 3), (2, 4)]


def test_stages_with_a_steep_link_stay_on_their_branch() -> None:
    """A device whose reach above rest is 12 um only: the root sits beside L2's end, and is still found."""
    geometry = {
        "base_radius_m": 2e-3, "crank_length_m": 0.5e-3, "link_length_m": 0.4e-3, "elevation_rest_rad": 1.325,
    }  # fmt: skip
    stage = stage_with(geometry=geometry)
    strokes = stage.inverse_kinematics([1e-6, -2e-6, 11e-6])
    np.testing.assert_allclose(
        position_by_sextic(stage.config.geometry, strokes), [1e-6, -2e-6, 11e-6], rtol=0, atol=1e-15
    )
