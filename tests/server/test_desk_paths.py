"""Paths that are sent to the desk: where they begin, and what a move behind them starts from."""

import numpy as np
import pytest
from operated_rig import MIDDLE_M, Script, tracked
from test_desk import DeskRig, switched_on

XYZ = ("x_m", "y_m", "z_m")
LIMITS = {"velocity_max_m_per_s": 0.5e-3, "acceleration_max_m_per_s2": 0.5, "jerk_max_m_per_s3": 300.0}


@pytest.fixture
def rig(tmp_path, monkeypatch):
    return DeskRig(tmp_path, monkeypatch)


def test_a_move_behind_a_path_leaves_axes_where_the_path_ended(rig):
    client = rig.desk.enter()
    there = [{"kind": "move", "to_m": MIDDLE_M, **LIMITS}]
    away = [{"kind": "waypoints", "points_m": [[2e-6, 0, 18e-6], [2e-6, -1e-6, 18.5e-6]], **LIMITS}]

    def script() -> Script:
        yield from switched_on(rig, client)
        answer = yield from rig.finish(client, do="path", segments=there + away)
        assert answer["state"] == "done", answer
        answer = yield from rig.finish(client, do="move", x_m=1e-6)
        assert answer["words"].startswith("in position at (1, -1, 18.5) um"), answer

    reference = tracked(rig.play(script()))["reference_m"]
    assert np.allclose(reference[-1], [1e-6, -1e-6, 18.5e-6], rtol=0.0, atol=1e-15)


SAMPLE = {"origin_m": [0.5e-6, -0.3e-6, 18e-6], "rotation_deg": 90.0, "slope_x": 0.02, "slope_y": -0.01}


@pytest.mark.parametrize("sample", [{}, SAMPLE], ids=["stage", "sample"])
@pytest.mark.parametrize("wait", [[], [{"kind": "hold", "duration_s": 0.01}]], ids=["at once", "after a hold"])
def test_a_path_that_no_move_leads_to_begins_where_the_stage_stands(rig, sample, wait):
    client = rig.desk.enter()
    height_m = 0.0 if sample else MIDDLE_M[2]
    ends = [[2e-6, -1e-6, height_m], [3e-6, 1e-6, height_m]]
    ways = [[*wait, {"kind": "waypoints", "points_m": [end], **LIMITS}] for end in ends]
    begun: list[int] = []

    def script() -> Script:
        yield from switched_on(rig, client)
        if sample:
            assert (yield from rig.finish(client, do="sample", **sample))["state"] == "done"
        stands = np.array([1e-6, 0.5e-6, height_m])
        assert (yield from rig.finish(client, do="move", **dict(zip(XYZ, stands, strict=True))))["state"] == "done"
        begun.append(len(rig.rows))
        for end, way in zip(ends, ways, strict=True):
            rig.ask(client, do="preview", segments=way)
            preview = rig.heard(client)["preview"][-1]
            assert np.allclose(preview["start_m"], stands, rtol=0.0, atol=1e-15)
            answer = yield from rig.finish(client, do="path", segments=way)
            assert answer["state"] == "done", answer
            stands = np.array(end)

    rows = rig.play(script())[begun[0] :]
    reference = rig.desk._planner.turn.to_sample(rows["reference_m"])
    assert np.abs(reference[:, 2] - height_m).max() < 1e-11, "on no way back to the rest pose"
    assert reference[:, 0].min() > 1e-6 - 1e-12
    assert np.allclose(reference[-1], ends[-1], rtol=0.0, atol=1e-15)


