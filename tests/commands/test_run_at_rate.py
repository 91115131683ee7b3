"""What ``pkxyz run`` tells while it runs, and which bus it takes where the scenario's is simulated."""

import io
import json
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from command_line import ROOT

from hil.cli import main
from hil.screen.live_status import LiveStatus
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.trips import Trip


class Terminal(io.StringIO):
    def isatty(self):
        return True


def shown(out, rows, ticks=8, period_s=0.1):
    """What is on ``out`` after rows (mode, trips, overrun, status)."""
    live = LiveStatus(ticks, period_s, out)
    row = np.zeros(1, ROW)
    for row["mode"], row["trips"], row["overrun"], row["sense_status"] in rows:
        live(row)
    return out.getvalue()


STORY = (
    *[(Mode.HOMING, 0, 0, 0)] * 2,
    *[(Mode.TRACKING, 0, 0, 0)] * 2,
    (Mode.TRACKING, 0, 1, 1),
    *[(Mode.FAULT, Trip.HEARTBEAT_LOST, 0, 0)] * 2,
)


def test_modes_are_told_as_they_change_and_a_fault_with_its_remedy():
    lines = shown(io.StringIO(), STORY).splitlines()
    assert [line.split() for line in lines[:3]] == [
        ["0.100", "s", "homing"],
        ["0.300", "s", "tracking"],
        ["0.700", "s", "fault"],
    ]
    assert "HEARTBEAT_LOST" in lines[3]
    assert "check its supply" in lines[3]
    assert len(lines) == 4


def test_on_a_terminal_a_line_moves_and_is_gone_in_the_end():
    text = shown(Terminal(), STORY)
    assert "0.600 of 0.8 s, 2 ticks missed" in text
    assert text.endswith("\r")
    last = text.rsplit("\n", 1)[1]
    assert last.split("\r")[-2].strip() == ""


@pytest.mark.at_rate
@pytest.mark.parametrize("more", [(), ("--native",)])
def test_plant_and_run_meet_without_a_bus_and_a_computer_that_stands_still_changes_nothing(more, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    words, pipe = [sys.executable, "-m", "hil.cli"], subprocess.PIPE
    plant = subprocess.Popen([*words, "plant", "--json"], cwd=tmp_path, stdout=pipe, text=True)
    try:
        with subprocess.Popen([*words, "run", "--json", *more], cwd=tmp_path, stdout=pipe, text=True) as run:
            assert any('"driven": true' in line for line in plant.stdout)
            for _ in range(10):
                plant.send_signal(signal.SIGSTOP)
                time.sleep(0.03)
                plant.send_signal(signal.SIGCONT)
                time.sleep(0.03)
            summary = json.loads(run.stdout.read())
    finally:
        plant.kill()
    assert summary["faults"] == []
    assert summary["missed_ticks"] == 0
    assert 0.2 < summary["stood_still_s"] < 3
    assert summary["ok"]
    assert run.returncode == 0


@pytest.mark.parametrize("bus", ["unix_1k", "socketcan_fd"])
@pytest.mark.parametrize(
    ("words", "instead"),
    [
        ("sil raster", "`pkxyz run --bus {bus}`"),
        ("identify --plant harsh", "`pkxyz plant --plant harsh` serves this one"),
        ("margins --measured --lane fast", "leave --lane"),
    ],
)
def test_what_simulates_refuses_a_bus_that_leads_out_of_the_process(bus, words, instead, tmp_path, capsys, monkeypatch):
    """It would take its rate and scales, and simulate the rest without a word."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["pkxyz", *words.split(), "--bus", bus])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    (line,) = [words for words in capsys.readouterr().err.splitlines() if words.startswith("pkxyz: ")]
    assert instead.format(bus=bus) in line
    assert "fd_5k" in line
    assert list(tmp_path.iterdir()) == []
