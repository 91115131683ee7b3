"""Kinematics of the Stage: against Eq. 8 as printed in 50-digit arithmetic, itself and finite differences."""

import math
from decimal import Decimal, localcontext

import numpy as np
import pytest
from finite_differences import assert_derivative, central_differences, seeded_points
from hypothesis import given, settings
from hypothesis import strategies as st
from stage_strategies import SHIPPED, any_stage, positions, stage_with

from pkxyz_ctrl.stage import Stage, StageDomainError

MODEST = settings(max_examples=60)


def printed_equation_8(stage: Stage, position_m: np.ndarray) -> list[Decimal]:
    """Sliders (lambda_1, lambda_2, lambda_3) in m by the paper's Eq. 8, minus sign before the root, Y_A0 outside of it.

    With 50 digits, in the paper's own coordinates (origin at A0) and base points (Eq. 1); no line is the code's own.
    """
    with localcontext() as context:
        context.prec = 50
        record = stage.geometry[0]
        r = Decimal(stage.config.geometry.base_radius_m)
        l1, l2, z0 = (Decimal(float(record[key])) for key in ("crank_m", "link_m", "height_rest_m"))
        half, root3 = Decimal("0.5"), Decimal(3).sqrt()
        xb, yb = root3 / 2 * r, 3 * r / 2
        px, py, pz = (Decimal(float(v)) for v in position_m)
        py, pz = py + r, pz + z0
        down = (l2 * l2 - pz * pz).sqrt()
        first = py - down - (l1 * l1 - px * px).sqrt()
        inner2 = (
            4 * l1**2 - px**2 - 3 * py**2 - 2 * root3 * py * xb - xb**2 + 6 * py * yb + 2 * root3 * xb * yb - 3 * yb**2
        )
        inner2 += 2 * px * (root3 * py + xb - root3 * yb)
        second = half * (-root3 * px - py - 2 * down + root3 * xb + yb) - half * inner2.sqrt()
        xc, yc = -xb, yb
        inner3 = (
            4 * l1**2 - px**2 - 3 * py**2 + 2 * root3 * py * xc - xc**2 + 6 * py * yc - 2 * root3 * xc * yc - 3 * yc**2
        )
        inner3 += 2 * px * (-root3 * py + xc + root3 * yc)
        third = half * (root3 * px - py - 2 * down - root3 * xc + yc) - half * inner3.sqrt()
        return [first, second, third]


@MODEST
@given(any_stage(), positions())
def test_strokes_are_equation_8_relative_to_rest(stage: Stage, position_m: np.ndarray) -> None:
    rest, there = printed_equation_8(stage, np.zeros(3)), printed_equation_8(stage, position_m)
    expected = [float(b - a) for a, b in zip(rest, there, strict=True)]
    # 1e-15 m is asked for; relative to rest the quotients keep about 1e-19
    np.testing.assert_allclose(stage.inverse_kinematics(position_m), expected, rtol=0, atol=1e-18)


@MODEST
@given(any_stage(), positions())
def test_round_trip_from_position(stage: Stage, position_m: np.ndarray) -> None:
    back = stage.forward_kinematics(stage.inverse_kinematics(position_m))
    np.testing.assert_allclose(back, position_m, rtol=0, atol=1e-15)


@MODEST
@given(any_stage(), st.tuples(*[st.floats(-5e-6, 25e-6)] * 3).map(np.array))
def test_round_trip_from_strokes(stage: Stage, strokes_m: np.ndarray) -> None:
    back = stage.inverse_kinematics(stage.forward_kinematics(strokes_m))
    np.testing.assert_allclose(back, strokes_m, rtol=0, atol=1e-15)


@pytest.mark.parametrize("name", SHIPPED)
def test_rest_is_exact(name: str) -> None:
    stage = Stage.load(name)
    assert np.array_equal(stage.inverse_kinematics(np.zeros(3)), np.zeros(3))
    assert np.array_equal(stage.forward_kinematics(np.zeros(3)), np.zeros(3))


@settings(max_examples=25)
@given(any_stage(), positions())
def test_jacobian_is_the_derivative_of_the_strokes(stage: Stage, position_m: np.ndarray) -> None:
    # step 2 um: the shortest length over which q bends is the link's reach, 60 um from the steepest pose
    assert_derivative(stage.inverse_kinematics, stage.jacobian, position_m, step=2e-6, rtol=1e-8)


@pytest.mark.parametrize("name", SHIPPED)
def test_jacobian_to_ten_digits_on_the_shipped_devices(name: str) -> None:
    stage = Stage.load(name)
    points = seeded_points(50, [-20e-6, -20e-6, 0.0], [20e-6, 20e-6, 35e-6])
    assert_derivative(stage.inverse_kinematics, stage.jacobian, points, step=2e-6, rtol=1e-11)


@MODEST
@given(any_stage(), positions())
def test_determinant_of_the_jacobian(stage: Stage, position_m: np.ndarray) -> None:
    """det dq/dx = tan(alpha) times the sum over pairs of e and n rows; on the axis (3 sqrt(3)/2) tan(alpha)."""
    on_axis = np.array([0.0, 0.0, position_m[2]])
    z = stage.geometry["height_rest_m"][0] + position_m[2]
    tan_alpha = math.tan(math.asin(z / stage.geometry["link_m"][0]))
    assert np.linalg.det(stage.jacobian(on_axis)) == pytest.approx(1.5 * math.sqrt(3) * tan_alpha, rel=1e-12)
    assert np.linalg.det(stage.jacobian(position_m)) > 0


