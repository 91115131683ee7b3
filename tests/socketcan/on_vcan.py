"""Controller and plant in two processes over the kernel's CAN sockets; run in a guest by ``run.py``.

The kernel's interface is a virtual one, the rest is what an engineer would run: the shipped bus files, python-can's
``socketcan``, ``pkxyz plant`` and ``pkxyz run``. An observer of our own looks on with a bare socket. The guest's single
processor goes from one to the other when it likes, so ticks are slow and monitors of lateness are off; nothing is said
about when, except by the node's own clock. Imports take longest there, so processes are forked after them.
"""

import ctypes
import faulthandler
import json
import multiprocessing
import os
import signal
import socket
import struct
import sys
import tempfile
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import can
import can.interfaces.socketcan
import canopen  # noqa: F401
import numpy as np
import pyarrow.parquet  # noqa: F401
import pytest
from patience import patient_law, replaced
from two_processes import assert_damage_was_a_fault

import hil.commands.check_amplifier
import hil.commands.run  # noqa: F401  a command is loaded when it is called, which in the guest takes a while
from hil.cli import main
from hil.lanes.wall_plant import TRUTH
from hil.pictures.wall import draw_wall  # noqa: F401
from hil.recording.recording import Recording
from hil.runs.replay import replay
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.config.files import CONFIG_DIR
from pkxyz_ctrl.design.law import way_down_ticks
from pkxyz_ctrl.safety.modes import Mode

PERIOD_US = 10_000
TIMEOUT_US = 1_000_000  # the guest stands still for longer than 0.2 s now and then
DRIVE_TIMEOUT_US = 600_000
CAPABILITIES_VERSION, SYS_NICE = 0x2008_0522, 23  # linux/capability.h
DROP_FROM_BOUNDS = 24  # linux/prctl.h: PR_CAPBSET_DROP
CANFD_BRS = 0x01  # linux/can.h
ATTEMPTS = 6
STUCK_S = 60  # a process that still runs then writes where it is
NMT, SYNC, DRIVE, SENSE, EMCY, OURS = 0x000, 0x080, 0x30A, 0x28A, 0x08A, 0x77F
SCENARIO = """
name = "slow_scan"
duration_s = 3.2
seed = 3
stage = "reconstructed"
plant = "nominal"
controller = "patient.toml"
bus = "bus.toml"
[[reference]]
kind = "hold"
duration_s = 0.02
measured = false
[[reference]]
kind = "move"
to_m = [0.0, 0.0, 19.2495e-6]
velocity_max_m_per_s = 0.05e-3
acceleration_max_m_per_s2 = 1.0e-3
jerk_max_m_per_s3 = 0.05
[[reference]]
kind = "waypoints"
points_m = [
    [2.0e-6, 0.0, 19.2495e-6],
    [-2.0e-6, 0.3e-6, 19.2495e-6],
    [2.0e-6, 0.6e-6, 19.2495e-6],
    [0.0, 0.0, 19.2495e-6],
]
deviation_m = 50.0e-9
velocity_max_m_per_s = 0.02e-3
acceleration_max_m_per_s2 = 1.0e-3
jerk_max_m_per_s3 = 0.05
"""


@pytest.fixture(scope="module", params=["socketcan_fd", "socketcan_classic"])
def bench(request):
    """A folder with the scenario, the shipped bus at a slow rate and the shipped law, patient with lateness."""
    folder = Path(tempfile.mkdtemp(prefix=request.param))
    slow_law(folder)
    (folder / "bus.toml").write_text(slow_bus(request.param), encoding="utf-8")
    (folder / "slow_scan.toml").write_text(SCENARIO, encoding="utf-8")
    return folder


def slow_law(folder):
    """The shipped law, patient with lateness, as ``patient.toml`` in the folder."""
    law = patient_law(folder)
    slow = replaced(r"^slew_max_v_per_s = \S+", "slew_max_v_per_s = 15.0e3", law.read_text(encoding="utf-8"))
    law.write_text(slow, encoding="utf-8")


