"""The tables of docs/understand/bus.md, which the site makes, and its figure against the frame times."""

import runpy
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "docs" / "figures" / "bus_timing.py"
drawing = runpy.run_path(str(SCRIPT))


def test_three_frames_take_together_what_they_take_one_by_one():
    rows = [line.strip("| ").split(" | ") for line in drawing["frame_table"]().splitlines()[2:]]
    for column in (3, 4):
        each = [[float(v) for v in row[column].removesuffix(" us").split("..")] for row in rows[:3]]
        together = [float(v) for v in rows[3][-2:][column - 3].removesuffix(" us").split("..")]
        assert together == pytest.approx([sum(ends) for ends in zip(*each, strict=True)], abs=1.0)
    assert "135.0..141.6 us" in rows[3][-2]


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
