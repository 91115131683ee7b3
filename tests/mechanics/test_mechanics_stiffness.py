"""Stiffness and modes: each formula against its law, its exact counterpart or plain arithmetic."""

import math

import numpy as np
import pytest
from finite_differences import assert_derivative, seeded_points
from hypothesis import given, settings
from hypothesis import strategies as st
from stage_strategies import SHIPPED, any_stage, positions

from pkxyz_ctrl.elements import flexures
from pkxyz_ctrl.elements.errors import GeometryError
from pkxyz_ctrl.mechanics.jacobians import nominal_jacobians
from pkxyz_ctrl.mechanics.modes import effective_mass_kg, modes, sag_m
from pkxyz_ctrl.mechanics.stiffness import (
    assembled_stiffness_n_per_m,
    comb_stiffness_n_per_m,
    in_plane_stiffness_n_per_m,
    lift_ratio,
    lifting_stiffness_n_per_m,
    nominal_stiffness_n_per_m,
    out_of_plane_stiffness_n_per_m,
    platform_force_n,
    small_signal_stiffness_n_per_m,
    spring_energy_j,
)
from pkxyz_ctrl.stage import Stage

MODEST = settings(max_examples=60)


def test_side_stiffness_against_the_capacitance_of_two_gaps() -> None:
    """2 F y / g^2 from C(s) = n eps0 h y (1/(g-s) + 1/(g+s)) differentiated twice."""
    n, h, g, y, v = 360, 100e-6, 5e-6, 45e-6, 130.0
    gain = n * 8.8541878128e-12 * h

    def side_force(s: np.ndarray) -> np.ndarray:
        return 0.5 * v**2 * gain * y * (1 / (g - s) ** 2 - 1 / (g + s) ** 2)

    force = gain / g * v**2
    assert_derivative(side_force, lambda s: np.array([[2 * force * y / g**2]]), [[0.0]], step=2e-8, rtol=1e-9)


@MODEST
@given(any_stage(), st.sampled_from([1, 3]))
def test_equation_18_is_equation_19(stage: Stage, chains: int) -> None:
    closed, assembled = (f(stage.config, chains) for f in (nominal_stiffness_n_per_m, assembled_stiffness_n_per_m))
    np.testing.assert_allclose(assembled, closed, rtol=1e-12, atol=1e-12 * closed.max())


@MODEST
@given(any_stage())
def test_exact_hessian_at_rest_is_equation_19(stage: Stage) -> None:
    nominal = nominal_stiffness_n_per_m(stage.config)
    np.testing.assert_allclose(stage.stiffness(np.zeros(3)), nominal, rtol=1e-12, atol=1e-12 * nominal.max())


@MODEST
@given(any_stage(), positions())
def test_spring_part_of_the_energy(stage: Stage, position_m: np.ndarray) -> None:
    """Eq. 16 in the exact strokes is what is left of the exact energy when the hinges are taken off."""
    f = stage.config.flexures
    strokes = stage.inverse_kinematics(position_m)
    springs = float(spring_energy_j(flexures.folded_spring_stiffness(f), strokes))
    assert springs == pytest.approx(
        0.5 * stage.elasticity["slider_n_per_m"][0, 0] * float(strokes @ strokes), rel=1e-14
    )
    assert springs <= float(stage.potential_energy(position_m)) * (1 + 1e-12) + 1e-30


@MODEST
@given(any_stage())
def test_lifting_relations(stage: Stage) -> None:
    """Eq. 21, 22 and 24 are one statement: three equal comb forces F lift with 3 F tan(alpha), by q / tan(alpha)."""
    c, f = stage.config, stage.config.flexures
    alpha = math.atan2(c.geometry.height_rest_m, c.geometry.projection_rest_m)
    link = math.hypot(c.geometry.height_rest_m, c.geometry.projection_rest_m)
    k1, k3 = flexures.folded_spring_stiffness(f), flexures.link_hinge_stiffness(f)
    seen = lifting_stiffness_n_per_m(k1, k3, link, alpha, f.out_of_plane_chains)
    k_zz = out_of_plane_stiffness_n_per_m(k1, k3, link, alpha, f.out_of_plane_chains)
    csc = 4 * f.out_of_plane_chains * k3 / (link * math.sin(alpha)) ** 2 / 3 + 4 * k1  # Eq. 24 as printed
    assert seen == pytest.approx(csc, rel=1e-12)
    comb, dz = 1e-3, 1e-3 / seen / lift_ratio(alpha)
    lift = platform_force_n(nominal_jacobians(c.geometry).stroke_m_per_m, [comb] * 3)
    np.testing.assert_allclose(lift, [0, 0, k_zz * dz], rtol=1e-12, atol=1e-12 * comb)
    assert 3 * comb * (comb / seen) == pytest.approx(lift[2] * dz, rel=1e-12)


