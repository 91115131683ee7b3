"""``pkxyz`` as a user starts it, and what it refuses; and a stage that it serves, patiently, over loopback."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from patience import patient_bus, patient_law

import pkxyz_ctrl
from hil import cli
from hil.native.program import compiled, compiler
from pkxyz_ctrl.client import place
from pkxyz_ctrl.client.plain import Stage
from pkxyz_ctrl.compiled.kernel_cache import choose_kernel_cache

ROOT = Path(__file__).parents[2]
STARTS_S = 200.0
"""The kernels may have to be compiled."""


def pkxyz(*words, cwd):
    """Run ``pkxyz`` in a folder, as a process; the checkout itself is found by PYTHONPATH, as if installed."""
    return subprocess.run(
        [sys.executable, "-m", "hil.cli", *map(str, words)],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "120"},
        capture_output=True,
        text=True,
        check=False,
        timeout=1200,
    )


def refused(capsys, monkeypatch, *words):
    """The one line that ``pkxyz`` answers with to what it can't do, in this process."""
    monkeypatch.setattr(sys, "argv", ["pkxyz", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    shown = capsys.readouterr()
    lines = [line for line in shown.err.splitlines() if not line.startswith("First run here")]
    assert ended.value.code == 2, shown
    assert shown.out == ""
    assert len(lines) == 1, shown.err
    assert lines[0].startswith("pkxyz: ")
    return lines[0]


class Server:
    """``err``: what it said on its standard error."""

    def __init__(self, folder: Path, *more: str) -> None:
        words = ["serve", *more, "--port", "0", "--json", "--silence-s", "0.25"]
        words += ["--saves", str(folder / "runs"), "--settings", str(folder / "settings")]
        self._command = [sys.executable, "-m", "hil", *words]
        self.process: subprocess.Popen[str]
        self.err = folder / "err"

    def start(self) -> None:
        with self.err.open("wb") as err:
            self.process = subprocess.Popen(
                self._command, stdout=subprocess.PIPE, stderr=err, stdin=subprocess.DEVNULL, text=True
            )
        assert self.process.stdout is not None
        assert self.process.stdout.readline().startswith('{"url": "http://127.0.0.1:')

    def end(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(20)


@contextlib.contextmanager
def served(folder: Path, *words: str, bus: str | None = "unix_1k") -> Iterator[Server]:
    """One that is found by its default name while this lasts; whatever becomes of the test, it is ended.

    In real time, patiently; with ``bus`` None as it is shipped, its stage simulated.
    """
    if compiler() is not None:  # once, and not while somebody waits for the stage
        choose_kernel_cache()
        compiled()
    before = os.environ.get("XDG_RUNTIME_DIR")
    os.environ["XDG_RUNTIME_DIR"] = str(folder)
    if bus is not None:
        patient = patient_law(folder, "youla"), patient_bus(folder / "bus.toml", bus)
        words += ("--controller", str(patient[0]), "--bus", str(patient[1]))
    server = Server(folder, *words)
    try:
        server.start()
        yield server
        server.end()
    finally:
        for kind in ("server", "loop", "plant"):
            if (found := place.read("stage", kind)) is not None:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(found["pid"], signal.SIGKILL)
        os.environ.pop("XDG_RUNTIME_DIR")
        if before is not None:
            os.environ["XDG_RUNTIME_DIR"] = before


@contextlib.contextmanager
def beside_a_stage(folder: Path, *words: str) -> Iterator[str]:
    """``pkxyz`` with words that serve a stage in the middle of its workspace to others: its first line."""
    with served(folder):
        with alive() as stage:
            driven(stage)
        with (folder / "beside.err").open("wb") as err:
            process = subprocess.Popen(
                [sys.executable, "-m", "hil", *words], stdout=subprocess.PIPE, stderr=err, text=True
            )
        try:
            assert process.stdout is not None
            yield process.stdout.readline().strip()
            process.send_signal(signal.SIGTERM)
            assert process.wait(20) == 0
            assert "Traceback" not in (folder / "beside.err").read_text()
        finally:
            process.kill()


@contextlib.contextmanager
def alive(control: bool = True) -> Iterator[Stage]:
    """Connected, once the loop is there."""
    with pkxyz_ctrl.connect(control=control) as stage:
        end_s = time.monotonic() + STARTS_S
        while stage.status.activity == "starting" and time.monotonic() < end_s:
            time.sleep(0.05)
        if stage.status.activity == "fault":  # a machine that stood still
            stage.clear()
        yield stage


def driven(stage: Stage) -> None:
    """In the middle of the workspace."""
    if stage.status.activity == "fault":
        stage.clear()
    if not stage.status.driven:
        stage.home()
        stage.enable()
    stage.move_to(0.0, 0.0, 18e-6)
