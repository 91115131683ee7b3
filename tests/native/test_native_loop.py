"""The loop in C and the plant as two processes that meet on Unix sockets: what a user sees is as with Python's loop,
whoever is ended. Nothing is asserted about the machine.
"""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import can
import numpy as np
import pytest
from two_processes import (
    DRIVE,
    ROOT,
    assert_0_v_in_the_time_of_drive_frames,
    assert_damage_was_a_fault,
    assert_ended_by_the_controller,
    assert_ends_without_its_plant,
    assert_led_down_from_outside,
    assert_missed_by_the_node,
    assert_skipped_whole_ticks,
    bench_in,
    changes,
    controller,
    driving,
    is_driving,
    next_with,
    stand_still,
    started,
)

from hil.bus.unix_bus import UnixBus
from hil.native.program import compiled
from hil.recording.recording import Recording
from hil.runs.replay import replay
from hil.runs.seal import changed
from pkxyz_ctrl.compiled.kernel_cache import choose_kernel_cache
from pkxyz_ctrl.safety.modes import Mode

pytestmark = pytest.mark.at_rate

__all__ = ["changes"]

SENSE = 0x28A


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A folder with a scenario, and the program, compiled if it never was."""
    choose_kernel_cache()
    compiled()
    return bench_in(tmp_path_factory.mktemp("native"))


def long_run(name, bus="slow"):
    """Words of a run that somebody ends."""
    return (f"on_{bus}.toml", "--native", "--bus", f"{bus}.toml", "--out", name, "--replace", "--seconds", "60")


def children(pid):
    """Processes that one has begun, and what they were called with."""
    found = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()
    return {int(child): Path(f"/proc/{child}/cmdline").read_bytes() for child in found}


def loop_of(run):
    (pid,) = [pid for pid, words in children(run.pid).items() if b"/proc/self/fd/" in words]
    return pid


def recorder_of(run):
    (pid,) = [pid for pid, words in children(run.pid).items() if b"/proc/self/fd/" not in words]
    return pid


def test_a_run_leaves_what_python_s_loop_leaves_and_replays_in_every_bit(bench, changes):
    """The same files with the same columns, sealed; what Python computes from its rows is what the loop computed."""
    folders = {}
    for name, words in (("native", ("--native",)), ("python", ())):
        changes("pre-operational", False)
        with controller(bench, "on_slow.toml", *words, "--bus", "slow.toml", "--out", name, "--json") as run:
            out, err = run.communicate(timeout=180)
            assert run.returncode == 0, err
        assert "real time: " in err
        summary = json.loads(out)
        assert summary["faults"] == []
        assert summary["lost_rows"] == summary["refused_frames"] == summary["blocked_frames"] == 0
        answer_us = summary["answer_us"]
        assert 0 < answer_us["p50"] <= answer_us["p99_9"] <= answer_us["max"]
        folders[name] = bench / name, summary
    (native, native_summary), (python, python_summary) = folders.values()
    assert sorted(path.name for path in native.iterdir()) == sorted(path.name for path in python.iterdir())
    assert set(native_summary) == set(python_summary)
    assert (native / "report.png").stat().st_size > 10_000
    assert changed(native / "summary.json")[1] == []
    recording = Recording.open(native / "recording.parquet")
    assert recording.whole
    assert recording.ticks == 1800
    assert (np.diff(recording["tick"]) == 1).all()
    assert np.isnan(recording.vector("position_m")).all()
    assert (recording["mode"] == Mode.TRACKING).sum() > 1500
    result = replay(native / "recording.parquet")
    assert result.differences == []
    assert result.ticks == 1800
    frames = list(can.LogReader(native / "frames.log"))
    way_down = sum(frame.arbitration_id == 0x080 for frame in frames) - 1800
    assert way_down == sum(frame.arbitration_id == 0x080 for frame in can.LogReader(python / "frames.log")) - 1800
    assert_ended_by_the_controller(native / "frames.log")


def test_its_frames_and_python_s_begin_alike(bench, changes):
    """The start-up's dialogue, byte by byte, until the first period: of every frame that the controller sent."""
    begun = []
    for words in (("--native",), ()):
        changes("pre-operational", False)
        with controller(bench, "on_slow.toml", *words, "--bus", "slow.toml", "--out", "alike", "--replace") as run:
            _, err = run.communicate(timeout=180)
            assert run.returncode == 0, err
        frames = list(can.LogReader(bench / "alike" / "frames.log"))
        first = next(n for n, frame in enumerate(frames) if frame.arbitration_id == DRIVE)
        begun.append([(f.arbitration_id, bytes(f.data), f.is_fd) for f in frames[:first] if f.arbitration_id == 0x60A])
    assert begun[0] == begun[1]
    assert len(begun[0]) > 10