def test_a_path_that_a_move_leads_to_begins_there_with_the_same_rows_from_wherever(rig):
    """Also where that is the sample's own origin, or where the stage stands already."""
    client = rig.desk.enter()
    raster = {
        "kind": "raster",
        "line_length_m": 2e-6,
        "lines": 4,
        "line_pitch_m": 0.2e-6,
        "line_rate_hz": 60.0,
        **LIMITS,
    }
    segments = [{"kind": "move", "to_m": (0.0, 0.0, 0.0), **LIMITS}, raster]
    followed: list[np.ndarray] = []

    def script() -> Script:
        yield from switched_on(rig, client)
        assert (yield from rig.finish(client, do="sample", origin_m=MIDDLE_M))["state"] == "done"
        for x_m in (0.0, 1e-6):
            assert (yield from rig.finish(client, do="move", x_m=x_m))["state"] == "done"
            answer = yield from rig.finish(client, do="path", segments=segments)
            assert answer["state"] == "done", answer
            path = rig.desk._planner.of_segments(segments, stands_m=rig.desk.link.stands_m)
            followed.append(path.sample(0, path.rows))

    rig.play(script())
    assert np.array_equal(followed[0][0], [*MIDDLE_M, 0, 0, 0, 0, 0, 0])
    assert np.array_equal(*followed)


def test_a_table_begins_where_the_stage_stands_and_keeps_the_axes_that_it_leaves_out(rig):
    client = rig.desk.enter()
    t = np.linspace(0, 0.05, 26)
    table = "t_s,x_um\n" + "".join(f"{s:.4f},{np.sin(40 * s) ** 2:.6f}\n" for s in t)
    limits = {name.replace("_max", ""): value for name, value in LIMITS.items()}
    begun: list[int] = []

    def script() -> Script:
        yield from switched_on(rig, client)
        begun.append(len(rig.rows))
        answer = yield from rig.finish(client, do="path", table=table, **limits)
        assert answer["state"] == "done", answer

    reference = rig.play(script())[begun[0] :]["reference_m"]
    assert np.abs(reference[:, 1:] - MIDDLE_M[1:]).max() < 1e-15


def test_a_path_is_previewed_from_the_rest_pose_as_long_as_the_loop_is_open(rig):
    client = rig.desk.enter()
    way = [{"kind": "waypoints", "points_m": [MIDDLE_M], **LIMITS}]

    def script() -> Script:
        yield from switched_on(rig, client)
        assert (yield from rig.finish(client, do="disable"))["state"] == "done"
        yield from rig.wait_s(0.002)
        rig.ask(client, do="preview", segments=way)
        assert rig.heard(client)["preview"][-1]["start_m"] == [0.0, 0.0, 0.0]

    rig.play(script())


@pytest.mark.parametrize("led", [True, False])
def test_a_step_of_a_path_that_cannot_be_followed_is_named_with_its_number_and_where(rig, led):
    client = rig.desk.enter()
    there = [{"kind": "move", "to_m": MIDDLE_M, **LIMITS}] if led else []
    steps = [{"kind": "waypoints", "points_m": [[1e-6, 0, 18e-6]], **LIMITS},
             {"kind": "waypoints", "points_m": [[30e-6, 0, 18e-6]], **LIMITS}]  # fmt: skip

    def script() -> Script:
        yield from switched_on(rig, client)
        answer = yield from rig.finish(client, do="path", segments=there + steps)
        assert answer["state"] == "refused"
        assert answer["words"].startswith(
            f"reference.{len(there) + 1} (waypoints from (1, 0, 18) um to (30, 0, 18) um): at its target (30, 0, 18) um"
        ), answer
        assert "coordinates" not in answer["words"]
        assert (yield from rig.finish(client, do="sample", origin_m=MIDDLE_M))["state"] == "done"
        answer = yield from rig.finish(client, do="path", segments=[steps[1] | {"points_m": [[30e-6, 0, 0]]}])
        assert "at its target (30, 0, 18) um" in answer["words"]
        assert answer["words"].endswith("; places are in the stage's coordinates, not in the sample's")
        answer = yield from rig.finish(client, do="path", segments=[steps[1] | {"points_m": [[0, 0, 0]]}])
        assert answer["words"].startswith("reference.0 (waypoints): points_m.0 is where the path already is")
        assert "coordinates" not in answer["words"]

    rig.play(script())