@settings(max_examples=20)
@given(any_stage(), positions())
def test_comb_stiffness_is_the_derivative_of_the_holding_forces(stage: Stage, position_m: np.ndarray) -> None:
    strokes = stage.inverse_kinematics(position_m)
    assert_derivative(
        lambda q: stage.holding_forces(stage.forward_kinematics(q)),
        lambda q: comb_stiffness_n_per_m(stage, stage.forward_kinematics(q)),
        strokes,
        step=0.5e-6,
        rtol=1e-7,
    )


@settings(max_examples=20)
@given(any_stage(), positions())
def test_small_signal_stiffness_is_that_of_the_energy_less_the_combs_work(stage: Stage, position_m: np.ndarray) -> None:
    force = np.array([0.4e-3, 0.9e-3, 0.1e-3])
    assert_derivative(
        lambda x: stage.energy_gradient(x) - stage.jacobian(x).T @ force,
        lambda x: small_signal_stiffness_n_per_m(stage, x, force),
        position_m,
        step=1e-6,
        rtol=1e-7,
    )


@pytest.mark.parametrize("name", SHIPPED)
def test_held_positions_are_softer_in_the_plane_and_stable(name: str) -> None:
    stage = Stage.load(name)
    strokes = seeded_points(200, [0.0] * 3, [25e-6] * 3)
    points = stage.forward_kinematics(strokes)
    held = small_signal_stiffness_n_per_m(stage, points, stage.holding_forces(points))
    flexible = np.linalg.eigvalsh(stage.stiffness(points))
    stiff = np.linalg.eigvalsh(held)
    assert (stiff[:, 0] < flexible[:, 0]).all()
    assert stiff.min() > 0.5 * flexible.min()


@MODEST
@given(any_stage(), st.floats(1e-7, 1e-4))
def test_modes_solve_the_eigenvalue_problem(stage: Stage, mass_kg: float) -> None:
    stiffness = stage.stiffness([2e-6, 3e-6, 10e-6])
    frequency, shape = modes(stiffness, mass_kg)
    for f, v in zip(frequency, shape.T, strict=True):
        omega2 = (2 * math.pi * f) ** 2
        np.testing.assert_allclose(stiffness @ v, mass_kg * omega2 * v, rtol=0, atol=1e-9 * float(stiffness.max()))
    assert (np.diff(frequency) >= 0).all()
    assert effective_mass_kg(float(np.linalg.eigvalsh(stiffness)[2]), float(frequency[2])) == pytest.approx(
        mass_kg, rel=1e-9
    )


def test_sag_points_down_and_balances_the_weight() -> None:
    stage = Stage.load("reconstructed")
    stiffness = nominal_stiffness_n_per_m(stage.config)
    sag = sag_m(stiffness, 4.833e-6)
    assert sag[2] == pytest.approx(-4.833e-6 * 9.80665 / 113.6485, rel=1e-6)
    assert np.array_equal(sag[:2], [0, 0])
    on_its_side = sag_m(stiffness, 4.833e-6, (1.0, 0.0, 0.0))
    assert on_its_side[0] == pytest.approx(-4.833e-6 * 9.80665 / 75.95902, rel=1e-6)


def test_bad_dimensions_name_the_inequality() -> None:
    with pytest.raises(GeometryError, match="thickness_m > 0 is violated: thickness_m = -8e-06"):
        flexures.clamped_beam_stiffness(150e9, 90e-6, -8e-6, 1.5e-3)
    with pytest.raises(GeometryError, match="crank_m > 0 is violated"):
        in_plane_stiffness_n_per_m(1.0, 1.0, 0.0)
    with pytest.raises(GeometryError, match="mass_kg > 0 is violated"):
        modes(np.eye(3), math.nan)
    with pytest.raises(ValueError, match="not positive definite"):
        modes(np.diag([1.0, -1.0, 2.0]), 1.0)
