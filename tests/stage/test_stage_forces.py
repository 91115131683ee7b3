"""Energy, forces and stiffness of the Stage: derivatives of one another, Eq. 19 at rest, virtual work, the comb law."""

import math

import numpy as np
import pytest
from finite_differences import assert_derivative, seeded_points
from hypothesis import given, settings
from hypothesis import strategies as st
from stage_strategies import SHIPPED, any_stage, positions

from pkxyz_ctrl.stage import Stage, StageDomainError

MODEST = settings(max_examples=60)
WORKSPACE = seeded_points(40, [-20e-6, -20e-6, 0.0], [20e-6, 20e-6, 35e-6])


def energy_by_the_book(stage: Stage, position_m: np.ndarray) -> float:
    """2 K1 sum q^2 + 2 K2 sum theta^2 + 2 c K3 (alpha - alpha_0)^2 in plain float64, from the file's dimensions."""
    f = stage.config.flexures
    k1 = (
        4
        * f.youngs_modulus_pa
        * f.leaf_height_m
        * f.leaf_thickness_m**3
        / (f.leaf_inner_length_m**3 + f.leaf_outer_length_m**3)
    )
    k2 = f.youngs_modulus_pa * f.crank_hinge_height_m * f.crank_hinge_thickness_m**3 / 12 / f.crank_hinge_length_m
    k3 = f.youngs_modulus_pa * f.link_hinge_width_m * f.link_hinge_thickness_m**3 / 12 / f.link_hinge_length_m
    z0, l2, l1 = (float(stage.geometry[key][0]) for key in ("height_rest_m", "link_m", "crank_m"))
    total = 2 * f.out_of_plane_chains * k3 * (math.asin((z0 + position_m[2]) / l2) - math.asin(z0 / l2)) ** 2
    for degrees in (90, 210, 330):
        e = np.array([math.cos(math.radians(degrees)), math.sin(math.radians(degrees))])
        across = -e[1] * position_m[0] + e[0] * position_m[1]
        along = float(e @ position_m[:2])
        q = (
            along
            + math.sqrt(l2**2 - z0**2)
            - math.sqrt(l2**2 - (z0 + position_m[2]) ** 2)
            + l1
            - math.sqrt(l1**2 - across**2)
        )
        total += 2 * k1 * q**2 + 2 * k2 * math.asin(across / l1) ** 2
    return total


@MODEST
@given(any_stage(), positions())
def test_energy_is_the_sum_over_the_flexures(stage: Stage, position_m: np.ndarray) -> None:
    # the plain formula loses digits to cancellation: its q is good to 2e-19 m, its energy to 1e-21 J
    assert stage.potential_energy(position_m) == pytest.approx(
        energy_by_the_book(stage, position_m), rel=1e-10, abs=1e-21
    )


@pytest.mark.parametrize("name", SHIPPED)
def test_gradient_of_the_energy(name: str) -> None:
    stage = Stage.load(name)
    assert_derivative(stage.potential_energy, stage.energy_gradient, WORKSPACE, step=2e-6, rtol=1e-10)


@pytest.mark.parametrize("name", SHIPPED)
def test_hessian_of_the_energy(name: str) -> None:
    stage = Stage.load(name)
    assert_derivative(stage.energy_gradient, stage.stiffness, WORKSPACE, step=2e-6, rtol=1e-10)


@settings(max_examples=25)
@given(any_stage(), positions())
def test_derivatives_for_any_geometry(stage: Stage, position_m: np.ndarray) -> None:
    micron_n = 1e-6 * float(np.abs(stage.stiffness(position_m)).max())  # the gradient vanishes at rest
    assert_derivative(stage.potential_energy, stage.energy_gradient, position_m, step=1e-6, rtol=1e-7, floor=micron_n)
    assert_derivative(stage.energy_gradient, stage.stiffness, position_m, step=1e-6, rtol=1e-7)


@MODEST
@given(any_stage(), positions())
def test_stiffness_is_symmetric_and_positive(stage: Stage, position_m: np.ndarray) -> None:
    at_height = stage.stiffness([0.0, 0.0, abs(position_m[2])])
    assert np.array_equal(stage.stiffness(position_m), stage.stiffness(position_m).T)
    assert np.linalg.eigvalsh(at_height)[0] > 0


@MODEST
@given(any_stage())
def test_stiffness_at_rest_is_equation_19(stage: Stage) -> None:
    f = stage.config.flexures
    k1 = (
        4
        * f.youngs_modulus_pa
        * f.leaf_height_m
        * f.leaf_thickness_m**3
        / (f.leaf_inner_length_m**3 + f.leaf_outer_length_m**3)
    )
    k2 = f.youngs_modulus_pa * f.crank_hinge_height_m * f.crank_hinge_thickness_m**3 / 12 / f.crank_hinge_length_m
    k3 = f.youngs_modulus_pa * f.link_hinge_width_m * f.link_hinge_thickness_m**3 / 12 / f.link_hinge_length_m
    alpha, l1, l2 = (float(stage.geometry[key][0]) for key in ("elevation_rest_rad", "crank_m", "link_m"))
    k_xx = 6 * (k1 + k2 / l1**2)
    k_zz = 4 * f.out_of_plane_chains * k3 / (l2 * math.cos(alpha)) ** 2 + 12 * k1 * math.tan(alpha) ** 2
    np.testing.assert_allclose(stage.stiffness(np.zeros(3)), np.diag([k_xx, k_xx, k_zz]), rtol=1e-12, atol=1e-12 * k_zz)


