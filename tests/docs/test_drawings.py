"""The drawings for people: drawn from the stage and the bus file, the same bytes each time, one for each theme."""

import runpy
from pathlib import Path

import numpy as np
import pytest
import reference_tables

from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import load

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture(autouse=True)
def shared_canvas(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(DOCS / "drawings"))


@pytest.mark.parametrize("name", ["mechanism", "loop", "timing"])
def test_committed_drawings_are_what_the_scripts_draw(name, tmp_path, monkeypatch):
    import canvas

    monkeypatch.setattr(canvas, "FIGURES", tmp_path)
    runpy.run_path(str(DOCS / "drawings" / f"{name}.py"), run_name="__main__")
    for theme in ("light", "dark"):
        drawn = (tmp_path / f"{name}-{theme}.svg").read_bytes()
        assert drawn == (DOCS / "figures" / f"{name}-{theme}.svg").read_bytes(), "run: python docs/build.py"
    assert len({path.read_bytes() for path in tmp_path.iterdir()}) == 2


def test_the_timing_drawing_has_the_instants_of_the_longest_frames():
    timing = runpy.run_path(str(DOCS / "drawings" / "timing.py"))
    found = timing["instants"](load("buses", "fd_5k", BusConfig))
    page = reference_tables.BUILT["budget"]()
    for key, words in (
        ("sampled", "36 us |"),
        ("sense_to", "87 us |"),
        ("drive_from", "95 us |"),
        ("drive_to", "144 us |"),
    ):
        assert words in page
        assert found[key] == pytest.approx(float(words.split()[0]), abs=1.5)  # endpoints live in whole microseconds
    assert np.all(np.diff(list(found.values())) > 0)
