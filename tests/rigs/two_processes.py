"""Controller and plant as two processes of ``pkxyz`` that meet on Unix sockets, and an observer on their bus."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import can
import numpy as np
import pytest
from patience import patient_bus, patient_law

from hil.bus.unix_bus import UnixBus
from hil.lanes.wall_plant import TRUTH
from hil.recording.recording import Recording
from pkxyz_ctrl.design.law import way_down_ticks
from pkxyz_ctrl.safety.modes import Mode

ROOT = Path(__file__).parents[2]
DRIVE, EMCY, HEARTBEAT = 0x30A, 0x08A, 0x70A
CRC = 4
PERIOD_US, DRIVE_TIMEOUT_US = 1000, 20_000
END_TICKS = way_down_ticks(0.005, PERIOD_US)[1] + 8
"""In which a run ends that is led down: the way, and some before and behind it."""
SCENARIO = """
name = "to_and_fro"
duration_s = 1.8
seed = 3
stage = "reconstructed"
plant = "nominal"
controller = "patient.toml"
bus = "{bus}"
[[reference]]
kind = "hold"
duration_s = 0.02
measured = false
[[reference]]
kind = "move"
to_m = [0.0, 0.0, 19.2495e-6]
velocity_max_m_per_s = 0.1e-3
acceleration_max_m_per_s2 = 0.02
jerk_max_m_per_s3 = 5.0
[[reference]]
kind = "move"
to_m = [3.0e-6, -2.0e-6, 19.2495e-6]
velocity_max_m_per_s = 0.02e-3
acceleration_max_m_per_s2 = 0.005
jerk_max_m_per_s3 = 1.0
"""


def bench_in(folder):
    """Into a folder: a scenario, a controller that forgives missed ticks, and a patient and an impatient bus."""
    patient_law(folder)
    patient_bus(folder / "quick.toml", is_node_patient=False)
    patient_bus(folder / "slow.toml")
    for name in ("quick", "slow"):
        (folder / f"on_{name}.toml").write_text(SCENARIO.format(bus=f"{name}.toml"), encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A folder of the module's, with all that two processes need."""
    return bench_in(tmp_path_factory.mktemp("bench"))


def started(folder, *words, stdout=subprocess.PIPE):
    return subprocess.Popen(
        [sys.executable, "-m", "hil.cli", *map(str, words)], cwd=folder, text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=stdout, stderr=subprocess.PIPE,
    )  # fmt: skip


@contextmanager
def plant_in(folder):
    """Serves node and plant in a process; gives it, and a function that waits for a state and returns all changes."""
    words = ("plant", "on_slow.toml", "--bus", "slow.toml", "--truth", "truth.bin", "--json")
    with (folder / "changes").open("wb") as out:
        process = started(folder, *words, stdout=out)

    def seen(state, driven):
        end_s = time.monotonic() + 60
        while True:
            lines = [json.loads(line) for line in (folder / "changes").read_text(encoding="utf-8").splitlines()]
            if lines and (lines[-1]["state"], lines[-1]["driven"]) == (state, driven):
                return lines
            assert time.monotonic() < end_s, f"the node is not {state}, driven {driven}: {lines}"
            time.sleep(0.02)

    try:
        yield process, seen
    finally:
        process.terminate()
        _, err = process.communicate(timeout=60)
    assert process.returncode in (0, -signal.SIGKILL), err


@contextmanager
def served(folder):
    """The same where the plant is there to the end; gives the function that waits for a state."""
    with plant_in(folder) as (process, seen):
        yield seen
    assert process.returncode == 0


@contextmanager
def plant_on(bus, stage, plant="nominal"):
    """Node and plant served on a bus, without a scenario's folder, to the end of what runs beside them."""
    process = started(bus.parent, "plant", "--bus", bus, "--stage", stage, "--plant", plant, "--json")
    try:
        assert "pre-operational" in process.stdout.readline()
        yield
    finally:
        process.terminate()
        process.communicate(timeout=60)


@pytest.fixture(scope="module")
def changes(bench):
    """Waits for a state of the node that is served in the folder, and returns all changes so far."""
    with served(bench) as seen:
        yield seen


@contextmanager
def controller(folder, *words):
    """A controller in its process, which does not outlive the test."""
    process = started(folder, "run", *words)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()


def is_driving(observer, run):
    """Whether within a minute, and before the node complains, the observer on the bus sees
    voltages for some ticks of a controller's process.
    """
    end_s, driven = time.monotonic() + 60, 0
    while driven < 200 and run.poll() is None and time.monotonic() < end_s:
        message = observer.recv(0.1)
        if driven and message is not None and message.arbitration_id == EMCY and any(message.data):
            return False
        driven += message is not None and message.arbitration_id == DRIVE and any(message.data[:6])
    return driven == 200


@contextmanager
def driving(folder, observer, *words):
    """A controller in its process that drives the combs. A machine that stands still puts it in fault at 0 V instead,
    so it may begin three times.
    """
    said = []
    for _ in range(3):
        with controller(folder, *words) as run:
            if is_driving(observer, run):
                yield run
                return
            run.terminate()
            said.append(run.communicate(timeout=60))
    pytest.fail(f"no voltages came: {said}")


