"""What a run has learnt of its device, kept for the next one; and what has changed, in words."""

import json

import numpy as np
import pytest

from hil.lanes.lane import Lane
from hil.recording.recording import Recording
from hil.runs.adapted import begun_with
from hil.runs.replay import replay
from hil.runs.run import run_into
from hil.runs.run_folder import RunFolder
from hil.runs.scenario import load_scenario
from hil.runs.warnings import Warnings, in_words
from pkxyz_ctrl.config.adaptation import NUMBERS
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.core import adaptation
from pkxyz_ctrl.loop.row import ROW

SCENARIO, PLANT = "circle", "mild"


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """The folder of a run on the mild plant that began with nothing, and its summary."""
    folder = RunFolder(tmp_path_factory.mktemp("runs") / "first")
    return folder, run_into(folder, load_scenario(SCENARIO, plant=PLANT), Lane.FAST)


def test_the_numbers_have_names():
    assert len(NUMBERS) == adaptation.PARAMETERS
    assert NUMBERS[adaptation.LINK], NUMBERS[adaptation.DELAY] == ("link_stiffness", "sense_delay_s")


def test_what_is_kept_is_the_device(first):
    """Combs by their ratios and the growth of their pull; signs and sizes are the plant file's."""
    data = json.loads(first[0].adapted.read_text(encoding="utf-8"))
    learnt = data["learnt"]
    assert learnt["fringe"] == pytest.approx(0.01, abs=0.001)
    true = np.array([0.020, -0.010, 0.015]) + 2 * np.array([1.0e-3, -1.0e-3, 0.5e-3])  # combs and amplifier
    found = np.array([learnt[f"comb_gain_{i}"] for i in (1, 2, 3)])
    assert found - found.mean() == pytest.approx(true - true.mean(), abs=0.003)
    assert 0.0 < data["standard_error"]["fringe"] < 0.002
    assert data["provenance"]["plant"] == PLANT


def test_the_next_run_begins_with_it_and_replays_bit_for_bit(first, tmp_path):
    """As the circle begins the first run errs by what it does not know yet, 16 nm; the second as at its end."""
    folder = RunFolder(tmp_path / "second")
    run_into(folder, load_scenario(SCENARIO, plant=PLANT, adapted=first[0].adapted), Lane.FAST)
    early = []
    for kept in (first[0], folder):
        rows = np.concatenate(list(Recording.open(kept.recording).rows(ROW.names)))
        rows = rows[(rows["reference_tick"] >= 880) & (rows["reference_tick"] < 1000)]
        early.append(np.abs(rows["position_m"] - rows["reference_m"]).max())
    assert early[0] > 12e-9
    assert 2e-9 < early[1] < 10e-9
    assert replay(folder.recording).identical
    again = load_scenario(folder.config)
    assert again.controller.adaptation.start is not None


def spoilt(first, tmp_path, **changes):
    data = json.loads(first[0].adapted.read_text(encoding="utf-8"))
    for key, value in changes.items():
        data[key] = data[key] | value if isinstance(value, dict) else value
    path = tmp_path / "adapted.json"
    path.write_text(json.dumps(data), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"learnt": {"comb_gain_1": 0.5}}, "comb_gain_1 = 0.5 is beyond the 0.35"),
        ({"learnt": {"comb_gain_1": None}}, "values"),
        ({"covariance": [[1.0] * 15] * 14}, "covariance"),
        ({"covariance": (-np.eye(15)).tolist()}, "covariance"),
        ({"stage_digest": "0"}, "another stage file"),
        ({"format": "pkxyz learning 1"}, "is not what a run has learnt"),
    ],
)
def test_a_file_that_is_none_is_refused_in_a_line(first, tmp_path, changes, words):
    with pytest.raises(ConfigError, match=words) as refused:
        load_scenario(SCENARIO, plant=PLANT, adapted=spoilt(first, tmp_path, **changes))
    assert "adapted.json" in str(refused.value)


def test_a_device_that_could_not_follow_is_refused(first, tmp_path):
    """Combs 35 % weaker and springs 35 % stiffer than drawn: more than 200 V on the way."""
    weak = {f"comb_gain_{i}": -0.34 for i in (1, 2, 3)} | {"fringe": -0.34}
    stiff = {f"{kind}_stiffness_{i}": 0.34 for kind in ("slider", "crank") for i in (1, 2, 3)} | {
        "link_stiffness": 0.34
    }
    path = spoilt(first, tmp_path, learnt=weak | stiff)
    with pytest.raises(ConfigError, match="cannot follow"):
        load_scenario(SCENARIO, adapted=path)
    loaded = load_scenario(SCENARIO, controller="lqg")
    with pytest.raises(ConfigError, match="does not learn"):
        begun_with(path, loaded.stage, loaded.controller, loaded.bus, loaded.trajectory)


def test_warnings_in_words():
    rows = np.zeros(6, ROW)
    rows["t_us"] = np.arange(6) * 1_000_000
    rows["warning"], rows["warning_share"] = [0, 4, 4, 0, 2, 7], [0.0, -0.011, -0.02, 0.0, 0.03, 0.015]
    found = Warnings()
    for block in (rows[:2], rows[2:]):
        found.update(block)
    assert found.sentences == (
        "at 1.00 s: the springs of chain 1 are 2.0 % softer than they were",
        "at 4.00 s: comb 2 pulls 3.0 % more than it did",
        "at 5.00 s: the out-of-plane hinges are 1.5 % stiffer than they were",
    )
    assert in_words(0, 0.0) == ""
