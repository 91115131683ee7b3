"""What ``pkxyz run`` tells while it runs, and which bus it takes where the scenario's is simulated."""

import io
import sys

import numpy as np
import pytest

from hil.cli import main
from hil.lanes.ending import Ended
from hil.screen.live_status import LiveStatus
from hil.studies import fitting_bus
from hil.studies.fitting_bus import fastest_that_fits
from hil.studies.latency import Latency
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import ConfigError, load
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


def measured_with(missed, monkeypatch, ended_by=0):
    """``missed``: by period in us, what the measurement finds."""
    real_time = "real time: nothing; not permitted: SCHED_FIFO"

    def measure(period_us, seconds):
        ticks = round(seconds * 1e6 / period_us)
        return Latency(period_us, real_time, ticks, missed[period_us], [], [], None, ended_by=ended_by)

    monkeypatch.setattr(fitting_bus, "measure", measure)
    return fastest_that_fits([load("buses", name, BusConfig) for name in ("unix_2k", "unix_1k")], overrun_count=10)


def test_the_fastest_bus_that_the_machine_keeps_up_with_is_taken(monkeypatch):
    bus, why = measured_with({500: 5}, monkeypatch)
    assert bus.name == "unix_2k"
    assert "5 of 2000 ticks at 2 kHz" in why
    bus, why = measured_with({500: 6, 1000: 0}, monkeypatch)
    assert bus.name == "unix_1k"
    assert "6 of 2000 ticks at 2 kHz, 0 of 1000 ticks at 1 kHz" in why


def test_where_none_fits_it_is_said_in_a_line_with_what_to_do(monkeypatch):
    with pytest.raises(
        ConfigError, match=r"61 of 2000.*40 of 1000.*not permitted: SCHED_FIFO.*--bus.*pkxyz sil"
    ) as caught:
        measured_with({500: 61, 1000: 40}, monkeypatch)
    assert "\n" not in str(caught.value)
    with pytest.raises(Ended):
        measured_with({500: 0}, monkeypatch, ended_by=2)


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
