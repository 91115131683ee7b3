"""Two processes and the machine's clock: controller and plant meet on Unix sockets, and one of them is ended. Nothing
is asserted about the machine: motion is compared where no tick was missed, times are those of the frames.
"""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time

import can
import numpy as np
import pytest
from two_processes import (
    ROOT,
    assert_0_v_in_the_time_of_drive_frames,
    assert_ended_by_the_controller,
    assert_ends_without_its_plant,
    assert_led_down_from_outside,
    assert_missed_by_the_node,
    assert_skipped_whole_ticks,
    bench,
    changes,
    controller,
    driving,
    is_driving,
    next_with,
    stand_still,
)

from hil.bus.unix_bus import UnixBus
from hil.commands import run as run_cli
from hil.lanes import in_process as lanes
from hil.lanes.ending import Ending
from hil.lanes.lane import Lane
from hil.lanes.standstill import STANDSTILL_US
from hil.lanes.wall import WallRig, wall_gate
from hil.lanes.wall_plant import TRUTH
from hil.recording.recording import Recording
from hil.recording.wall_recorder import WallRecorder
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.safety.modes import NODE_EXPECTED, Mode

pytestmark = pytest.mark.at_rate

__all__ = ["bench", "changes"]

SDO_REPLY, SDO_REQUEST, HEARTBEAT = 0x58A, 0x60A, 0x70A


def truth_of(folder, rows, since):
    """The true positions (n, 3) that belong to rows of a recording, NaN where the sense frame did not come. ``since``:
    how many samples of the truth are older than the run.
    """
    truth = np.fromfile(folder / "truth.bin", TRUTH)
    place = {}
    for index, counts in enumerate(truth["sense_count"][since:].tolist(), start=since):
        place.setdefault(tuple(counts), []).append(index)
    positions, last = np.full((len(rows), 3), np.nan), -1
    for row, (counts, status) in enumerate(rows):
        after = [index for index in place.get(tuple(counts), ()) if index > last] if status == 0 else []
        if after:
            last = after[0]
            positions[row] = truth["position_m"][last]
    return positions


def undisturbed(bench, out_name):
    """Trajectory ticks (n,) and true positions (n, 3) of a run, from 30 periods after any tick that was missed."""
    since = (bench / "truth.bin").stat().st_size // TRUTH.itemsize
    with controller(bench, "on_slow.toml", "--bus", "slow.toml", "--out", out_name, "--json") as run:
        out, err = run.communicate(timeout=120)
        assert run.returncode == 0, err
    summary = json.loads(out)
    assert "real time: " in err
    if summary["faults"]:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    recording = Recording.open(bench / out_name / "recording.parquet")
    status, overrun = recording["sense_status"], recording["overrun"]
    owed = np.asarray(NODE_EXPECTED)[recording["mode"]]
    late = summary["missed_ticks"] - overrun.sum() - ((status & 1) * owed).sum()
    assert 0 <= late <= recording.ticks // 20  # drive frames that were still waiting at their SYNC
    assert recording.ticks == 1800
    position = truth_of(bench, list(zip(recording.vector("sense_count").tolist(), status, strict=True)), since)
    disturbed = np.convolve((overrun > 0) | (status != 0), np.ones(30))[: recording.ticks] > 0
    tick = recording["reference_tick"]
    usable = (tick >= 0) & ~disturbed & ~np.isnan(position[:, 0])
    return tick[usable], position[usable]


def test_trajectories_agree_with_lockstep_within_the_noise(bench, changes):
    """Ticks 30 periods after any that was missed are compared: the stage's swing has died away by then. A machine that
    stands still may leave too few of them, or end in a fault, and then it runs again.

    Same plant, same seed. The samples' noise is generated in order, so it is the same only until the first missed tick:
    two independent draws differ by sqrt(2) times the noise of one, and a millisecond's
    jitter of 5 us at 20 um/s is 0.1 nm.
    """
    changes("pre-operational", False)
    blocks = []
    setup = load_scenario(bench / "on_slow.toml").setup()
    lanes.run(setup, Lane.LOCKSTEP, on_block=lambda block: blocks.append(block.copy()))
    exact = np.concatenate(blocks)
    exact = exact[exact["mode"] == Mode.TRACKING]
    for attempt in range(3):
        tick, position = undisturbed(bench, f"agree{attempt}")
        tick, position = tick[tick < len(exact)], position[tick < len(exact)]
        if len(tick) > 300 and np.ptp(position, axis=0).max() > 15e-6:
            break
        changes("pre-operational", False)
    else:
        pytest.fail("in three runs the machine left too little to compare")

    difference_nm = 1e9 * (position - exact["position_m"][tick])
    moving = tick > 500
    noise_nm = 1e9 * (exact["position_m"] - exact["reference_m"])[-300:].std(axis=0)
    assert (np.median(np.abs(difference_nm[moving]), axis=0) < 2 * noise_nm + 0.5).all()
    assert (np.abs(difference_nm.mean(axis=0)) < 3 * noise_nm).all()


