"""All laws on one scenario: one table, one picture, one exit code."""

import json
import subprocess
import sys
from functools import cache

from hil.studies.compare import compare

SCENARIO = "raster"


@cache
def runs():
    return compare(SCENARIO, ("lqg", "pi_notch", "open_loop"), plant="mild")


def test_feedback_is_better_than_none_and_the_traces_are_those_of_the_figures():
    by_name = {run.controller: run for run in runs()}
    worst = {name: max(run.figures["rms_error_nm"].values()) for name, run in by_name.items()}
    assert 1.0 < worst["lqg"] < worst["open_loop"]
    assert worst["pi_notch"] < worst["open_loop"]
    for run in runs():
        assert run.problem is None
        assert run.error_nm.shape == (len(run.t_s), 3)
        assert max(run.figures["max_error_nm"].values()) <= abs(run.error_nm).max()


def test_the_command_refuses_one_law_and_runs_the_others(tmp_path):
    """irc does not damp at 2 kHz: its reason stands in the table, and the exit code says that not all ran."""
    text = tmp_path / "slow.toml"
    from pkxyz_ctrl.config.files import CONFIG_DIR

    source = (CONFIG_DIR / "scenarios" / "raster.toml").read_text(encoding="utf-8")
    text.write_text(source.replace('bus = "fd_5k"', 'bus = "classic_2k"'), encoding="utf-8")
    picture = tmp_path / "picture.png"
    command = [sys.executable, "-c", "from hil.cli import main; main()", "compare", str(text), "--json"]
    command += ["--controllers", "open_loop,irc", "--out", str(picture)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=1200)
    assert done.returncode == 1, done.stderr
    ran, refused = json.loads(done.stdout)["laws"]
    assert ran["problem"] is None
    assert ran["rms_error_nm"]["x"] > 1.0
    assert "does not damp this axis" in refused["problem"]
    assert picture.stat().st_size > 10_000
