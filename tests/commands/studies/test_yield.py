"""``pkxyz yield``: the command line of a wafer's share."""

import json
import sys
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from hil import cli
from hil.bench.study import short_scan
from hil.runs.scenario import load_scenario

ROOT = Path(__file__).parents[3]


def pkxyz(capsys, monkeypatch, *words):
    """Exit code and output, in this process."""
    monkeypatch.setattr(sys, "argv", ["pkxyz", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return ended.value.code, capsys.readouterr()


def test_a_study_leaves_table_summary_and_picture_and_any_device_again(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    words = (
        "yield", "--devices", 300, "--loops", 3, "--sensitivity", 60, "--loop-sensitivity", 1, "--workers", 1,
        "--identified", "--json",
    )  # fmt: skip
    code, shown = pkxyz(capsys, monkeypatch, *words)
    assert (code, shown.err) == (0, "")
    data = json.loads(shown.out)
    assert data["devices"] == 300
    assert data["shares"]["ok"]["devices"] == 300
    assert 0.0 <= data["shares"]["ok"]["low"] <= data["shares"]["ok"]["value"] <= data["shares"]["ok"]["high"]
    assert data["causes"]["total_index_and_error"].keys() == {*data["shares"]}
    assert json.loads((tmp_path / "yield" / "summary.json").read_text()) == data
    assert data["loops"]["known"]["devices"] == data["loops"]["identified"]["devices"] == 3
    figures = data["loop_causes"]["total_index_and_error"]
    assert {"shipped.peak_s", "known.rejection_hz", "instrument.error_nm", "ok.identified"} <= figures.keys()
    assert figures["shipped.peak_s"].keys() == data["causes"]["total_index_and_error"]["ok"].keys()
    left = sorted(p.name for p in (tmp_path / "yield").iterdir())
    assert left == ["causes", "devices", "loops", "loops.png", "summary.json", "wafer.png"]
    code, shown = pkxyz(capsys, monkeypatch, "yield", "--alone", 123, "--json")
    assert code == 0
    alone = json.loads(shown.out)
    assert alone["device"] == 123
    assert len(alone["etch_bias_m"]) == 3
    assert 1.0 < alone["shipped.peak_s"] < 3.0
    again, shown = pkxyz(capsys, monkeypatch, *words)
    assert (again, json.loads(shown.out)) == (0, data)  # from the table, bit for bit


def test_what_is_shown_is_a_table_and_what_wins_most(capsys, monkeypatch, tmp_path):
    code, shown = pkxyz(
        capsys,
        monkeypatch,
        "yield",
        "--devices",
        200,
        "--loops",
        0,
        "--sensitivity",
        0,
        "--workers",
        1,
        "--out",
        tmp_path,
    )
    assert code == 0
    assert "200 devices of oreo_drie by the drawing reconstructed, seed 1" in shown.out
    assert "all of them" in shown.out
    code, shown = pkxyz(capsys, monkeypatch, "yield", "--alone", 5, "--loops", 0)
    assert code == 0
    assert "split_hz: " in shown.out
    code, shown = pkxyz(capsys, monkeypatch, "yield", "--devices", 200, "--seed", 2, "--loops", 0, "--out", tmp_path)
    assert code == 2
    assert "devices of another study" in shown.err


def test_the_devices_of_whole_wafers_in_a_loop_with_their_interval_by_wafers(capsys, monkeypatch, tmp_path):
    scan = ROOT / "examples" / "short_scan.toml"
    words = ("yield", "--devices", 152, "--sensitivity", 0, "--loops", 152, "--per-wafer", 76, "--shipped")
    code, shown = pkxyz(
        capsys, monkeypatch, *words, "--loop-sensitivity", 16, "--scenario", scan, "--workers", 1, "--out", tmp_path
    )
    assert code == 0
    assert "in a closed loop, 152 devices on 2 wafers" in shown.out
    assert "shipped.rejection_hz" in shown.out
    loops, devices = (pq.read_table(tmp_path / name).to_pydict() for name in ("loops", "devices"))
    assert sorted(loops["number"][:152]) == devices["device"][:152]
    assert loops["wafer"][:152] == [0] * 76 + [1] * 76
    share = json.loads((tmp_path / "summary.json").read_text())["loops"]["shipped.peak_s"]
    assert (share["devices"], share["value"]) == (152, 1.0)
    assert share["effective"] == 2  # wafers
    code, shown = pkxyz(capsys, monkeypatch, *words, "--per-wafer", 77)
    assert (code, "has 76 devices a wafer" in shown.err) == (2, True)


def test_the_short_scan_beside_the_examples_is_the_one_that_is_benched():
    ours, benched = (
        load_scenario(str(ROOT / "examples" / "short_scan.toml")), short_scan()
    )  # fmt: skip
    named = {"name": ours.config.name, "description": ours.config.description}
    assert ours.config == benched.config.model_copy(update=named)
