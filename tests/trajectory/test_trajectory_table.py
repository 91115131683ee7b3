"""Paths from CSV files: what is read, how it is joined to rest, and the line that each mistake gets."""

import hashlib
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from hil.runs.scenario import load_scenario, resolve
from pkxyz_ctrl.config.files import CONFIG_DIR
from pkxyz_ctrl.trajectory import Hold, Move, Table, Trajectory, TrajectoryError
from pkxyz_ctrl.trajectory.table import in_folder

limits = {"velocity_max_m_per_s": 5e-3, "acceleration_max_m_per_s2": 5.0, "jerk_max_m_per_s3": 5000.0}
SCALES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9}
MOVE = Move(kind="move", to_m=(0.0, 0.0, 15e-6), **limits)


def table(folder, text, **changes):
    path = folder / "path.csv"
    path.write_text(text, encoding="utf-8")
    return Table(kind="csv", file=str(path), **{**limits, **changes})


@settings(max_examples=25)
@given(
    st.lists(st.tuples(st.floats(0.004, 0.02), *[st.floats(-0.1, 0.1)] * 3), min_size=4, max_size=20),
    st.floats(-5.0, 5.0),
    st.sampled_from([("s", "m"), ("ms", "um"), ("us", "nm"), ("s", "mm")]),
)
def test_the_path_goes_through_every_row_smoothly_and_starts_and_ends_at_rest(tmp_path_factory, steps, t_0_s, units):
    folder = tmp_path_factory.mktemp("table")
    t_s = t_0_s + np.cumsum([dt for dt, *_ in steps])
    position = 1e-6 * np.cumsum([step for _, *step in steps], axis=0) + (0.0, 0.0, 15e-6)
    of_time, of_length = SCALES[units[0]], SCALES[units[1]]
    rows = np.column_stack([position[:, 2] / of_length, t_s / of_time, position[:, :2] / of_length])
    header = f"z_{units[1]}, t_{units[0]}, x_{units[1]}, y_{units[1]}"
    text = "\n".join([header, *(",".join(map(repr, row)) for row in rows.tolist())])
    segment = table(folder, text)
    trajectory = Trajectory([MOVE, segment, Hold(kind="hold", duration_s=0.01)])
    timed = trajectory.segments[1]
    motions = trajectory._motions[1:]
    for before, after in pairwise(motions):
        jump = np.abs(before.end() - after.sample(np.zeros(1)).reshape(3, 3)).max(axis=1)
        assert np.all(jump < (1e-13, 1e-10, 1e-5))
    # scipy's own evaluation of the spline, at rows and between
    spline = CubicSpline(t_s - t_s[0], position)
    begin_us = timed.scan_us[0]
    for row in (0, len(t_s) // 2, len(t_s) - 2):
        at_us = begin_us + round((t_s[row] - t_s[0]) * 1e6) + 777
        sample = trajectory.sample(at_us, 1, 1)[0]
        at_s = (at_us - begin_us) * 1e-6
        slack_s = 1e-6  # the scan begins between two microseconds
        for order, (of, bound) in enumerate(zip(np.split(sample, 3), (5e-3, 5.0, 5000.0), strict=True)):
            assert np.abs(of - spline(at_s, order)).max() < bound * slack_s + 1e-12
    assert trajectory.sample(timed.t_end_us, 1, 1)[0] == pytest.approx([*position[-1], *[0.0] * 6], abs=1e-12)
    assert timed.source_sha256 == hashlib.sha256(text.encode()).hexdigest()


def test_an_axis_that_is_left_out_stands_still_and_blank_lines_are_no_rows(tmp_path):
    rows = "\n".join(f"{n * 10}, {n * n / 50}" for n in range(11))
    trajectory = Trajectory([MOVE, table(tmp_path, f"t_ms, x_um\n\n{rows}\n\n")])
    begin, end = trajectory.segments[1].scan_us
    assert end - begin == pytest.approx(100_000, abs=2)
    samples = trajectory.sample(begin, end - begin, 1)
    assert np.abs(samples[:, [1, 2]] - (0.0, 15e-6)).max() < 1e-18
    # x = 2 um (t / 100 ms)^2 is a parabola, which a cubic spline repeats exactly
    t_s = np.arange(len(samples)) * 1e-6
    assert samples[:, 0] == pytest.approx(2e-6 * (t_s / 0.1) ** 2, abs=1e-10)
    assert samples[:, 6] == pytest.approx(4e-4, rel=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "needs a header and at least two rows"),
        ("t_s,x_m\n0,0\n", "needs a header and at least two rows"),
        ("t_s,x\n0,0\n1,1e-6\n", "line 1: unknown column 'x'; columns are t_s, .* _m, _mm, _um or _nm"),
        ("t_h,x_m\n0,0\n1,1e-6\n", "line 1: unknown column 't_h'"),
        ("x_m,y_m\n0,0\n1,1e-6\n", "line 1: needs one column of time"),
        ("t_s,x_m,x_um\n0,0,0\n1,1e-6,1\n", "line 1: .*none twice"),
        ("t_s\n0\n1\n", "line 1: needs one column of time and one for each axis"),
        ("t_s,x_m\n0,0\n\n1,one\n", "line 4: could not convert string to float: 'one'"),
        ("t_s,x_m\n0,0\n1,nan\n", "line 3: every number has to be finite"),
        ("t_s,x_m\n0,0\n1,inf\n", "line 3: every number has to be finite"),
        ("t_s,x_m\n0,0\n1,1e-6,3\n", "line 3: has 3 cells, the header 2"),
        ("t_s,x_m\n0,0\n1,1e-6\n1,2e-6\n", "line 4: its time is not after that of the row before"),
        ("t_s,x_m\n0,0\n1,1e-6\n\n0.5,2e-6\n", "line 5: its time is not after"),
        ("t_ms,x_um\n0,0\n1,10\n2,20\n", "line 2: from 0 s after its first row .* needs a velocity of 0.01 m/s,"),
        ("t_ms,x_um\n0,0\n10,0\n20,0\n30,0\n31,2\n32,0\n42,0\n52,0\n", "line [3-6]: .* acceleration of"),
    ],
)  # fmt: skip
def test_each_mistake_in_a_file_gets_a_line_that_names_it(tmp_path, text, message):
    segment = table(tmp_path, text)
    with pytest.raises(TrajectoryError, match=rf"reference\.1 \(csv\): .*path\.csv: {message}") as refused:
        Trajectory([MOVE, segment])
    assert "\n" not in str(refused.value)


