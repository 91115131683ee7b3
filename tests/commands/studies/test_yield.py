"""``pkxyz yield``: the command line of a wafer's share."""

import json
import sys

import pytest

from hil import cli


def pkxyz(capsys, monkeypatch, *words):
    """Exit code and output, in this process."""
    monkeypatch.setattr(sys, "argv", ["pkxyz", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return ended.value.code, capsys.readouterr()


def test_a_study_leaves_table_summary_and_picture_and_any_device_again(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    words = ("yield", "--devices", 300, "--loops", 3, "--sensitivity", 64, "--workers", 1, "--identified", "--json")
    code, shown = pkxyz(capsys, monkeypatch, *words)
    assert (code, shown.err) == (0, "")
    data = json.loads(shown.out)
    assert data["devices"] == 300
    assert data["shares"]["ok"]["devices"] == 300
    assert 0.0 <= data["shares"]["ok"]["low"] <= data["shares"]["ok"]["value"] <= data["shares"]["ok"]["high"]
    assert data["causes"]["total_index_and_error"].keys() == {*data["shares"]}
    assert json.loads((tmp_path / "yield" / "summary.json").read_text()) == data
    assert data["loops"]["known"]["devices"] == data["loops"]["identified"]["devices"] == 3
    left = sorted(p.name for p in (tmp_path / "yield").iterdir())
    assert left == ["devices", "loops", "loops.png", "summary.json", "wafer.png"]
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
