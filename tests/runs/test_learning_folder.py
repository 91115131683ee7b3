"""A run that learns, from its file to its folder and back: stored, applied, refreshed, played again bit for bit."""

import dataclasses
import json

import pytest
from learning_rig import LINES

from hil.commands.run import learning_of
from hil.lanes.lane import Lane
from hil.pictures.learning import draw_learning
from hil.runs.replay import replay
from hil.runs.run import run_into
from hil.runs.run_folder import RunFolder
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.learning import LearningError
from pkxyz_ctrl.learning.store import load

SCENARIO = f"""
name = "short"
duration_s = 0.75
seed = 3
stage = "reconstructed"
plant = "harsh"
controller = "lqg"
bus = "fd_5k"
[learning]
cutoff_hz = 400.0
[[reference]]
kind = "move"
to_m = [0.0, 0.0, 19.2495e-6]
velocity_max_m_per_s = 1.0e-3
acceleration_max_m_per_s2 = 0.2
jerk_max_m_per_s3 = 50.0
[[reference]]
kind = "hold"
duration_s = 0.05
[[reference]]
kind = "raster"
line_length_m = 10.0e-6
lines = {LINES}
line_pitch_m = PITCH
frames = 6
line_rate_hz = 50.0
velocity_max_m_per_s = 2.0e-3
acceleration_max_m_per_s2 = 1.0
jerk_max_m_per_s3 = 500.0
[checks]
learning_factor = {{ min = 5.0 }}
faults = {{ max = 0 }}
"""


def scenario_file(folder, pitch="0.3e-6"):
    path = folder / "short.toml"
    path.write_text(SCENARIO.replace("PITCH", pitch), encoding="utf-8")
    return path


def run(folder, path, learning=None):
    run_folder = RunFolder(folder)
    scenario = load_scenario(path, learning=learning)
    return run_folder, run_into(run_folder, scenario, Lane.FAST)


@pytest.fixture(scope="module")
def learnt(tmp_path_factory):
    root = tmp_path_factory.mktemp("learn")
    return root, *run(root / "first", scenario_file(root))


def test_the_folder_holds_what_was_learnt_and_how(learnt):
    _, folder, summary = learnt
    assert summary.ok
    learning = summary.learnt
    assert learning.mode == "learn"
    assert learning.stored == "learnt.json"
    assert learning.period_ticks == 100 * LINES
    assert len(learning.figures.periods["sensed_nm"]) == len(learning.figures.periods["line_error_nm"]) == 5
    assert [step["window"] for step in learning.steps] == [0, 1, 2]
    assert json.loads(folder.summary.read_text())["learning_factor"] == summary.learnt.figures.learning_factor
    stored = load(folder.learnt)
    assert stored.harmonics_m.shape == (32, 3)  # 12.5 Hz apart, up to 400 Hz
    assert stored.provenance["plant"] == "harsh"
    assert stored.provenance["digest"] == summary.digest


def test_a_recording_of_it_replays_bit_for_bit(learnt):
    _, folder, _ = learnt
    result = replay(folder.recording)
    assert result.differences == []
    assert result.notes == []


def test_its_correction_is_applied_and_refreshed_and_these_replay_too(learnt):
    root, first, before = learnt
    file = {"file": str(first.learnt)}
    for mode in ("apply", "refresh"):
        folder, summary = run(root / mode, scenario_file(root), {"mode": mode} | file)
        sensed = summary.learnt.figures.periods["sensed_nm"]
        first_nm, *_, last_nm = before.learnt.figures.periods["sensed_nm"]
        assert sensed[0] < 0.2 * first_nm  # with what the way in has stirred up, once
        assert 0.7 * last_nm < max(sensed[1:]) < 1.4 * last_nm
        assert (summary.learnt.stored is None) == (mode == "apply")
        assert (folder.path / "learnt_from.json").read_bytes() == first.learnt.read_bytes()
        result = replay(folder.recording)
        assert result.differences == []
        assert result.notes == []


def test_a_file_of_another_scan_is_refused_before_anything_moves(learnt):
    root, first, _ = learnt
    other = root / "other"
    other.mkdir()
    with pytest.raises(LearningError, match=r"learnt\.json: belongs to another trajectory: .* um away"):
        load_scenario(scenario_file(other, "0.2e-6"), learning={"mode": "apply", "file": str(first.learnt)})


def test_the_picture_is_drawn(learnt):
    _, folder, summary = learnt
    draw_learning(folder.recording, summary, folder.learning_picture)
    assert folder.learning_picture.read_bytes().startswith(b"\x89PNG")


def test_options_say_one_thing():
    assert learning_of(False, None, None) is None
    assert learning_of(True, None, None) == {"mode": "learn"}
    assert learning_of(False, None, "a.json") == {"mode": "refresh", "file": "a.json"}
    with pytest.raises(ConfigError, match="give one of them"):
        learning_of(True, "a.json", None)


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        (lambda cosine: cosine[0].__setitem__(0, 1e-3), "1 mm"),
        (lambda cosine: cosine[2].__setitem__(2, 13e-6), "a stroke"),
        (lambda cosine: cosine[-1].__setitem__(0, 9e-6), "a stroke, at 400 Hz"),
    ],
)
def test_a_correction_that_the_stage_cannot_follow_is_refused_before_anything_moves(learnt, tmp_path, changed, why):
    """Whoever can hand over a file could else drive the stage into its stop: the 1 mm of issue 15."""
    root, folder, _ = learnt
    data = json.loads(folder.learnt.read_text())
    changed(data["cosine_m"])
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(data))
    with pytest.raises(
        LearningError, match=r"mine\.json: the stored correction carries the scan beyond what the stage"
    ):
        load_scenario(root / "short.toml", learning={"mode": "apply", "file": str(path)})
    scenario = load_scenario(root / "short.toml", learning={"mode": "apply", "file": str(folder.learnt)})
    handed_over = dataclasses.replace(scenario.setup(), stored=load(path))
    with pytest.raises(LearningError, match="carries the scan beyond"):
        handed_over.new_learner()
