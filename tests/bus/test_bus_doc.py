"""The tables of docs/understand/bus.md against the code that they describe, and its figure against the frame times."""

import runpy
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "docs" / "figures" / "bus_timing.py"
drawing = runpy.run_path(str(SCRIPT))


def test_the_page_holds_what_its_script_would_write() -> None:
    page = drawing["PAGE"].read_text(encoding="utf-8")
    assert drawing["rewritten"](page) == page


def test_the_drawn_cycle_keeps_the_timing_contract() -> None:
    passages, load = drawing["one_cycle"]()
    assert [p.label for p in passages] == ["SYNC", "sense PDO", "drive PDO", "SYNC"]
    sync, sense, drive, following = passages
    assert (sync.start_us, following.start_us) == (0.0, 200.0)
    assert sense.start_us == pytest.approx(sync.end_us, abs=1e-9)  # it was ready within the interframe space
    assert sense.end_us < drive.start_us < drive.end_us < 200.0
    assert load == pytest.approx(sum(p.end_us - p.start_us for p in passages[:3]) / 200.0, abs=1e-9)
    for p in passages:
        assert p.start_us < p.fast_from_us < p.fast_to_us < p.end_us