def slow_bus(name):
    """A shipped bus at a slow rate, its [can.driver] last."""
    bus = (CONFIG_DIR / "buses" / f"{name}.toml").read_text(encoding="utf-8")
    for key, value in (("period", PERIOD_US), ("sense_deadline", 8000), ("heartbeat_deadline", 9900)):
        bus = replaced(rf"^{key}_us = \d+", f"{key}_us = {value}", bus)
    timeouts = f"controller_heartbeat_timeout_ms = {TIMEOUT_US // 1000}\nnode_heartbeat_timeout_ms = 2500\n"
    timeouts += f"drive_timeout_ms = {DRIVE_TIMEOUT_US // 1000}\n"
    timeouts += "boot_timeout_us = 20_000_000\nstart_timeout_us = 5_000_000\nsdo_timeout_us = 5_000_000\n"
    return bus + timeouts


def is_fd(bench):
    return "_fd" in bench.name


def without_real_time():
    """Give up CAP_SYS_NICE: on one processor, two loops under SCHED_FIFO would leave nothing to the observer."""
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.prctl(DROP_FROM_BOUNDS, SYS_NICE, 0, 0, 0) == 0  # or a program that we begin gets it back
    header = ctypes.create_string_buffer(struct.pack("Ii", CAPABILITIES_VERSION, 0))
    sets = ctypes.create_string_buffer(24)  # effective, permitted, inheritable; low and high words
    assert libc.capget(header, sets) == 0
    effective, permitted, *rest = struct.unpack("6I", sets.raw)
    kept = ~(1 << SYS_NICE)
    assert libc.capset(header, struct.pack("6I", effective & kept, permitted & kept, *rest)) == 0


class Command:
    """``pkxyz`` in a process of its own, in a folder, its streams in files there."""

    def __init__(self, folder, *words):
        self.out, self.err = (folder / f"{words[0]}.{name}" for name in ("out", "err"))
        self.out.write_text("")
        self.process = multiprocessing.get_context("fork").Process(target=self._run, args=(folder, words))
        self.process.start()
        self.pid = self.process.pid

    def _run(self, folder, words):
        os.chdir(folder)
        for number, path, name in ((1, self.out, "stdout"), (2, self.err, "stderr")):
            stream = path.open("w")
            os.dup2(stream.fileno(), number)
            setattr(sys, name, stream)
        faulthandler.dump_traceback_later(STUCK_S, file=sys.stderr)
        os.nice(10)  # whoever looks on is not left behind, with one processor for all
        without_real_time()
        sys.argv = ["pkxyz", *map(str, words)]
        main()

    def signal(self, number):
        with suppress(ProcessLookupError):  # it has ended by itself
            os.kill(self.pid, number)

    def wait(self, longest_s=200):
        """Its exit code, and what it wrote to both streams."""
        self.process.join(longest_s)
        return self.process.exitcode, self.out.read_text(), self.err.read_text()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.join()


@pytest.fixture(scope="module")
def plant(bench):
    """Serves node and plant; has ``seen``, which waits for a state and returns all changes so far."""
    load_scenario(bench / "slow_scan.toml").setup().law  # noqa: B018  imports the rest, once
    with served(bench) as command:
        yield command


@contextmanager
def served(bench):
    """``pkxyz plant`` in its process, with ``seen``."""
    command = Command(bench, "plant", "slow_scan.toml", "--truth", "truth.bin", "--bus", "bus.toml", "--json")

    def seen(state, driven):
        end_s = time.monotonic() + 120
        while True:
            lines = [json.loads(line) for line in command.out.read_text(encoding="utf-8").splitlines()]
            if lines and (lines[-1]["state"], lines[-1]["driven"]) == (state, driven):
                return lines
            assert command.process.is_alive(), command.wait()
            assert time.monotonic() < end_s, f"the node is not {state}, driven {driven}: {lines}"
            time.sleep(0.05)

    command.seen = seen
    with command:
        yield command
        command.signal(signal.SIGCONT)
        command.signal(signal.SIGTERM)
        code, _, err = command.wait()
        assert code == 0, err


@contextmanager
def observer(bench):
    """A socket of the kernel's, without python-can: (identifier, data, is_fd, flags) of each frame."""
    with socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as looking:
        if is_fd(bench):
            looking.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
        looking.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        looking.bind(("can0",))
        looking.settimeout(90)
        yield looking


