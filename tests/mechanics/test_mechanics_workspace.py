"""Workspace, what of it can be held, the cubes inside it, the cost of linear kinematics: Monte Carlo is the oracle."""

import itertools

import numpy as np
import pytest
from finite_differences import seeded_points
from hypothesis import given, settings
from stage_strategies import SHIPPED, any_stage, stage_with

from pkxyz_ctrl.elements.errors import GeometryError
from pkxyz_ctrl.mechanics.inscribed import inscribed_cube, standing_cube_m
from pkxyz_ctrl.mechanics.linearisation import linearisation_study, newton_corrected_m
from pkxyz_ctrl.mechanics.workspace import geometric_volume, held_volume, stroke_box, voltage_needed_v, workspace
from pkxyz_ctrl.stage import Stage

SPAN_M = 25e-6


def by_throwing(stage: Stage, count: int, force_max_n: np.ndarray | float) -> tuple[float, float]:
    """Volume in position space by throwing points into a box around it: no Jacobian, no forward kinematics."""
    limits = stage.config.limits
    low, high = np.array([-20e-6, -22e-6, -9e-6]), np.array([20e-6, 22e-6, 39e-6])
    points = seeded_points(count, low, high, seed=7)
    strokes = stage.inverse_kinematics(points)
    force = stage.holding_forces(points)
    inside = ((strokes >= limits.stroke_min_m) & (strokes <= limits.stroke_max_m)).all(axis=1)
    inside &= np.isinf(force_max_n).all() | ((force >= 0) & (force <= force_max_n)).all(axis=1)
    box = float(np.prod(high - low))
    share = float(inside.mean())
    return box * share, box * float(np.sqrt(share * (1 - share) / count))


@pytest.mark.parametrize("name", SHIPPED)
def test_geometric_volume_against_monte_carlo(name: str) -> None:
    stage = Stage.load(name)
    volume = geometric_volume(stage)
    thrown, sigma = by_throwing(stage, 1_000_000, np.inf)
    assert abs(volume.value_m3 - thrown) < 4 * sigma
    assert sigma < 3.5e-3 * volume.value_m3
    assert volume.error_m3 < 1e-6 * volume.value_m3


@pytest.mark.parametrize(("name", "volume_um3"), [("reconstructed", 8887.09), ("printed", 8142.03)])
def test_geometric_volume_in_numbers(name: str, volume_um3: float) -> None:
    """As a sum of tetrahedra of the true boundary, refined once: an independent figure, good to 1e-4."""
    stage = Stage.load(name)
    assert geometric_volume(stage).value_m3 * 1e18 == pytest.approx(volume_um3, rel=1e-5)
    assert _surface_volume(stage, 24) * 1e18 == pytest.approx(volume_um3, rel=1e-4)


def _surface_volume(stage: Stage, cells: int) -> float:
    """Divergence theorem over the six faces of the stroke cube, each cell two triangles: sum of p.(a x b) / 6."""
    line = np.linspace(0, SPAN_M, cells + 1)
    total = 0.0
    for axis, bound in itertools.product(range(3), (0.0, SPAN_M)):
        u, v = np.meshgrid(line, line, indexing="ij")
        face = np.insert(np.stack([u, v], axis=-1), axis, bound, axis=-1)
        p = stage.forward_kinematics(face)
        a, b, c, d = p[:-1, :-1], p[1:, :-1], p[1:, 1:], p[:-1, 1:]
        flux = sum(
            float(np.einsum("...i,...i->...", r, np.cross(s, t)).sum()) / 6 for r, s, t in ((a, b, c), (a, c, d))
        )
        # (u, v, axis) is a right-handed frame for axes 0 and 2 only; outward is up at the upper bound
        total += flux * (1 if bound else -1) * (-1 if axis == 1 else 1)
    return abs(total)


@pytest.mark.parametrize(
    ("name", "voltage_v"), [("reconstructed", 100.0), ("reconstructed", 130.0), ("printed", 130.0)]
)
def test_held_volume_against_monte_carlo(name: str, voltage_v: float) -> None:
    stage = Stage.load(name)
    volume = held_volume(stage, voltage_v)
    thrown, sigma = by_throwing(stage, 1_000_000, stage.force_gain_n_per_v2 * voltage_v**2)
    assert abs(volume.value_m3 - thrown) < 4 * sigma
    assert volume.error_m3 < 1e-3 * volume.value_m3


def test_at_130_volt_a_fifth_of_the_workspace_can_be_held() -> None:
    for name, share in [("reconstructed", 0.1815), ("printed", 0.2317)]:
        stage = Stage.load(name)
        assert held_volume(stage, 130.0).value_m3 / geometric_volume(stage).value_m3 == pytest.approx(share, abs=1e-4)


def test_all_of_it_above_the_top_corners_voltage_and_the_corner_is_the_worst() -> None:
    for name, volts in [("reconstructed", 181.93), ("printed", 173.54)]:
        stage = Stage.load(name)
        top = float(voltage_needed_v(stage, [SPAN_M] * 3))
        assert top == pytest.approx(volts, abs=0.01)
        assert float(np.max(voltage_needed_v(stage, seeded_points(2000, [0.0] * 3, [SPAN_M] * 3)))) < top
        whole = geometric_volume(stage).value_m3
        assert held_volume(stage, top * 1.001).value_m3 == pytest.approx(whole, rel=1e-9)
        assert held_volume(stage, top * 0.999).value_m3 < whole * (1 - 1e-7)


