"""A path before it is followed, as it is drawn."""

import numpy as np

from hil.server.messages import shown
from hil.server.paths import Planner

MIDDLE_M = (0.0, 0.0, 18e-6)


def test_every_line_of_a_long_scan_is_drawn_to_both_of_its_ends():
    limits = {"velocity_max_m_per_s": 0.5e-3, "acceleration_max_m_per_s2": 0.5, "jerk_max_m_per_s3": 300.0}
    scan = {"kind": "raster", "line_length_m": 4e-6, "lines": 100, "line_pitch_m": 20e-9, "line_rate_hz": 8.0, **limits}
    path = Planner("reconstructed", "youla", "fd_5k").of_segments([{"kind": "move", "to_m": MIDDLE_M, **limits}, scan])
    preview = shown(path)
    points, rows = np.array(preview["points_m"]), path.sample(0, path.rows)[:, 0:3]
    assert 1000 < len(points) < len(rows) / 10
    assert np.allclose(points[[0, -1]], rows[[0, -1]], rtol=0, atol=1e-12)
    for drawn, whole in ((preview["low_m"], rows.min(0)), (preview["high_m"], rows.max(0))):
        assert np.allclose(drawn, whole, rtol=0, atol=1e-12)
    turns = np.flatnonzero(np.diff(np.sign(np.diff(rows[:, 0])))) + 1
    assert len(turns) >= 100
    off_m = [np.hypot(*(points[:, 0:2] - end).T).min() for end in rows[turns, 0:2]]
    assert max(off_m) < 1e-9, "each line is drawn to where it turns"
