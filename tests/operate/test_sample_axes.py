"""The sample's coordinates: as a turn by itself, and in a stage that is operated in them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from operated_rig import MIDDLE_M, OperatedRig, Script, require_smooth

from hil.operate.commands import State, Verb
from hil.operate.sample_axes import PLAIN, SampleAxes, Turn
from pkxyz_ctrl.config.files import ConfigError, parse

NAN = np.nan
micro = st.integers(-20_000, 20_000).map(lambda n: n * 1e-9)
places = st.tuples(micro, micro, micro)
axes = st.builds(
    SampleAxes, origin_m=places, rotation_deg=st.floats(-180, 180), slope_x=st.floats(-0.5, 0.5),
    slope_y=st.floats(-0.5, 0.5), scale=st.tuples(*[st.floats(0.5, 2)] * 3),
)  # fmt: skip


@given(axes, places)
def test_there_and_back_is_the_same_place(axes, place):
    turn = Turn(axes.matrix())
    assert np.allclose(turn.to_sample(turn.to_stage(np.array(place))), place, atol=1e-18)
    there, here = turn.to_stage(np.array([place, (0.0, 0.0, 0.0)]))
    assert np.allclose(there - here, turn.way_to_stage(np.array(place)), atol=1e-20)


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-180, 180))
def test_a_turn_keeps_lengths_and_its_plane_rises_by_its_slopes(slope_x, slope_y, rotation_deg):
    matrix = SampleAxes(slope_x=slope_x, slope_y=slope_y, rotation_deg=rotation_deg).matrix()[:, 0:3]
    assert np.allclose(matrix.T @ matrix, np.eye(3), atol=1e-14)
    assert np.linalg.det(matrix) > 0
    for way in (matrix[:, 0], matrix[:, 1]):  # both lie in the plane z = slope_x x + slope_y y
        assert np.isclose(way[2], slope_x * way[0] + slope_y * way[1], atol=1e-14)


@given(axes, st.lists(st.tuples(micro, micro), min_size=3, max_size=3), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))
def test_the_plane_through_three_points_is_z_of_0(axes, at, slope_x, slope_y):
    points = np.array([(x, y, 5e-6 + slope_x * x + slope_y * y) for x, y in at])
    try:
        found = axes.through(points)
    except ValueError:  # in a line, as an oracle of its own says
        sides = points[:, None, :2] - points[None, :, :2]
        area = abs(np.linalg.det((points[1:] - points[0])[:, :2]))
        assert area < 2.5e-3 * (sides**2).sum(-1).max() or area == 0
        return
    assert np.allclose([found.slope_x, found.slope_y], [slope_x, slope_y], atol=1e-6)
    assert np.abs(Turn(found.matrix()).to_sample(points)[:, 2]).max() < 1e-12
    assert (found.rotation_deg, found.scale, found.origin_m[:2]) == (
        axes.rotation_deg,
        axes.scale,
        axes.origin_m[:2],
    )


def test_a_steep_plane_and_wild_axes_are_refused():
    with pytest.raises(ValueError, match=r"steeper than 0\.5"):
        SampleAxes().through(np.array([(0, 0, 0), (1e-6, 0, 0.6e-6), (0, 1e-6, 0)]))
    with pytest.raises(ConfigError, match="scale"):
        parse({"scale": (1.0, 1.0, 0.0)}, SampleAxes, "the axes")
    for wrong in (np.zeros((3, 4)), PLAIN * np.nan, PLAIN * 100):
        with pytest.raises(ValueError, match="a turn, a scale"):
            Turn(wrong)


def test_a_stage_moves_in_the_coordinates_of_its_sample():
    """Rotated, tilted, scaled and moved: targets, ways, jogs and words are the sample's; the record is the stage's."""
    axes = SampleAxes(
        origin_m=(0.5e-6, -0.3e-6, 18e-6), rotation_deg=90.0, slope_x=0.02, slope_y=-0.01, scale=(1.1, 0.9, 1.0)
    )
    rig, turn = OperatedRig(), Turn(axes.matrix())

    def script() -> Script:
        yield from rig.switched_on()
        before = rig.session.stage.setpoints.target_m.copy()
        assert (yield from rig.do(Verb.SAMPLE, matrix=axes.matrix())) is State.DONE
        assert (rig.session.stage.setpoints.target_m == before).all(), "to look otherwise moves nothing"
        for target in ((2e-6, 0.0, 0.0), (2e-6, 1e-6, 0.5e-6)):
            move = rig.give(Verb.MOVE, target_m=target)
            yield from rig.until_final(move)
            assert rig.state_of(move) is State.DONE
            assert np.allclose(rig.session.stage.setpoints.target_m, turn.to_stage(np.array(target)), atol=1e-18)
        assert rig.words_of(move).startswith("in position at (2, 1, 0.5) um")
        assert (yield from rig.do(Verb.MOVE, relative=1, target_m=(NAN, 1e-6, NAN))) is State.DONE
        assert (yield from rig.do(Verb.MOVE, target_m=(-1e-6, NAN, NAN))) is State.DONE
        there = turn.to_stage(np.array([-1e-6, 2e-6, 0.5e-6]))
        assert np.allclose(rig.session.stage.setpoints.target_m, there, atol=1e-16)
        assert np.allclose(rig.rows[-1]["position_m"], there, atol=10e-9)
        jog = rig.give(Verb.JOG, target_m=(1.0, 0.0, 0.0), velocity_m_per_s=100e-6)
        yield from rig.wait_s(0.02)
        yield from rig.do(Verb.STOP)
        assert rig.state_of(jog) is State.ABORTED
        gone = turn.to_sample(rig.session.stage.setpoints.target_m) - [-1e-6, 2e-6, 0.5e-6]
        assert gone[0] > 1e-6
        assert np.abs(gone[1:]).max() < 1e-9, "each axis of the stage brakes by itself"
        far = rig.give(Verb.MOVE, target_m=(40e-6, 0.0, 0.0))
        yield from rig.until_final(far)
        low, high = rig.reach.range_along(turn.to_stage(np.zeros(3)), 0)
        assert rig.state_of(far) is State.REFUSED
        words = rig.words_of(far)
        assert "x = 40 um is asked for" in words
        assert f"limits {low * 1e6:.4g} to {high * 1e6:.4g} um at y = 0, z = 0 um" in words
        for x, held in ((high - 1e-9, State.DONE), (high + 1e-9, State.REFUSED)):
            assert (yield from rig.do(Verb.MOVE, target_m=(x, 0.0, 0.0))) is held
        assert (yield from rig.do(Verb.SAMPLE, matrix=np.zeros((3, 4)))) is State.REFUSED
        assert (yield from rig.do(Verb.SAMPLE, matrix=PLAIN)) is State.DONE
        assert (yield from rig.do(Verb.MOVE, target_m=MIDDLE_M)) is State.DONE

    rows = rig.play(script())
    require_smooth(rows)
    assert not rig.controller.faults