def next_frame(looking):
    raw = looking.recv(72)
    can_id, length, flags = struct.unpack_from("<IBB", raw)
    return can_id & 0x1FFF_FFFF, raw[8 : 8 + length], len(raw) == 72, flags


def drive_frames(looking, run, driven, frames=20):
    """Frames seen until so many drive frames of a controller carried a voltage, or none; empty if they did not come, or
    if the node complained before, or was taken out of operational.
    """
    seen, came, is_running, end_s = [], 0, False, time.monotonic() + 120
    looking.settimeout(1)
    while came < frames:
        if not run.process.is_alive() or time.monotonic() > end_s:
            return []
        with suppress(TimeoutError):
            seen.append(next_frame(looking))
            can_id, data = seen[-1][:2]
            came += can_id == DRIVE and any(data[:6]) == driven
            is_running = is_running or can_id == DRIVE  # in the start-up before the node misses us as it should
            if driven and is_running and ((can_id == EMCY and any(data)) or can_id == NMT):
                return []
    looking.settimeout(90)
    return seen


@contextmanager
def driving(bench, plant, *words, bus="bus.toml"):
    """A controller that drives the combs, a socket that looks on, and the frames seen so far. A guest that stands still
    for a second puts it in fault at 0 V instead, so it may begin some times.
    """
    said = []
    for _ in range(ATTEMPTS):
        plant.seen("pre-operational", False)
        with (
            Command(bench, "run", "slow_scan.toml", "--bus", bus, *words) as run,
            observer(bench) as looking,
        ):
            if seen := drive_frames(looking, run, driven=True):
                yield run, looking, seen
                return
            run.signal(signal.SIGTERM)
            said.append(run.wait())
    pytest.fail(f"no voltages came: {said}")


def send_damaged_sense_frames(bench, looking):
    """After each of some SYNCs one with the node's identifier and a wrong CRC, from a third socket."""
    for n in range(20):
        while next_frame(looking)[0] != SYNC:
            pass
        data = bytes((1, 2, 3, 4, 5, 6, n, 0))
        if is_fd(bench):
            looking.send(struct.pack("<IBBBB64s", SENSE, 8, CANFD_BRS, 0, 0, data))
        else:
            looking.send(struct.pack("<IBBBB8s", SENSE, 8, 0, 0, 0, data))


def test_start_up_and_scan(bench, plant):
    """The stage follows; on the wire stands what the bus file says; the recording replays bit for bit."""
    with driving(bench, plant, "--out", "scan", "--replace", "--json") as (run, _, seen):
        code, out, err = run.wait()
    assert code == 0, err
    summary = json.loads(out)
    assert summary["faults"] == []
    assert summary["refused_frames"] == 0
    plant.seen("pre-operational", False)
    by_id = {can_id: (data, fd, flags) for can_id, data, fd, flags in seen}
    assert {0x000, SYNC, DRIVE, SENSE, 0x60A, 0x58A, 0x70A, OURS} <= set(by_id)
    assert {fd for _, fd, _ in by_id.values()} == {is_fd(bench)}
    assert len(by_id[DRIVE][0]) == len(by_id[SENSE][0]) == 8
    if is_fd(bench):
        assert all(flags & CANFD_BRS for _, _, flags in by_id.values())
    recording = Recording.open(bench / "scan" / "recording.parquet")
    assert recording.ticks == round(3.2e6 / PERIOD_US)
    good = recording["sense_status"] == 0
    assert good.mean() > 0.5
    tracking = (recording["mode"] == Mode.TRACKING) & good
    error_m = (recording.vector("measurement_m") - recording.vector("reference_m"))[tracking]
    assert np.abs(np.median(error_m, axis=0)).max() < 100e-9
    truth = np.fromfile(bench / "truth.bin", TRUTH)["position_m"]
    assert truth[:, 2].max() == pytest.approx(19.25e-6, abs=1.0e-6)
    assert np.ptp(truth[:, 0]) == pytest.approx(4.0e-6, abs=1.0e-6)
    assert np.abs(truth[-1]).max() < 30e-6
    result = replay(bench / "scan" / "recording.parquet")
    assert result.differences == []
    assert result.ticks == recording.ticks
    frames = list(can.LogReader(bench / "scan" / "frames.log"))
    way_down = way_down_ticks(0.005, PERIOD_US)[1] + 2  # and the ticks that begin and end it
    assert sum(frame.arbitration_id == SYNC for frame in frames) == recording.ticks + way_down