@MODEST
@given(any_stage(), positions(), st.tuples(*[st.floats(-1, 1)] * 3).map(np.array))
def test_holding_forces_do_the_work_of_any_virtual_move(stage: Stage, position_m: np.ndarray, move: np.ndarray) -> None:
    forces = stage.holding_forces(position_m)
    by_combs = forces @ (stage.jacobian(position_m) @ move)
    by_springs = stage.energy_gradient(position_m) @ move
    assert by_combs == pytest.approx(by_springs, rel=1e-11, abs=1e-11 * float(np.abs(forces).sum()))


def test_holding_voltages_hold() -> None:
    stage = Stage.load("reconstructed")
    heights = np.zeros((20, 3))
    heights[:, 2] = np.linspace(0, 25e-6, 20)
    voltages = stage.holding_voltages(heights)
    residual = np.einsum(
        "...ji,...j->...i", stage.jacobian(heights), stage.comb_force(voltages)
    ) - stage.energy_gradient(heights)
    assert np.abs(residual).max() < 1e-15 * 1e3
    assert np.array_equal(voltages[0], np.zeros(3))
    assert (np.diff(voltages[:, 0]) > 0).all()


def test_holding_where_a_comb_would_have_to_push_or_exceed_the_limit() -> None:
    stage = Stage.load("reconstructed")
    with pytest.raises(StageDomainError, match="is a push, and combs only pull"):
        stage.holding_voltages([0.0, 0.0, -1e-6])
    with pytest.raises(StageDomainError, match="beyond the limit of 200 V"):
        stage.holding_voltages([0.0, 0.0, 50e-6])


@MODEST
@given(st.tuples(*[st.floats(-200, 200)] * 3).map(np.array))
def test_comb_law_round_trip_from_voltage(voltage_v: np.ndarray) -> None:
    stage = Stage.load("reconstructed")
    force = stage.comb_force(voltage_v)
    assert (force >= 0).all()
    np.testing.assert_allclose(stage.comb_voltage(force), np.abs(voltage_v), rtol=4e-16, atol=1e-150)


@MODEST
@given(st.tuples(*[st.floats(0, 1)] * 3).map(np.array))
def test_comb_law_round_trip_from_force(fraction: np.ndarray) -> None:
    stage = Stage.load("reconstructed")
    force = fraction * stage.force_max_n
    back = stage.comb_force(stage.comb_voltage(force))
    np.testing.assert_allclose(back, force, rtol=1e-15, atol=0)


def test_comb_law_numbers() -> None:
    """360 fingers, 100 um high, 5 um apart: 1.0774 mN at 130 V (the paper rounds to 1 mN)."""
    stage = Stage.load("reconstructed")
    expected = 360 * 8.8541878128e-12 * 100e-6 / 5e-6 * 130.0**2
    assert float(stage.comb_force(130.0)) == pytest.approx(expected, rel=1e-14)
    assert expected == pytest.approx(1.0774e-3, rel=1e-4)


def test_comb_law_ends_at_the_limit_and_says_so() -> None:
    stage = Stage.load("reconstructed")
    limit = stage.voltage_max_v
    assert float(stage.comb_voltage(stage.comb_force(limit))) == limit
    assert float(stage.comb_voltage(stage.comb_force(-limit))) == limit
    with pytest.raises(StageDomainError, match="beyond the limit of 200 V"):
        stage.comb_force(math.nextafter(limit, math.inf))
    with pytest.raises(StageDomainError, match=r"needs 201\.0 V, beyond the limit of 200 V"):
        stage.comb_voltage(stage.force_gain_n_per_v2 * 201.0**2)
    with pytest.raises(StageDomainError, match="is a push"):
        stage.comb_voltage([-1e-12, 0.0, 0.0])


@MODEST
@given(st.tuples(*[st.floats(-19e-6, 40e-6)] * 3).map(np.array))
def test_sense_round_trip(strokes_m: np.ndarray) -> None:
    stage = Stage.load("reconstructed")
    capacitance = stage.sense_capacitance(strokes_m)
    # 60 um of overlap in double precision: 1.4e-20 m a unit in the last place
    np.testing.assert_allclose(stage.strokes_from_capacitance(capacitance), strokes_m, rtol=0, atol=5e-20)


def test_sense_numbers_and_limits() -> None:
    """2 n eps0 h / g = 127.5 fF/um for the default comb; at rest 20 um of overlap."""
    stage = Stage.load("reconstructed")
    gradient = 2 * 360 * 8.8541878128e-12 * 100 / 5
    np.testing.assert_allclose(stage.sense_capacitance(np.zeros(3)), 20e-6 * gradient, rtol=1e-14)
    assert gradient * 1e15 * 1e-6 == pytest.approx(127.5, rel=1e-4)
    with pytest.raises(StageDomainError, match="leaves the sense comb's overlap of 20 um"):
        stage.sense_capacitance([0.0, 0.0, -20e-6])
    with pytest.raises(StageDomainError, match="no overlap there"):
        stage.strokes_from_capacitance([1e-12, 0.0, 1e-12])
