"""A stored correction in its file: what comes back, and what is refused."""

import json

import numpy as np
import pytest

from pkxyz_ctrl.learning.config import LearningError
from pkxyz_ctrl.learning.store import Belongs, Stored, load, require_same, save

HERE = Belongs(100, 200, np.zeros((64, 3)), {"stage": "a", "bus": "b"})
HARMONICS_M = (np.arange(6.0) - 2.5j).reshape(2, 3) * 1e-9


@pytest.fixture
def path(tmp_path):
    save(Stored(HERE, HARMONICS_M, {"seed": 1}), tmp_path / "learnt.json")
    return tmp_path / "learnt.json"


def test_it_comes_back(path):
    stored = load(path)
    assert np.array_equal(stored.harmonics_m, HARMONICS_M)
    assert stored.provenance == {"seed": 1}
    require_same(stored, HERE, "here")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("marks_m", [[0.0] * 3] * 63),
        ("marks_m", [[0.0] * 2] * 64),
        ("marks_m", [0.0] * 64),
        ("cosine_m", [[0.0, float("nan"), 0.0]] * 2),
        ("sine_m", [[0.0, float("inf"), 0.0]] * 2),
        ("cosine_m", [[0.0] * 3] * 3),
        ("cosine_m sine_m", [[0.0] * 2] * 3),
        ("cosine_m sine_m", [0.0] * 3),
        ("cosine_m sine_m", [[[0.0] * 3] * 3]),
    ],
)
@pytest.mark.filterwarnings("error")
def test_numbers_of_another_shape_or_none_at_all_are_refused(path, key, value):
    data = json.loads(path.read_text()) | dict.fromkeys(key.split(), value)
    path.write_text(json.dumps(data))
    with pytest.raises(LearningError, match=r"learnt\.json: is damaged: .*; learn anew"):
        load(path)


def test_what_is_not_finite_is_not_written(tmp_path):
    with pytest.raises(ValueError, match="Out of range float values"):
        save(Stored(HERE, HARMONICS_M * np.nan, {}), tmp_path / "learnt.json")
    assert not (tmp_path / "learnt.json").exists()


def test_paths_a_picometre_apart_are_one(path):
    near = Belongs(100, 200, np.full((64, 3), 1e-12), HERE.digests)
    require_same(load(path), near, "here")
    with pytest.raises(LearningError, match=r"another trajectory: that one is up to 1\.1e-06 um away"):
        require_same(load(path), Belongs(100, 200, np.full((64, 3), 1.1e-12), HERE.digests), "here")
