"""Paths that are sent to the desk: where they begin, and what a move behind them starts from."""

import numpy as np
import pytest
from operated_rig import MIDDLE_M, Script, tracked
from test_desk import DeskRig, switched_on

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
