"""The command line as a user meets it: a process, its two streams and its exit code."""

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial

import pytest
from command_line import ROOT, pkxyz

from pkxyz_ctrl.config.files import CONFIG_DIR


def assert_one_line_each(done, *expected):
    """Exit code 2, nothing on stdout, and on stderr one line for each expected text."""
    assert done.returncode == 2
    assert done.stdout == ""
    lines = [line for line in done.stderr.splitlines() if line.startswith("pkxyz: ")]
    assert len(lines) == len(expected), done.stderr
    assert "Traceback" not in done.stderr
    for line, text in zip(lines, expected, strict=True):
        assert text in line


def changed(folder, *changes):
    text = (CONFIG_DIR / "scenarios" / "raster.toml").read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path = folder / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_version_and_help(tmp_path):
    assert pkxyz("--version", cwd=tmp_path).stdout.startswith("pkxyz 0.")
    shown = pkxyz("--help", cwd=tmp_path)
    assert shown.returncode == 0
    assert {"sil", "configs"} <= set(shown.stdout.split())


def test_configs_lists_every_shipped_file_with_a_line_about_it(tmp_path):
    listed = json.loads(pkxyz("configs", "--json", cwd=tmp_path).stdout)
    for kind, entries in listed.items():
        assert set(entries) == {path.stem for path in (CONFIG_DIR / kind).glob("*.toml")}
        assert all(words and "\n" not in words for words in entries.values()), kind
    assert set(listed) == {
        "scenarios",
        "stages",
        "plants",
        "controllers",
        "buses",
        "tolerances",
        "processes",
        "searches",
    }
    shown = pkxyz("configs", cwd=tmp_path)
    assert shown.returncode == 0
    assert "reconstructed" in shown.stdout


def test_bad_input_is_exit_code_2_and_one_line(tmp_path):
    assert_one_line_each(pkxyz("sil", "rastr", cwd=tmp_path), "no configuration named 'rastr'; did you mean 'raster'?")
    assert_one_line_each(pkxyz("sil", "no.toml", cwd=tmp_path), "no.toml: no such file")
    assert_one_line_each(pkxyz("sil", "--bus", "fd_6k", cwd=tmp_path), "did you mean 'fd_5k'?")
    assert_one_line_each(pkxyz("sil", "--lane", "slow", cwd=tmp_path), "'lockstep', 'fast'")
    assert_one_line_each(pkxyz("sil", "--seed", "-1", cwd=tmp_path), "seed: ")
    assert_one_line_each(pkxyz("sil", "--sed", "1", cwd=tmp_path), "--sed")
    assert_one_line_each(pkxyz("slil", cwd=tmp_path), "slil")
    path = changed(tmp_path, ("lines = 10", "lines = 0"), ("seed = 1", "seed = true"))
    assert_one_line_each(pkxyz("sil", path, cwd=tmp_path), "seed", "reference.3.raster.lines")
    assert not (tmp_path / "runs").exists()


def test_a_folder_with_other_peoples_files_is_left_alone(tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("words")
    assert_one_line_each(pkxyz("sil", "--out", "thesis", cwd=tmp_path), "holds files that are not a run's")
    assert [p.name for p in (tmp_path / "thesis").iterdir()] == ["chapter.tex"]
    assert_one_line_each(
        pkxyz("sil", "--out", "/dev/null/runs", cwd=tmp_path), "--out: /dev/null/runs: not a directory"
    )


def test_lockstep_without_a_bus_is_refused(tmp_path):
    assert_one_line_each(pkxyz("sil", "--bus", "local_20k", cwd=tmp_path), "use --lane fast or another --bus")


def read_run(folder):
    from hil.recording.recording import Recording

    return json.loads((folder / "summary.json").read_text(encoding="utf-8")), Recording.open(
        folder / "recording.parquet"
    )


@pytest.mark.slow
def test_a_run_leaves_its_folder_and_exit_code_0_and_the_next_one_gets_the_next_number(tmp_path):
    done = pkxyz("sil", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    printed = json.loads(done.stdout)
    folder = tmp_path / "runs" / "raster-lockstep-1"
    assert printed.pop("folder") == str(folder.relative_to(tmp_path))
    summary, recording = read_run(folder)
    assert summary.keys() - printed.keys() == {"files", "seal"}  # what the folder holds, besides
    assert {name: summary[name] for name in printed} == printed
    assert {item.name for item in folder.iterdir()} == {
        "recording.parquet", "frames.log", "config.toml", "summary.json", "report.png", "adapted.json",
    }  # fmt: skip
    assert set(summary) >= {
        "scenario", "lane", "seed", "digest", "ticks", "missed_ticks", "saturated_ticks", "faults", "bus_load",
        "realtime_factor", "rms_error_nm", "max_error_nm", "hold_noise_nm", "checks", "versions", "period_us",
    }  # fmt: skip
    assert summary["ticks"] == recording.ticks == 5500
    assert recording.metadata["digest"] == summary["digest"]
    assert recording.metadata["seed"] == 1
    assert 0.6 < summary["bus_load"] < 0.85
    assert all(check["ok"] for check in summary["checks"])
    shown = pkxyz("sil", "--seed", "2", "--lane", "fast", cwd=tmp_path)
    assert shown.returncode == 0, shown.stderr
    assert "rms_error_nm" in shown.stdout
    assert "runs/raster-fast-1/" in shown.stdout
    assert read_run(tmp_path / "runs" / "raster-fast-1")[0]["seed"] == 2
    assert pkxyz("sil", "--lane", "fast", "--json", cwd=tmp_path).returncode == 0
    assert (tmp_path / "runs" / "raster-fast-2" / "report.png").is_file()


@pytest.mark.slow
def test_checks_that_do_not_hold_are_exit_code_1_in_a_folder_that_may_be_replaced(tmp_path):
    path = changed(tmp_path, ("rms_error_nm = { max = 5.0 }", "rms_error_nm = { min = 0.001, max = 0.01 }"))
    for seed in ("1", "2"):
        done = pkxyz("sil", path, "--lane", "fast", "--out", "mine", "--replace", "--seed", seed, cwd=tmp_path)
        assert done.returncode == 1, done.stderr
        assert "fails" in done.stdout
    summary, _ = read_run(tmp_path / "mine")
    assert summary["seed"] == 2
    assert not summary["ok"]
    assert [check["ok"] for check in summary["checks"] if check["name"] == "rms_error_nm"] == [False]


@pytest.mark.slow
@pytest.mark.at_rate
def test_ctrl_c_keeps_what_was_recorded(tmp_path):
    path = changed(tmp_path, ("duration_s = 1.1", "duration_s = 3600.0"))
    process = subprocess.Popen(
        [sys.executable, "-m", "hil.cli", "sil", str(path), "--out", "cut", "--json"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # a shell's background jobs ignore it
    )
    journal = tmp_path / "cut" / "recording.parquet.journal"
    try:
        for _ in range(6000):  # the kernels may have to be compiled first
            if journal.is_file() and journal.stat().st_size > 3_000_000:
                break
            assert process.poll() is None, process.communicate()
            time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        stdout, stderr = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == 130, stderr
    assert "Traceback" not in stderr
    summary, recording = read_run(tmp_path / "cut")
    assert json.loads(stdout)["interrupted"] is True
    assert summary["interrupted"] is True
    assert summary["ok"] is False
    assert recording.ticks == summary["ticks"] > 6000
    assert recording["tick"].tolist() == list(range(recording.ticks))
    assert summary["rms_error_nm"]["x"] < 10
    assert (tmp_path / "cut" / "report.png").is_file()
    assert not journal.exists()
