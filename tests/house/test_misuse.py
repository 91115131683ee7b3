"""What a user gets wrong: one line that says what to do, an exit code, and nothing lost; Ctrl-C included."""

import contextlib
import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from command_line import refused

from hil import cli
from hil.screen.errors import was_interrupted
from hil.screen.outputs import what_to_do
from hil.studies.spread.processes import ctrl_c_kept_back
from pkxyz_ctrl.config.files import CONFIG_DIR

pytestmark = pytest.mark.at_rate

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("compare", "--out", "no/such.png"), "--out: no: no such folder; make it"),
        (("compare", "--out", "picture.foo"), "end its name in .png"),
        (("compare", "--out", "."), "end its name in .png"),
        (("latency", "--out", "no/such.png"), "--out: no: no such folder; make it"),
        (("design", "--picture", "no/such.png"), "--picture: no: no such folder; make it"),
        (("identify", "--controller", "open_loop"), "only feeds forward"),
        (("identify", "--at", "30", "30", "30"), "at 30 30 30 um: strokes go from 0 to 25 um"),
        (("margins", "--at", "99", "99", "99"), "at 99 99 99 um: strokes go from 0 to 25 um"),
        (("margins", "--at", "-5", "0", "0"), "at -5 0 0 um: strokes go from 0 to 25 um"),
        (("margins", "--at", "nan", "1", "1"), "at nan 1 1 um: strokes go from 0 to 25 um"),
        (("margins", "--at", "0", "0", "0"), "a comb at 0 V closes no loop"),
        (("margins", "--controller", "open_loop"), "there is no loop"),
        (("margins", "--out", "file"), "--out: file: file exists"),
        (("identify", "--out", "file"), "--out: file: file exists"),
        (("tune", "--out", "file"), "--out: file: file exists"),
        (("montecarlo", "--out", "file"), "--out: file: file exists"),
        (("yield", "--out", "file"), "--out: file: file exists"),
        (("yield", "oreo"), "no configuration named 'oreo'; did you mean 'oreo_drie'?"),
        (("faults", "--out", "file"), "--out: file: file exists"),
        (("soak", "--out", "file"), "--out: file: file exists"),
        (("check-amplifier", "--out", "file"), "--out: file: file exists"),
        (("check-amplifier", "--eds", "nope.eds"), "nope.eds: no such file; give the amplifier's EDS"),
        (("check-amplifier", "--eds", "nope"), "nope: no such file; give the amplifier's EDS"),
    ],
)
def test_refused_in_one_line_before_anything_is_done(words, says, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("mine")
    assert says in refused(capsys, monkeypatch, *words)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_text() == "mine"


def test_no_file_of_the_users_is_replaced(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    mine = (CONFIG_DIR / "stages" / "reconstructed.toml").read_text(encoding="utf-8")
    for name in ("stage.toml", "drawn.toml"):
        (tmp_path / name).write_text(mine, encoding="utf-8")
    line = refused(capsys, monkeypatch, "identify", "--stage", "stage.toml", "--out", ".")
    assert "its stage.toml is the --stage that is identified" in line
    assert "was not written by `pkxyz design`" in refused(capsys, monkeypatch, "design", "--out", "drawn.toml")
    assert all((tmp_path / name).read_text(encoding="utf-8") == mine for name in ("stage.toml", "drawn.toml"))


@pytest.mark.skipif(os.getuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_refused_beforehand(capsys, monkeypatch, tmp_path):
    tmp_path.chmod(0o500)
    assert "permission denied" in refused(capsys, monkeypatch, "margins", "--out", tmp_path)


def test_without_a_command_there_is_help_and_nothing_else(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["pkxyz"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    shown = capsys.readouterr()
    assert ended.value.code == 0
    assert shown.err == ""
    assert shown.out.startswith("Usage: pkxyz")
    assert "..." not in shown.out.partition("Commands:")[2]  # what a command is for fits in its line


def test_a_disk_that_refuses_is_one_line_and_other_errors_of_the_system_are_not_hidden():
    assert what_to_do(OSError(errno.ENOSPC, "No space left on device", "a/b")) == (
        "a/b: no space left on device; make room, or give another place to write; what was written before is kept"
    )
    assert what_to_do(OSError(errno.ECONNRESET, "Connection reset by peer")) is None


def test_there_is_one_way_from_an_error_of_the_system_to_words():
    """``reason``; beside it stand what has no OSError (errno alone, decoding) and python-can's own errors."""
    others = {"recording.py", "realtime.py", "unix_bus.py", "refused.py", "can_port.py"}
    found = {path.name for top in ("hil", "pkxyz_ctrl", "sim") for path in (ROOT / top).rglob("*.py")
             if "strerror" in path.read_text(encoding="utf-8")}  # fmt: skip
    assert found == others


def test_ctrl_c_is_ctrl_c_whatever_an_import_makes_of_it():
    interrupted = ImportError("numba._devicearray failed to import")
    interrupted.__context__ = KeyboardInterrupt()
    assert was_interrupted(interrupted)
    assert not was_interrupted(ImportError("no module named numba"))


def ended(tmp_path, ready, *words, by=signal.SIGINT):
    """Exit code and both streams of a command that gets a signal with all its processes, as Ctrl-C does; SIGKILL goes
    to the first alone.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", "hil.cli", *words],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    try:
        for _ in range(12_000):  # kernels may have to be compiled
            if ready():
                break
            assert process.poll() is None, process.communicate()
            time.sleep(0.05)
        (os.kill if by == signal.SIGKILL else os.killpg)(process.pid, by)
        stdout, stderr = process.communicate(timeout=60)  # ends when nobody holds its streams any more
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    return process.returncode, stdout, stderr


def test_ctrl_c_waits_while_processes_are_started_whichever_thread_takes_it():
    """A child that is begun and not yet told what to do would end in a trace of its own."""
    others_end = threading.Event()
    threading.Thread(target=others_end.wait, daemon=True).start()  # it takes the signal: it does not mask it
    done = []

    def interrupted_while_it_starts_one():
        with ctrl_c_kept_back():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.05)
            done.append("all")

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have had it ignored
    try:
        with pytest.raises(KeyboardInterrupt):
            interrupted_while_it_starts_one()
    finally:
        signal.signal(signal.SIGINT, before)
        others_end.set()
    assert done == ["all"]


@pytest.mark.slow
def test_ctrl_c_in_a_study_says_one_word_and_keeps_what_is_done(tmp_path):
    results = tmp_path / "montecarlo" / "results.jsonl"
    words = ("montecarlo", "--plants", "4000", "--workers", "2")
    begun = ended(tmp_path, results.is_file, *words)  # its processes are just being started
    assert begun[0] in (130, -signal.SIGINT)  # a shell shows both as 130; the latter where a library was being imported
    assert begun[2].splitlines()[-1] == "interrupted"
    assert "SpawnProcess" not in begun[2]
    code, stdout, stderr = ended(tmp_path, lambda: len(results.read_text().splitlines()) > 3, *words, "--json")
    assert (code, stderr) == (130, "")
    done = json.loads(stdout)
    assert done["interrupted"] is True
    assert done["plants"] == len(results.read_text().splitlines()) - 1


@pytest.mark.slow
def test_a_study_that_is_killed_leaves_no_process_behind(tmp_path):
    results = tmp_path / "montecarlo" / "results.jsonl"
    lines = lambda: results.is_file() and len(results.read_text().splitlines())  # noqa: E731
    words = ("montecarlo", "--plants", "4000", "--workers", "2")
    assert ended(tmp_path, lambda: lines() > 2, *words, by=signal.SIGKILL)[0] == -signal.SIGKILL


def test_where_no_law_ran_there_is_no_picture(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["pkxyz", "compare", "--controllers", "robust_20k", "--json"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 1
    assert json.loads(capsys.readouterr().out)["picture"] is None
    assert not list(tmp_path.iterdir())


def test_without_a_plant_the_run_says_what_to_start(tmp_path):
    bus = (CONFIG_DIR / "buses" / "unix_2k.toml").read_text(encoding="utf-8")
    (tmp_path / "mine.toml").write_text(
        bus.replace('channel = "pkxyz"', f'channel = "{tmp_path}/bus"'), encoding="utf-8"
    )
    done = subprocess.run(
        [sys.executable, "-m", "hil.cli", "run", "--bus", "mine.toml", "--seconds", "0.5", "--wait", "0.2"],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False,
        timeout=600,
    )  # fmt: skip
    assert done.returncode == 1
    line = done.stderr.splitlines()[-1]
    assert "sent no boot-up message" in line
    assert line.endswith("is `pkxyz plant --bus mine.toml` running?")


def test_output_that_nobody_reads_on_is_no_error(tmp_path):
    shown = subprocess.run(
        f"{sys.executable} -m hil.cli configs --json | head -c 5",
        shell=True, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True,
        check=False, timeout=60,
    )  # fmt: skip
    assert shown.stderr == ""
    assert len(shown.stdout) == 5