def test_counting_three_chains_costs_300_volt() -> None:
    stage = stage_with(flexures={"out_of_plane_chains": 3})
    assert float(voltage_needed_v(stage, [SPAN_M] * 3)) == pytest.approx(300, abs=3)


def test_voltage_needed_is_what_the_stage_asks_for() -> None:
    stage = Stage.load("reconstructed")
    strokes = seeded_points(100, [1e-6] * 3, [SPAN_M] * 3)
    asked = stage.holding_voltages(stage.forward_kinematics(strokes)).max(axis=1)
    np.testing.assert_allclose(voltage_needed_v(stage, strokes), asked, rtol=1e-12)
    assert np.isnan(voltage_needed_v(stage, [-1e-6, -1e-6, -1e-6]))


def test_pushes_are_not_held_where_strokes_below_rest_are_allowed() -> None:
    wide = stage_with(limits={"stroke_min_m": -5e-6})
    volume = held_volume(wide, 130.0, cells=64)
    thrown, sigma = by_throwing(wide, 1_000_000, wide.force_gain_n_per_v2 * 130.0**2)
    assert abs(volume.value_m3 - thrown) < 4 * sigma
    assert volume.error_m3 < 1e-3 * volume.value_m3


@settings(max_examples=10)
@given(any_stage())
def test_extents_hold_every_point_and_are_touched(stage: Stage) -> None:
    found = workspace(stage)
    line = np.linspace(0, SPAN_M, 11)
    strokes = np.stack(np.meshgrid(line, line, line), axis=-1).reshape(-1, 3)
    points = stage.forward_kinematics(strokes)
    slack = 1e-12
    assert (points >= found.exact_low_m - slack).all()
    assert (points <= found.exact_high_m + slack).all()
    np.testing.assert_allclose(points.min(axis=0), found.exact_low_m, rtol=0, atol=0.02 * SPAN_M)
    np.testing.assert_allclose(points.max(axis=0), found.exact_high_m, rtol=0, atol=0.02 * SPAN_M)
    assert found.linear_volume_m3 == pytest.approx(found.exact_volume.value_m3, rel=0.05)


@settings(max_examples=8)
@given(any_stage())
def test_inscribed_cubes_fit_and_touch(stage: Stage) -> None:
    for aligned in (False, True):
        cube = inscribed_cube(stage, aligned)
        np.testing.assert_allclose(cube.edges.T @ cube.edges, np.eye(3), rtol=0, atol=1e-12)
        inside = cube.centre_m + cube.side_m * seeded_points(5000, [-0.5] * 3, [0.5] * 3) @ cube.edges.T
        for points in (inside, cube.corners_m()):
            strokes = stage.inverse_kinematics(points)
            assert strokes.min() >= -1e-18  # a corner at rest is 0 up to the rounding of its position
            assert strokes.max() <= SPAN_M + 1e-18
        grown = cube.centre_m + cube.side_m * 1.01 * (cube.corners_m() - cube.centre_m) / cube.side_m
        strokes = stage.inverse_kinematics(grown)
        assert strokes.max() > SPAN_M or strokes.min() < 0


def test_the_cube_of_20_um_that_the_text_asks_for_fits_standing_on_its_corner() -> None:
    turned, aligned = (inscribed_cube(Stage.load("reconstructed"), flat) for flat in (False, True))
    assert turned.side_m * 1e6 == pytest.approx(20.13, abs=0.01)
    assert aligned.side_m * 1e6 == pytest.approx(12.25, abs=0.01)


@settings(max_examples=8)
@given(any_stage())
def test_symmetric_cube_is_nearly_the_inscribed_one(stage: Stage) -> None:
    standing, best = standing_cube_m(stage), inscribed_cube(stage).side_m
    assert standing * (1 - 1e-3) <= best <= standing * 1.01


def test_bad_boxes_name_what_is_violated() -> None:
    with pytest.raises(GeometryError, match=r"links cannot close over strokes 0\.\.600 um"):
        stroke_box(stage_with(limits={"stroke_max_m": 600e-6}))
    with pytest.raises(GeometryError, match="voltage_max_v > 0 is violated"):
        held_volume(Stage.load("reconstructed"), -1.0)


@pytest.mark.parametrize(("name", "z_um", "xy_um"), [("reconstructed", 3.24, 0.14), ("printed", 2.67, 0.14)])
def test_one_constant_jacobian_costs_microns(name: str, z_um: float, xy_um: float) -> None:
    study = linearisation_study(Stage.load(name))
    worst = np.abs(study.at_rest_m).max(axis=0) * 1e6
    assert worst[2] == pytest.approx(z_um, abs=0.1)
    assert worst[:2].max() == pytest.approx(xy_um, abs=0.02)
    assert np.abs(study.newton_m).max() < 23e-9
    assert 1e-9 < study.relinearised_m.max() < 10e-9


def test_study_agrees_with_newton_until_it_stands_still() -> None:
    stage = Stage.load("reconstructed")
    study = linearisation_study(stage, points=5)
    estimate = study.position_m + study.at_rest_m
    for _ in range(4):
        estimate = newton_corrected_m(stage, study.strokes_m, estimate)
    np.testing.assert_allclose(estimate, study.position_m, rtol=0, atol=1e-18)


def test_relinearised_error_is_quadratic_in_the_move() -> None:
    stage = Stage.load("reconstructed")
    one, two = (linearisation_study(stage, points=3, move_m=m).relinearised_m.max() for m in (0.5e-6, 1e-6))
    assert two / one == pytest.approx(4, rel=0.02)