def test_killed_controller_leaves_0_v_in_the_time_of_its_drive_frames_and_then_no_node_in_operational(bench, changes):
    changes("pre-operational", False)
    words = ("on_quick.toml", "--bus", "quick.toml", "--out", "killed", "--replace", "--seconds", "60")
    with UnixBus(f"{bench}/bus") as observer, driving(bench, observer, *words) as run:
        os.kill(run.pid, signal.SIGKILL)
        killed_s = time.time()
        run.communicate(timeout=30)
        assert_missed_by_the_node(observer, killed_s)
        for comb in (1, 2, 3):
            request = bytes((0x40, 0x11, 0x64, comb, 0, 0, 0, 0))
            observer.send(can.Message(arbitration_id=SDO_REQUEST, data=request, is_extended_id=False))
            reply = next_with(observer, SDO_REPLY)
            assert reply.data[1:4] == bytes((0x11, 0x64, comb))
            assert int.from_bytes(reply.data[4:6], "little") == 0
    assert_0_v_in_the_time_of_drive_frames(bench, changes("pre-operational", False))
    for _ in range(100):  # the writer outlives the controller and closes the recording
        if (bench / "killed" / "recording.parquet").is_file():
            break
        time.sleep(0.1)
    killed = Recording.open(bench / "killed" / "recording.parquet")
    assert killed.ticks > 200
    assert (np.diff(killed["tick"]) == 1).all()


def test_a_stopped_controller_goes_on_and_sigterm_ends_it_at_0_v(bench, changes):
    """Asleep for 40 ms: missed ticks are skipped whole and counted, and with its monitor off the run goes on."""
    changes("pre-operational", False)
    words = ("on_slow.toml", "--bus", "slow.toml", "--out", "ended", "--replace", "--seconds", "60")
    with UnixBus(f"{bench}/bus") as observer, driving(bench, observer, *words) as run:
        stand_still(run.pid)
        assert is_driving(observer, run)
        run.send_signal(signal.SIGTERM)
        out, err = run.communicate(timeout=60)
        assert run.returncode == 128 + signal.SIGTERM, err
    assert changes("pre-operational", False)[-2]["driven"]
    assert_skipped_whole_ticks(Recording.open(bench / "ended" / "recording.parquet"))
    assert_led_down_from_outside(bench / "ended", out)
    assert (bench / "ended" / "report.png").stat().st_size > 10_000
    log = list(can.LogReader(bench / "ended" / "frames.log"))
    drives = [message for message in log if message.arbitration_id == 0x30A]
    assert not any(drives[-1].data[:6])
    assert log[-1].arbitration_id in (0x000, 0x70A)


def test_a_run_whose_plant_is_killed_ends_by_itself_with_a_line_and_is_not_ok(tmp_path):
    assert_ends_without_its_plant(tmp_path)


@pytest.mark.slow
def test_ctrl_c_ends_at_0_v(bench, changes):
    changes("pre-operational", False)
    words = ("on_slow.toml", "--bus", "slow.toml", "--out", "interrupted", "--replace", "--seconds", "60", "--json")
    with UnixBus(f"{bench}/bus") as observer, driving(bench, observer, *words) as run:
        run.send_signal(signal.SIGINT)
        out, err = run.communicate(timeout=60)
    assert run.returncode == 128 + signal.SIGINT, err
    assert json.loads(out)["interrupted"]
    assert changes("pre-operational", False)[-2]["driven"]
    assert_ended_by_the_controller(bench / "interrupted" / "frames.log")