def test_files_that_cannot_be_read_are_named(tmp_path):
    with pytest.raises(TrajectoryError, match=r"nowhere\.csv: no such file"):
        Trajectory([Table(kind="csv", file=str(tmp_path / "nowhere.csv"), **limits)])
    with pytest.raises(TrajectoryError, match="cannot be read"):
        Trajectory([Table(kind="csv", file=str(tmp_path), **limits)])
    (tmp_path / "picture.csv").write_bytes(b"\x89PNG\xff\xfe\n" * 9)
    with pytest.raises(TrajectoryError, match="not a CSV file"):
        Trajectory([Table(kind="csv", file=str(tmp_path / "picture.csv"), **limits)])


def test_a_scenario_takes_the_file_from_its_own_folder_and_its_digest_names_the_content(tmp_path, monkeypatch):
    source = CONFIG_DIR / "scenarios" / "path.toml"
    for name in ("path.toml", "path.csv"):
        (tmp_path / name).write_bytes((source.parent / name).read_bytes())
    monkeypatch.chdir(tmp_path.parent)
    shipped, copy = resolve(load_scenario("path")), resolve(load_scenario(tmp_path / "path.toml"))
    assert copy["digest"] == shipped["digest"]
    assert copy["sha256"] == {"reference.4": hashlib.sha256((tmp_path / "path.csv").read_bytes()).hexdigest()}
    lines = (tmp_path / "path.csv").read_text().splitlines()
    (tmp_path / "path.csv").write_text("\n".join(lines) + "\n\n")
    assert resolve(load_scenario(tmp_path / "path.toml"))["digest"] != shipped["digest"]
    held = Hold(kind="hold", duration_s=1.0)
    assert in_folder([held], tmp_path) == [held]
