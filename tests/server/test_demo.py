"""``pkxyz demo`` scans, and gives way to whoever takes control."""

import os
import signal
import subprocess
import sys
import time

import pytest
from patience import patient_bus, patient_law

import pkxyz_ctrl
from pkxyz_ctrl.client import place
from pkxyz_ctrl.client.reply import RefusedError

pytestmark = pytest.mark.at_rate


def test_a_scan_runs_and_gives_way(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    law, bus = patient_law(tmp_path, "youla"), patient_bus(tmp_path / "bus.toml")
    words = ["demo", "--port", "0", "--controller", str(law), "--bus", str(bus)]
    process = subprocess.Popen([sys.executable, "-m", "hil", *words], stdout=subprocess.PIPE, text=True, cwd=tmp_path)
    try:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("a stage that scans is at http://127.0.0.1:")
        with pkxyz_ctrl.connect(name="demo", control=False) as stage:
            _until(lambda: stage.next_status().activity == "scanning", 200)
            _until(lambda: _has_control(stage), 20)
            stage.stop()
            _until(lambda: stage.next_status().activity == "holding", 20)
            time.sleep(1.0)
            assert stage.next_status().activity == "holding"
            stage.give_control()
            _until(lambda: stage.next_status().activity in ("scanning", "moving"), 20)
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0
    finally:
        process.kill()
        for kind in ("loop", "plant"):
            if (found := place.read("demo", kind)) is not None:
                os.kill(found["pid"], signal.SIGKILL)


def _has_control(stage) -> bool:
    try:
        stage.take_control()
    except RefusedError:
        return False
    return True


def _until(is_so, seconds: float) -> None:
    end_s = time.monotonic() + seconds
    while not is_so():
        assert time.monotonic() < end_s
        time.sleep(0.02)
