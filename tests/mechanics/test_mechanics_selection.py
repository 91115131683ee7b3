"""Dimensions from requirements: what is recommended fulfils them, what is refused names constraint and amount."""

import math

import numpy as np
import pytest

from pkxyz_ctrl.config.files import load, parse, plain
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.elements.errors import GeometryError, InfeasibleDesignError
from pkxyz_ctrl.mechanics.inscribed import inscribed_cube
from pkxyz_ctrl.mechanics.modes import modes
from pkxyz_ctrl.mechanics.selection import MARGINS, Requirements, linear_standing_cube_m, margins, select
from pkxyz_ctrl.stage import Stage


@pytest.fixture(scope="module")
def template() -> StageConfig:
    return load("stages", "reconstructed", StageConfig)


NEEDS = [
    Requirements(),
    Requirements(handle_layer_m=500e-6),
    Requirements(stroke_m=12e-6, cube_side_m=9e-6, voltage_max_v=140.0),
]


@pytest.mark.parametrize("need", NEEDS, ids=["paper", "thick handle", "short stroke"])
def test_what_is_recommended_fulfils_the_requirements(need: Requirements, template: StageConfig) -> None:
    chosen = select(need, template)
    stage = Stage(parse(plain(chosen.config), StageConfig, "designed"))
    strokes = np.stack(np.meshgrid(*[np.linspace(0, need.stroke_m, 6)] * 3), axis=-1).reshape(-1, 3)
    stage.holding_voltages(stage.forward_kinematics(strokes))  # raises beyond the voltage limit
    frequency, _ = modes(stage.stiffness(np.zeros(3)), need.mass_kg)
    assert need.frequency_min_hz <= frequency[0]
    assert frequency[2] <= need.frequency_max_hz
    cube = inscribed_cube(stage)
    assert cube.side_m >= need.cube_side_m
    assert chosen.cube_side_m == pytest.approx(cube.side_m, rel=1e-9)
    height = need.handle_layer_m + 2 * need.oxide_m + 10e-6
    assert stage.config.geometry.height_rest_m == pytest.approx(height, rel=1e-12)
    assert stage.config.flexures.leaf_height_m == stage.config.drive_comb.finger_height_m == need.device_layer_1_m
    assert (chosen.margin > 0).all()
    assert 0 < chosen.region.feasible().mean() < 0.5


def test_the_papers_requirements_lead_back_to_its_own_link(template: StageConfig) -> None:
    """L2 = 589 um and alpha_0 = 0.556 rad (printed as 0.6) come out within 1 % of it."""
    geometry = select(Requirements(), template).config.geometry
    link = math.hypot(geometry.projection_rest_m, geometry.height_rest_m)
    assert link == pytest.approx(588.8e-6, rel=0.01)
    assert math.atan2(geometry.height_rest_m, geometry.projection_rest_m) == pytest.approx(0.5564, rel=0.015)


@pytest.mark.parametrize(
    ("need", "message"),
    [
        (Requirements(voltage_max_v=130.0), r"comb force binds: .* 2\.1\d* mN \(191\.8 V\), .*, 1\.14 mN short"),
        (Requirements(cube_side_m=21e-6), r"cube binds: 21 um of cube side asked for, 20\.\d+ there, 0\.6\d* short"),
        (Requirements(frequency_min_hz=900.0), r"lowest frequency binds: 900 Hz asked for, 80\d"),
        (Requirements(device_layer_2_m=5e-6), "layer 2 binds: 10 um for the hinge asked for, 5 there, 5 short"),
        (Requirements(base_radius_m=0.7e-3), "of them bind together: "),
    ],
    ids=["voltage", "cube", "frequency", "layer", "radius"],
)  # fmt: skip
def test_what_cannot_be_had_names_the_constraint_and_the_amount(
    need: Requirements, message: str, template: StageConfig
) -> None:
    with pytest.raises(InfeasibleDesignError, match=message):
        select(need, template, grid=49)


def test_bad_requirements_name_the_inequality() -> None:
    with pytest.raises(GeometryError, match=r"handle_layer_m > 0 is violated: handle_layer_m = -0\.0003"):
        Requirements(handle_layer_m=-300e-6)
    with pytest.raises(InfeasibleDesignError, match="frequency_min_hz < frequency_max_hz is violated: 900 and 600"):
        Requirements(frequency_min_hz=900.0, frequency_max_hz=600.0)


def test_margins_of_the_reconstructed_design(template: StageConfig) -> None:
    found = dict(zip(MARGINS, margins(Requirements(), template, 500e-6, 500e-6), strict=True))
    assert found["lowest frequency"] == pytest.approx(630.96 / 500 - 1, abs=1e-4)
    assert found["highest frequency"] == pytest.approx(1000 / 771.78 - 1, abs=1e-4)
    assert found["comb force"] == pytest.approx(
        (200 / 181.93) ** 2 * 0.9 - 1, abs=2e-4
    )  # 90 um fingers in place of 100
    assert found["cube"] == pytest.approx(20.13 / 20 - 1, abs=1e-3)
    assert found["closure"] == pytest.approx(1000 / 25 - 1, rel=1e-9)


def test_links_that_cannot_close_have_negative_margins(template: StageConfig) -> None:
    found = margins(Requirements(), template, 1.2e-3, 1.0e-3)
    assert found[0] < 0
    assert (found[1:7] == -1).all()


def test_standing_cube_is_largest_where_the_workspace_is_a_cube() -> None:
    """Against brute force over the eight corners: the widest stroke of a standing unit cube, for many slopes."""
    edges = [
        [math.sqrt(2 / 3) * math.cos(a), math.sqrt(2 / 3) * math.sin(a), math.sqrt(1 / 3)]
        for a in (0, 2.0943951, 4.1887902)
    ]
    corners = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)]) @ np.array(edges)
    for slope in np.linspace(0.1, 2, 40):
        stroke = corners @ np.array([1.0, 0.0, slope])
        assert linear_standing_cube_m(float(slope), 1.0) == pytest.approx(1 / np.ptp(stroke), rel=1e-7)
    assert linear_standing_cube_m(math.sqrt(0.5), 25.0) == pytest.approx(25 / math.sqrt(1.5), rel=1e-12)