def test_third_turn_about_the_axis_permutes_the_chains() -> None:
    stage = Stage.load("reconstructed")
    turn = np.array([[-0.5, -math.sqrt(0.75), 0], [math.sqrt(0.75), -0.5, 0], [0, 0, 1]])
    points = seeded_points(50, [-20e-6, -20e-6, 0.0], [20e-6, 20e-6, 35e-6])
    np.testing.assert_allclose(
        stage.inverse_kinematics(points @ turn.T),
        np.roll(stage.inverse_kinematics(points), 1, axis=-1),
        rtol=0,
        atol=1e-20,
    )


@pytest.mark.parametrize("leading", [(), (1,), (0,), (4,), (2, 3), (2, 1, 3)])
def test_leading_axes(leading: tuple[int, ...]) -> None:
    stage = Stage.load("reconstructed")
    points = seeded_points(max(1, math.prod(leading)), [-9e-6, -9e-6, 5e-6], [9e-6, 9e-6, 20e-6])
    points = points[: math.prod(leading)].reshape(*leading, 3)
    for method, shape in [
        (stage.inverse_kinematics, (3,)),
        (stage.forward_kinematics, (3,)),
        (stage.jacobian, (3, 3)),
        (stage.potential_energy, ()),
        (stage.energy_gradient, (3,)),
        (stage.stiffness, (3, 3)),
        (stage.holding_forces, (3,)),
        (stage.sense_capacitance, (3,)),
    ]:
        out = method(np.abs(points))
        assert out.shape == (*leading, *shape)
        for index in np.ndindex(*leading):
            assert np.array_equal(out[index], method(np.abs(points)[index]))


def test_arguments_are_left_alone() -> None:
    stage = Stage.load("reconstructed")
    point = np.array([1e-6, 2e-6, 12e-6])
    kept = point.copy()
    for method in (
        stage.inverse_kinematics,
        stage.forward_kinematics,
        stage.jacobian,
        stage.stiffness,
        stage.holding_voltages,
    ):
        method(point)
        assert np.array_equal(point, kept)


@pytest.mark.parametrize("chain", [1, 2, 3])
def test_beyond_a_crank_the_error_names_chain_and_length(chain: int) -> None:
    stage = Stage.load("reconstructed")
    along = stage.geometry["n"][0][chain - 1] * 501e-6
    with pytest.raises(StageDomainError, match=f"crank {chain} would have to be longer than 500 um"):
        stage.inverse_kinematics([*along, 0.0])
    stage.inverse_kinematics([*(along * 499 / 501), 0.0])


def test_beyond_the_links_the_error_names_the_height() -> None:
    stage = Stage.load("reconstructed")
    reach = float(stage.geometry["link_m"][0] - 311e-6)
    stage.inverse_kinematics([0.0, 0.0, reach - 1e-9])
    with pytest.raises(StageDomainError, match=r"z must stay between -899\.83 and 277\.83 um"):
        stage.inverse_kinematics([0.0, 0.0, reach])


def test_strokes_that_do_not_close() -> None:
    stage = Stage.load("reconstructed")
    with pytest.raises(StageDomainError, match="links do not close at strokes"):
        stage.forward_kinematics([[0.0, 0.0, 0.0], [600e-6, 600e-6, 600e-6]])


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_never_nan(value: float) -> None:
    stage = Stage.load("reconstructed")
    for name in (
        "inverse_kinematics", "forward_kinematics", "jacobian", "potential_energy", "energy_gradient", "stiffness",
        "holding_forces", "holding_voltages", "sense_capacitance", "strokes_from_capacitance", "comb_force",
        "comb_voltage",
    ):  # fmt: skip
        with pytest.raises(StageDomainError, match="must be finite"):
            getattr(stage, name)([0.0, 0.0, value])


@pytest.mark.parametrize("shape", [(), (2,), (3, 2)])
def test_wrong_shape(shape: tuple[int, ...]) -> None:
    with pytest.raises(StageDomainError, match=r"must have shape \(\.\.\., 3\)"):
        Stage.load("reconstructed").inverse_kinematics(np.zeros(shape))


def test_the_checker_sees_an_error_of_a_millionth() -> None:
    stage = Stage.load("reconstructed")
    with pytest.raises(AssertionError, match="differ by"):
        assert_derivative(
            stage.inverse_kinematics,
            lambda x: stage.jacobian(x) * (1 + 1e-6),
            np.array([1e-6, 2e-6, 9e-6]),
            step=5e-6,
            rtol=1e-10,
        )


def test_the_checker_knows_a_polynomial() -> None:
    numeric = central_differences(lambda x: x**5, [0.7], 0.1)
    assert numeric[0, 0] == pytest.approx(5 * 0.7**4, rel=1e-12)


def test_links_that_cannot_close_at_rest_are_refused() -> None:
    geometry = {
        "base_radius_m": 1.0e-3,
        "crank_length_m": 0.6e-3,
        "link_projection_rest_m": 0.5e-3,
        "link_height_rest_m": 0.3e-3,
    }
    with pytest.raises(ValueError, match="links do not close: base_radius_m must exceed link projection at rest"):
        stage_with(geometry=geometry)