def test_killed_controller_leaves_0_v_in_the_time_of_its_drive_frames_and_then_no_node_in_operational(bench, plant):
    with driving(bench, plant, "--out", "killed", "--replace", "--seconds", "60") as (run, looking, _):
        run.signal(signal.SIGKILL)
        for code in (b"\x50\x82", b"\x30\x81"):  # no drive PDO, then heartbeat error (CiA 301, table 26)
            while (frame := next_frame(looking))[0] != EMCY:
                pass
            assert frame[1][:2] == code
    lines = plant.seen("pre-operational", False)
    assert [(line["state"], line["driven"]) for line in lines[-3:]] == [
        ("operational", True), ("operational", False), ("pre-operational", False),
    ]  # fmt: skip
    last_us = int(np.fromfile(bench / "truth.bin", TRUTH)["t_us"][-1])
    waited_us = 1e6 * lines[-2]["t_s"] - last_us
    assert waited_us <= DRIVE_TIMEOUT_US + 10 * PERIOD_US  # the guest's one processor may be with somebody else
    assert waited_us > DRIVE_TIMEOUT_US - 100_000


def test_a_node_that_falls_silent_is_a_fault(bench, plant):
    """The plant's process is stopped: our monitors find out, say why, only 0 V goes out from then on, and the run ends
    by itself, since nobody is there to be controlled.
    """
    with driving(bench, plant, "--out", "silent", "--replace", "--seconds", "60", "--json") as (run, _, _):
        plant.signal(signal.SIGSTOP)
        code, out, err = run.wait()
        plant.signal(signal.SIGCONT)
    assert code == 1, err
    log = list(can.LogReader(bench / "silent" / "frames.log"))
    assert not any([message for message in log if message.arbitration_id == DRIVE][-1].data[:6])
    (fault,) = json.loads(out)["faults"]
    assert "HEARTBEAT_LOST" in fault
    silent = Recording.open(bench / "silent" / "recording.parquet")
    at = int(np.argmax(silent["mode"] == Mode.FAULT))
    assert at > 0
    assert (silent["mode"][at:] == Mode.FAULT).all()
    assert not silent.vector("drive_count")[at:].any()
    plant.seen("pre-operational", False)


def test_someone_else_who_sends_damaged_sense_frames_is_a_fault(bench, plant):
    with driving(bench, plant, "--out", "damaged", "--replace", "--seconds", "60", "--json") as (run, looking, _):
        send_damaged_sense_frames(bench, looking)
        assert drive_frames(looking, run, driven=False)
        run.signal(signal.SIGTERM)
        code, out, err = run.wait()
    assert code == 128 + signal.SIGTERM, err
    assert_damage_was_a_fault(bench / "damaged", out)
    plant.seen("pre-operational", False)


def test_sigterm_leads_down_and_ends_at_0_v_by_the_controller(bench, plant):
    with driving(bench, plant, "--out", "ended", "--replace", "--seconds", "60") as (run, _, _):
        run.signal(signal.SIGTERM)
        code, _, err = run.wait()
    assert code == 128 + signal.SIGTERM, err
    assert plant.seen("pre-operational", False)[-2]["driven"]
    log = list(can.LogReader(bench / "ended" / "frames.log"))
    drives = [message for message in log if message.arbitration_id == DRIVE]
    highest = [max(struct.unpack_from("<3h", message.data)) for message in drives]
    last = max(n for n, count in enumerate(highest) if count > 0)
    assert last < len(highest) - 1
    assert highest[last] < 0.5 * max(highest)  # led down to rest, not dropped
    first = next(i for i, message in enumerate(log) if message.arbitration_id == DRIVE and any(message.data[:6]))
    assert not any(message.arbitration_id == EMCY for message in log[first:])