def test_a_full_disk_ends_at_0_v_with_one_line_and_what_was_written_opens(bench, changes):
    """A crash under way: the recorder's process fails, so does the loop, and the controller still takes the combs down.

    Every file of the run may hold 1.2 MB, which the journal exceeds after some thousand ticks.
    """
    words = ("on_slow.toml", "--bus", "slow.toml", "--out", "full", "--replace", "--seconds", "60")
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (1_200_000, 1_200_000))"
    script = f"import sys; {limit}; from hil.cli import main; sys.argv[0] = 'pkxyz'; main()"
    for _ in range(3):  # a machine that stands still may put it in fault before it has driven anything
        changes("pre-operational", False)
        run = subprocess.run(
            [sys.executable, "-c", script, "run", *words], cwd=bench, text=True, check=False, capture_output=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)}, timeout=120,
        )  # fmt: skip
        lines = changes("pre-operational", False)
        if lines[-2]["driven"]:
            break
    assert run.returncode == 2
    complaints = [line for line in run.stderr.splitlines() if line.startswith("pkxyz: ")]
    assert len(complaints) == 1, run.stderr
    assert "file too large" in complaints[0]
    assert "Traceback" not in run.stderr
    assert lines[-2]["driven"]
    print(lines)
    assert lines[-1]["t_s"] - lines[-2]["t_s"] < 30
    full = Recording.open(bench / "full" / "recording.parquet")
    assert full.ticks >= 2048
    assert (np.diff(full["tick"]) == 1).all()


def test_bad_input_is_refused_with_one_line(bench, monkeypatch):
    monkeypatch.chdir(bench)
    for command, words, expected in (
        (run_cli.run, {"bus": "fd_5k"}, "is simulated"),
        (run_cli.plant, {"bus": "local_20k"}, "has no \\[can\\]"),
        (run_cli.run, {"duration_s": -1.0}, "--seconds: -1"),
        (run_cli.plant, {"bus": "unix_9k"}, "did you mean"),
    ):
        with pytest.raises(ConfigError, match=expected):
            command(**words)
    assert not (bench / "runs").exists()


def test_run_and_plant_meet_on_the_scenarios_bus_unless_it_is_simulated(bench, monkeypatch, capsys):
    monkeypatch.chdir(bench)
    assert run_cli._met("on_quick.toml", bus=None).bus == load_scenario("on_quick.toml").bus
    assert run_cli._met("on_quick.toml", bus="slow.toml").bus == load_scenario("on_quick.toml", bus="slow.toml").bus
    assert capsys.readouterr().err == ""
    met = run_cli._met("raster", bus=None)
    assert met.bus.name == "unix_2k"
    assert met.bus.can.standstill_max_us == STANDSTILL_US
    assert load_scenario("raster", bus="unix_2k").bus.can.standstill_max_us == 0
    assert "fd_5k, is simulated; meeting on unix_2k" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="is simulated"):  # asked for by name, it is refused
        run_cli.run("raster", bus="fd_5k")


class Stopped:
    """A clock that stands still where nobody waits for it."""

    def __init__(self, now_us):
        self.now_us = now_us
        self.spend = None

    def wait_until(self, t_us):
        self.now_us = max(self.now_us, t_us)


def test_ticks_keep_as_far_apart_as_the_gate_asks(tmp_path):
    """A tick that ends less than a guard before the next one is to begin gives it up: the gate would stop its drive
    frame, which may be no nearer to the one before than that.
    """
    setup = load_scenario("raster", bus="unix_2k").setup()
    can_config = setup.bus.can.model_copy(update={"channel": f"{tmp_path}/bus"})
    setup = dataclasses.replace(setup, bus=setup.bus.model_copy(update={"can": can_config}))
    guard_us = wall_gate(setup.gate).spacing_min_us
    assert guard_us == 500 // 8
    recorder = WallRecorder(tmp_path / "rows.parquet", tmp_path / "frames.log", {}, "bus")
    try:
        rig = WallRig(setup, recorder, Ending())
        for end_us, begins_us in ((500 - guard_us, 500), (500 - guard_us + 1, 1000), (499, 1000)):
            rig.ticks._clock = rig.clock = Stopped(end_us)
            rig.ticks.wait_until(500)
            assert rig.ticks._clock.now_us == begins_us
        rig.close()
    finally:
        recorder.close()
