"""The native loop and the plant in two processes over the kernel's CAN sockets, classic and FD; run in a guest by
``run.py``. What is asked is what ``on_vcan.py`` asks of Python's loop, whose rig this is.
"""

import json
import os
import signal
import time
from contextlib import suppress
from pathlib import Path

import can
import numpy as np
import pytest
from on_vcan import (
    CANFD_BRS,
    DRIVE,
    DRIVE_TIMEOUT_US,
    EMCY,
    OURS,
    PERIOD_US,
    SENSE,
    SYNC,
    bench,
    drive_frames,
    driving,
    is_fd,
    next_frame,
    plant,
    send_damaged_sense_frames,
)
from two_processes import assert_damage_was_a_fault

import hil.native.native_rig  # noqa: F401  in the guest an import takes a while
from hil.lanes.wall_plant import TRUTH
from hil.native.program import kept
from hil.recording.recording import Recording
from hil.runs.replay import replay
from pkxyz_ctrl.design.law import way_down_ticks
from pkxyz_ctrl.safety.modes import Mode

__all__ = ["bench", "plant"]


@pytest.fixture(autouse=True)
def the_program_is_the_hosts():
    assert kept() is not None, "compiled before the guest is booted, which has no time for it"


def loop_of(run):
    """The loop that a run has begun."""
    for _ in range(100):
        for child in Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text(encoding="ascii").split():
            with suppress(OSError):
                if b"/proc/self/fd/" in Path(f"/proc/{child}/cmdline").read_bytes():
                    return int(child)
        time.sleep(0.05)
    raise AssertionError("there is no loop")


def test_start_up_and_scan(bench, plant):
    with driving(bench, plant, "--native", "--out", "scan", "--replace", "--json") as (run, _, seen):
        code, out, err = run.wait()
    assert code == 0, err
    summary = json.loads(out)
    assert summary["faults"] == []
    assert summary["refused_frames"] == summary["lost_rows"] == 0
    plant.seen("pre-operational", False)
    by_id = {can_id: (data, fd, flags) for can_id, data, fd, flags in seen}
    assert {0x000, SYNC, DRIVE, SENSE, 0x60A, 0x58A, 0x70A, OURS} <= set(by_id)
    assert {fd for _, fd, _ in by_id.values()} == {is_fd(bench)}
    if is_fd(bench):
        assert all(flags & CANFD_BRS for _, _, flags in by_id.values())
    recording = Recording.open(bench / "scan" / "recording.parquet")
    assert recording.whole
    assert recording.ticks == round(3.2e6 / PERIOD_US)
    good = recording["sense_status"] == 0
    assert good.mean() > 0.5
    tracking = (recording["mode"] == Mode.TRACKING) & good
    error_m = (recording.vector("measurement_m") - recording.vector("reference_m"))[tracking]
    assert np.abs(np.median(error_m, axis=0)).max() < 100e-9
    result = replay(bench / "scan" / "recording.parquet")
    assert result.differences == []
    frames = list(can.LogReader(bench / "scan" / "frames.log"))
    way_down = way_down_ticks(0.005, PERIOD_US)[1] + 2  # and the ticks that begin and end it
    assert sum(frame.arbitration_id == SYNC for frame in frames) == recording.ticks + way_down
    assert any(frame.arbitration_id == SENSE and frame.is_fd == is_fd(bench) for frame in frames)


def test_a_loop_that_is_killed_leaves_0_v_in_the_time_of_its_drive_frames(bench, plant):
    words = ("--native", "--out", "killed", "--replace", "--seconds", "60")
    with driving(bench, plant, *words) as (run, looking, _):
        os.kill(loop_of(run), signal.SIGKILL)
        for code in (b"\x50\x82", b"\x30\x81"):  # no drive PDO, then heartbeat error (CiA 301, table 26)
            while (frame := next_frame(looking))[0] != EMCY:
                pass
            assert frame[1][:2] == code
        code, out, err = run.wait()
    assert code == 128 + signal.SIGKILL, err
    assert "was killed by signal 9" in out
    lines = plant.seen("pre-operational", False)
    assert [(line["state"], line["driven"]) for line in lines[-3:]] == [
        ("operational", True), ("operational", False), ("pre-operational", False),
    ]  # fmt: skip
    last_us = int(np.fromfile(bench / "truth.bin", TRUTH)["t_us"][-1])
    waited_us = 1e6 * lines[-2]["t_s"] - last_us
    assert DRIVE_TIMEOUT_US - 100_000 < waited_us <= DRIVE_TIMEOUT_US + 10 * PERIOD_US
    killed = Recording.open(bench / "killed" / "recording.parquet")
    assert not killed.whole
    assert (np.diff(killed["tick"]) == 1).all()


def test_someone_else_who_sends_damaged_sense_frames_is_a_fault(bench, plant):
    words = ("--native", "--out", "damaged", "--replace", "--seconds", "60", "--json")
    with driving(bench, plant, *words) as (run, looking, _):
        send_damaged_sense_frames(bench, looking)
        assert drive_frames(looking, run, driven=False)
        os.kill(loop_of(run), signal.SIGTERM)
        code, out, err = run.wait()
    assert code == 128 + signal.SIGTERM, err
    assert_damage_was_a_fault(bench / "damaged", out)
    plant.seen("pre-operational", False)