def assert_ends_without_its_plant(folder, *words):
    """A run whose plant is killed ends by itself half a second after its last heartbeat, with a line and not ok: nobody
    is left who could start the amplifier again. Another node is there all the while. The scenario has no checks, so it
    is the fault alone that fails it.
    """
    bench_in(folder)
    words = ("on_slow.toml", "--bus", "slow.toml", *words, "--out", "left", "--replace", "--seconds", "60", "--json")
    with plant_in(folder) as (plant, changes):
        changes("pre-operational", False)
        with UnixBus(f"{folder}/bus") as observer, driving(folder, observer, *words) as run:
            plant.kill()
            end_s = time.monotonic() + 120
            while run.poll() is None and time.monotonic() < end_s:
                observer.send(can.Message(arbitration_id=HEARTBEAT + 1, data=b"\5", is_extended_id=False))
                time.sleep(0.02)
            out, err = run.communicate(timeout=1)
    assert run.returncode == 1, err
    assert "the amplifier has fallen silent, so the run ends: start `pkxyz plant` again, then this" in err.splitlines()
    told = json.loads(out)
    assert len(told["faults"]) == 1
    assert not told["ok"]
    assert not told["interrupted"]
    assert [(check["name"], check["ok"]) for check in told["checks"]] == [("faults", False)]
    log = list(can.LogReader(folder / "left" / "frames.log"))
    heard_s = max(message.timestamp for message in log if message.arbitration_id == HEARTBEAT)
    assert 0.5 < log[-1].timestamp - heard_s < 0.7
    others = [message for message in log if message.arbitration_id == HEARTBEAT + 1 and message.timestamp > heard_s]
    assert len(others) > 10
    assert (folder / "left" / "report.png").is_file()


def next_with(bus, can_id):
    end_s = time.monotonic() + 10
    while time.monotonic() < end_s:
        message = bus.recv(0.1)
        if message is not None and message.arbitration_id == can_id:
            return message
    raise AssertionError(f"no frame 0x{can_id:03X} came")


def assert_ended_by_the_controller(log):
    """It led the stage down to 0 V, and the node did not have to find out that it is gone."""
    frames = list(can.LogReader(log))
    most = np.array([np.frombuffer(m.data[:6], "<i2").max() for m in frames if m.arbitration_id == DRIVE], float)
    last = np.flatnonzero(most)[-1]
    assert 0.0 == most[-1] < most[last] < 0.4 * most[last - 11]  # of 12 ticks on the way
    assert (np.diff(most[last - 11 : last + 1]) <= 50).all()
    driven = next(i for i, m in enumerate(frames) if m.arbitration_id == DRIVE and any(m.data[:6]))
    assert not any(message.arbitration_id == EMCY for message in frames[driven:])


def assert_missed_by_the_node(observer, killed_s):
    """Within a second the node says that drive frames, then the heartbeat, of whoever was killed do not come."""
    for code in (b"\x50\x82", b"\x30\x81"):  # RPDO time-out, then heartbeat error (CiA 301, table 26)
        emergency = next_with(observer, EMCY)
        assert emergency.data[:2] == code
        assert emergency.timestamp - killed_s < 1.0


def assert_0_v_in_the_time_of_drive_frames(folder, lines):
    """By the node's changes: a time-out after the last drive frame it is at 0 V, and then no longer operational."""
    assert [(line["state"], line["driven"]) for line in lines[-3:]] == [
        ("operational", True), ("operational", False), ("pre-operational", False),
    ]  # fmt: skip
    last_us = int(np.fromfile(folder / "truth.bin", TRUTH)["t_us"][-1])
    waited_us = 1e6 * lines[-2]["t_s"] - last_us
    assert DRIVE_TIMEOUT_US - 2 * PERIOD_US < waited_us <= DRIVE_TIMEOUT_US + PERIOD_US


def stand_still(pid):
    """A process sleeps for 40 ms in the middle of whatever it does."""
    os.kill(pid, signal.SIGSTOP)
    time.sleep(0.04)
    os.kill(pid, signal.SIGCONT)


def assert_skipped_whole_ticks(recording):
    """And went on tracking until somebody ended it."""
    at = int(np.argmax(recording["overrun"]))
    assert recording["overrun"][at] >= 35
    assert (recording["mode"][at:-END_TICKS] == Mode.TRACKING).all()
    assert recording.ticks - at > 100


def assert_led_down_from_outside(folder, out):
    """A run that SIGTERM ended, without a fault: it says so, and led the stage down."""
    assert "ended from outside" in out
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert summary["interrupted"]
    assert summary["faults"] == []
    modes = Recording.open(folder / "recording.parquet")["mode"]
    assert set(modes[-END_TICKS:]) == {Mode.TRACKING, Mode.LANDING, Mode.IDLE}  # not dropped


def assert_damage_was_a_fault(folder, out):
    """A run that met damaged sense frames, by its folder and output: it said so, and from then on only 0 V went out."""
    (fault,) = json.loads(out)["faults"]
    assert "SENSE_CRC" in fault
    damaged = Recording.open(folder / "recording.parquet")
    at = int(np.argmax(damaged["mode"] == Mode.FAULT))
    assert (damaged["sense_status"][: at + 1] & CRC > 0).sum() >= 5
    assert not damaged.vector("drive_count")[at:].any()
