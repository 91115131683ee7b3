"""``pkxyz design --for-yield``: what it writes, says and refuses."""

import json
import sys

import pytest

from hil import cli
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.stage import Stage


def pkxyz(capsys, monkeypatch, *words):
    """Exit code and output, in this process."""
    monkeypatch.setattr(sys, "argv", ["pkxyz", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return ended.value.code, capsys.readouterr()


def for_yield(capsys, monkeypatch, *words):
    """Of three drawings, confirmed by eight devices."""
    fixed = ("--for-yield", "oreo_drie", "--trials", 3, "--devices", 8, "--workers", 1)
    return pkxyz(capsys, monkeypatch, "design", *fixed, *words)


@pytest.mark.slow
def test_a_search_leaves_stage_files_that_run_a_picture_and_a_comparison(capsys, monkeypatch, tmp_path):
    """And called again it says the same from what it has kept."""
    monkeypatch.chdir(tmp_path)
    code, shown = for_yield(capsys, monkeypatch, "--json")
    assert (code, shown.err) == (0, "")
    data = json.loads(shown.out)
    assert data == json.loads((tmp_path / "designed" / "summary.json").read_text())
    assert list(data["drawings"]) == ["reconstructed", "design", "chosen"]
    assert data["design"] is None
    for row in data["drawings"].values():
        assert row["works"]["devices"] == 8
        assert {"shipped", "identified", "instrument", "known", "own"} <= set(row["shares"])
        assert row["effects"]["handle_m"]["known.error_about_mean_nm"] > 0.0
    assert data["drawings"]["chosen"]["gained"] == 0.0
    chosen = tmp_path / "designed" / "chosen.toml"
    assert Stage.load(chosen).config.name == "chosen"
    assert load_scenario("raster", stage=str(chosen)).setup().stage.name == "chosen"
    left = {path.name for path in (tmp_path / "designed").iterdir()}
    assert {"chosen.toml", "study.db", "drawings.png", "devices", "summary.json"} <= left
    code, shown = for_yield(capsys, monkeypatch, "--json")
    assert (code, json.loads(shown.out)) == (0, data)
    code, shown = for_yield(capsys, monkeypatch)
    assert "pkxyz sil --stage designed/chosen.toml --controller" in shown.out
    assert "one standard deviation of" in shown.out


def test_where_plain_design_has_none_it_searches_all_the_same_and_says_so(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    code, shown = for_yield(capsys, monkeypatch, "--v-max", 100)
    assert code == 1
    assert "plain `pkxyz design` has none to compare with: no (L1, L2, alpha_0) fulfils the requirements" in shown.out
    assert "none keeps every inequality; the nearest misses" in shown.out
    data = json.loads((tmp_path / "designed" / "summary.json").read_text())
    assert (data["chosen"], data["drawings"]) == (None, {})
    assert data["missed"]["comb force"] > 0.0
    assert not (tmp_path / "designed" / "chosen.toml").exists()


def test_another_problem_in_the_same_folder_and_a_process_that_is_none_are_refused(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert for_yield(capsys, monkeypatch, "--v-max", 100)[0] == 1
    code, shown = for_yield(capsys, monkeypatch, "--v-max", 101)
    assert (code, "is of another problem" in shown.err) == (2, True)
    code, shown = pkxyz(capsys, monkeypatch, "design", "--for-yield", "none")
    assert (code, shown.err.count("\n")) == (2, 1)