def test_sigterm_leads_the_stage_down(bench, changes):
    changes("pre-operational", False)
    with UnixBus(f"{bench}/bus") as observer, driving(bench, observer, *long_run("ended")) as run:
        run.send_signal(signal.SIGTERM)
        out, err = run.communicate(timeout=60)
    assert run.returncode == 128 + signal.SIGTERM, err
    assert changes("pre-operational", False)[-2]["driven"]
    assert_led_down_from_outside(bench / "ended", out)
    assert_ended_by_the_controller(bench / "ended" / "frames.log")


def test_a_loop_that_is_killed_leaves_0_v_in_the_time_of_its_drive_frames(bench, changes):
    """By the node alone; the recording is whole up to the last row, and what is left says what happened."""
    changes("pre-operational", False)
    with UnixBus(f"{bench}/bus") as observer, driving(bench, observer, *long_run("killed", "quick")) as run:
        os.kill(loop_of(run), signal.SIGKILL)
        killed_s = time.time()
        assert_missed_by_the_node(observer, killed_s)
        out, err = run.communicate(timeout=60)
    assert run.returncode == 128 + signal.SIGKILL, err
    assert "was killed by signal 9" in out
    assert_0_v_in_the_time_of_drive_frames(bench, changes("pre-operational", False))
    killed = Recording.open(bench / "killed" / "recording.parquet")
    assert not killed.whole
    assert killed.ticks > 200
    assert (np.diff(killed["tick"]) == 1).all()
    assert replay(bench / "killed" / "recording.parquet").differences == []


def test_whoever_began_the_loop_is_killed_and_the_stage_is_led_down(bench, changes):
    changes("pre-operational", False)
    with UnixBus(f"{bench}/bus") as observer, driving(bench, observer, *long_run("orphan")) as run:
        loop = loop_of(run)
        run.kill()
        run.communicate(timeout=30)
    lines = changes("pre-operational", False)
    assert lines[-2]["driven"]
    end_s = time.monotonic() + 20
    while Path(f"/proc/{loop}").exists() or not (bench / "orphan" / "recording.parquet").is_file():
        assert time.monotonic() < end_s
        time.sleep(0.05)
    assert_ended_by_the_controller(bench / "orphan" / "frames.log")
    assert Recording.open(bench / "orphan" / "recording.parquet").whole


def test_a_recorder_that_is_killed_is_told_in_a_line_and_the_stage_is_led_down(bench, changes):
    changes("pre-operational", False)
    with UnixBus(f"{bench}/bus") as observer, driving(bench, observer, *long_run("unrecorded")) as run:
        os.kill(recorder_of(run), signal.SIGKILL)
        seen = []
        while run.poll() is None:
            message = observer.recv(0.05)
            if message is not None:
                seen.append(message)
        _, err = run.communicate(timeout=60)
    assert run.returncode == 2, err
    (line,) = [line for line in err.splitlines() if line.startswith("pkxyz: ")]
    assert "was killed by signal 9" in line
    assert changes("pre-operational", False)[-2]["driven"]
    most = [max(np.frombuffer(m.data[:6], "<i2").tolist()) for m in seen if m.arbitration_id == DRIVE]
    last = max(n for n, count in enumerate(most) if count)
    assert most[-1] == 0
    assert most[last] < 0.4 * max(most)
    assert Recording.open(bench / "unrecorded" / "recording.parquet").ticks > 100


def test_a_stopped_loop_skips_whole_ticks_and_goes_on(bench, changes):
    changes("pre-operational", False)
    with UnixBus(f"{bench}/bus") as observer, driving(bench, observer, *long_run("stopped")) as run:
        stand_still(loop_of(run))
        assert is_driving(observer, run)
        run.send_signal(signal.SIGTERM)
        _, err = run.communicate(timeout=60)
    assert run.returncode == 128 + signal.SIGTERM, err
    assert_skipped_whole_ticks(Recording.open(bench / "stopped" / "recording.parquet"))


def test_damaged_sense_frames_of_somebody_else_are_a_fault_at_0_v(bench, changes):
    changes("pre-operational", False)
    words = [*long_run("damaged"), "--json"]
    with UnixBus(f"{bench}/bus") as observer, driving(bench, observer, *words) as run:
        for n in range(60):
            next_with(observer, 0x080)
            data = bytes((1, 2, 3, 4, 5, 6, n, 0))
            observer.send(can.Message(arbitration_id=SENSE, data=data, is_fd=True, is_extended_id=False))
        end_s = time.monotonic() + 30
        while any((drive := next_with(observer, DRIVE)).data[:6]):
            assert time.monotonic() < end_s, drive
        run.send_signal(signal.SIGTERM)
        out, err = run.communicate(timeout=60)
    assert run.returncode == 128 + signal.SIGTERM, err
    assert_damage_was_a_fault(bench / "damaged", out)
    assert replay(bench / "damaged" / "recording.parquet").differences == []


def test_what_is_no_frame_is_passed_over(bench, changes):
    """Whoever can write into the folder can send anything: too short, too long, lengths that do not fit."""
    changes("pre-operational", False)
    with UnixBus(f"{bench}/bus") as observer, driving(bench, observer, *long_run("rubbish")) as run:
        mine = f"{bench}/bus/pkxyz-{loop_of(run)}-1"
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as hostile:
            head = b"\0" * 8 + SENSE.to_bytes(4, "little")
            for datagram in (b"", b"x", head, head + bytes((64, 0)), head + bytes((9, 0)) + bytes(9), bytes(4000)) * 20:
                hostile.sendto(datagram, mine)
        assert is_driving(observer, run)
        run.send_signal(signal.SIGTERM)
        _, err = run.communicate(timeout=60)
    assert run.returncode == 128 + signal.SIGTERM, err
    assert json.loads((bench / "rubbish" / "summary.json").read_text(encoding="utf-8"))["faults"] == []


def test_a_node_that_is_not_there_is_told_as_by_python_s_loop(bench, tmp_path):
    said = []
    for words in (["--native"], []):
        path = bench / "alone.toml"
        text = (bench / "slow.toml").read_text(encoding="utf-8").replace(f"{bench}/bus", f"{tmp_path}/alone")
        path.write_text(text.replace("boot_timeout_us = 20_000_000", "boot_timeout_us = 200_000"), encoding="utf-8")
        run = started(bench, "run", "on_slow.toml", *words, "--bus", "alone.toml", "--wait", "0.1", "--out",
                      str(tmp_path / f"out{len(words)}"))  # fmt: skip
        out, err = run.communicate(timeout=120)
        assert run.returncode == 1, (out, err)
        said.append([line for line in err.splitlines() if not line.startswith("real time")])
    assert said[0] == said[1]
    assert "pkxyz plant" in said[0][-1]


def test_a_run_whose_plant_is_killed_ends_by_itself_with_a_line_and_is_not_ok(bench, tmp_path):
    assert_ends_without_its_plant(tmp_path, "--native")


def test_without_a_compiler_a_line_says_what_to_do(bench, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "CC": "no-such-compiler"}
    words = ["run", *long_run(str(tmp_path / "out"))]
    command = [sys.executable, "-m", "hil.cli", *words]
    done = subprocess.run(command, cwd=bench, env=environment, check=False, capture_output=True, text=True)
    assert done.returncode == 2
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("pkxyz: ")]
    assert "no-such-compiler is not on the PATH" in line
    assert "apt install gcc" in line
    assert not (tmp_path / "out").exists()
