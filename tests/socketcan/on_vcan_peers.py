"""What others wrote, over the kernel's CAN sockets; run in a guest by ``run.py``, after ``on_vcan.py``.

durand's stack as the amplifier, python-canopen as master and as amplifier, can-utils and cantools as onlookers and as
somebody else on the bus; error frames, and an interface that goes down and comes back.
"""

import fcntl
import heapq
import json
import multiprocessing
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import can
import canopen
import cantools
import numpy as np
import pytest
from on_vcan import (
    ATTEMPTS,
    DRIVE,
    EMCY,
    SCENARIO,
    SENSE,
    SYNC,
    Command,
    drive_frames,
    driving,
    is_fd,
    next_frame,
    observer,
    served,
    slow_bus,
    slow_law,
)
from patience import replaced

sys.path.insert(0, str(Path(__file__).parent.parent / "peers"))
from durand_module import PRODUCT, VENDOR, DurandModule

import hil.commands.dbc
import hil.commands.new  # noqa: F401
from hil.conformance.simulated import simulated_plant
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.can.cob_id import NmtState, state_name
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import CONFIG_DIR, load
from pkxyz_ctrl.io.can_port import to_frame, to_message

EDS = CONFIG_DIR / "comb_amplifier.eds"
NODE_ID = 10
NAMES = {int(state): state_name(state) for state in NmtState}
CAN_ERR_FLAG, CAN_ERR_BUSOFF, CAN_ERR_RESTARTED = 0x2000_0000, 0x40, 0x100  # linux/can.h, linux/can/error.h
STOOD_STILL = "NODE_EMERGENCY", "HEARTBEAT_LOST", "OVERRUN", "SENSE_STALE"  # what a guest that does is taken for
SIOCGIFFLAGS, SIOCSIFFLAGS, IFF_UP = 0x8913, 0x8914, 1


@pytest.fixture(scope="module", params=["socketcan_classic", "socketcan_fd"])
def bench(request):
    """A folder with a scenario, a patient law, our own bus file, and one for a plain module of another vendor."""
    folder = Path(tempfile.mkdtemp(prefix=request.param))
    slow_law(folder)
    (folder / "slow_scan.toml").write_text(SCENARIO)
    text = replaced(r"^drive_timeout_ms = \d+", "drive_timeout_ms = 1000", slow_bus(request.param))
    (folder / "bus.toml").write_text(text)
    identity = f"vendor_id = {VENDOR}\nproduct_code = {PRODUCT}\n"
    (folder / "plain.toml").write_text(text.replace("protection = true", "protection = false") + identity)
    load_scenario(folder / "slow_scan.toml").setup().law  # noqa: B018  imports the rest, before processes part
    simulated_plant(load("buses", folder / "plain.toml", BusConfig))
    return folder


class WallScheduler:
    """Appointments on the machine's clock, kept between frames."""

    def __init__(self):
        self._waiting, self._count = [], 0

    @property
    def now_us(self):
        return time.monotonic_ns() // 1000

    def call_at(self, t_us, fn):
        self._count += 1
        heapq.heappush(self._waiting, (t_us, self._count, fn))

    def ring(self):
        """Keep what is due; seconds until the next."""
        while self._waiting and self._waiting[0][0] <= self.now_us:
            heapq.heappop(self._waiting)[2]()
        return max(0.0, (self._waiting[0][0] - self.now_us) * 1e-6) if self._waiting else 1.0


def serve_durand(folder, bus_file, consumer):
    """The module, in its process: states and voltages go to a file as they change."""
    config = load("buses", folder / bus_file, BusConfig)
    with (
        can.Bus(interface="socketcan", channel="can0", fd=config.can.driver.fd) as bus,
        (folder / "module").open("w", buffering=1) as told,
    ):
        clock = WallScheduler()
        module = DurandModule(
            NODE_ID, clock, lambda frame: bus.send(to_message(frame)), simulated_plant(config),
            fd=config.can.driver.fd, consumer=consumer,
        )  # fmt: skip
        module.power_on()
        was = None
        while True:
            message = bus.recv(min(0.5, clock.ring()))
            if message is not None:
                module.on_frame(to_frame(message), clock.now_us)
            now = NAMES[int(module.node.nmt.state)], any(module.outputs)
            if now != was:
                was = now
                told.write(json.dumps({"state": now[0], "driven": now[1], "t_us": clock.now_us}) + "\n")


@contextmanager
def durand_module(folder, bus_file="plain.toml", consumer="acts"):
    """Has a ``process``; ``seen`` waits for a state and returns all changes so far."""
    (folder / "module").write_text("")
    process = multiprocessing.get_context("fork").Process(target=serve_durand, args=(folder, bus_file, consumer))
    process.start()

    def seen(state, driven):
        end_s = time.monotonic() + 120
        while True:
            lines = [json.loads(line) for line in (folder / "module").read_text().splitlines()]
            if lines and (lines[-1]["state"], lines[-1]["driven"]) == (state, driven):
                return lines
            assert process.is_alive()
            assert time.monotonic() < end_s, lines
            time.sleep(0.05)

    try:
        seen("pre-operational", False)
        yield SimpleNamespace(process=process, seen=seen)
    finally:
        process.kill()
        process.join()


def controller(folder, bus_file, *words):
    return Command(folder, "run", "slow_scan.toml", "--bus", bus_file, *words)


@contextmanager
def tool(*words, **streams):
    """A program of can-utils, ended with this."""
    with subprocess.Popen(words, **streams) as process:
        try:
            yield process
        finally:
            process.terminate()


def test_durands_module_is_driven_and_does_without_a_controller_that_is_killed(bench):
    with durand_module(bench) as module:
        words = ("--out", "plain", "--replace", "--seconds", "60", "--json")
        with driving(bench, module, *words, bus="plain.toml") as (run, _, frames):
            run.signal(signal.SIGKILL)
            killed_us = time.monotonic_ns() // 1000
        lines = module.seen("pre-operational", False)
    assert {fd for *_, fd, _ in frames} == {is_fd(bench)}
    by_id = {can_id: data for can_id, data, *_ in frames}
    assert (len(by_id[DRIVE]), len(by_id[SENSE]), by_id[SYNC]) == (6, 6, b"")  # no counter, no CRC, plain SYNC
    assert [(line["state"], line["driven"]) for line in lines[-3:-1]] == [("operational", False), ("operational", True)]
    assert lines[-1]["t_us"] - killed_us < 1_300_000  # 0x1016 is 1 s here


def test_durands_module_that_dies_is_a_fault(bench):
    with durand_module(bench) as module:
        words = ("--out", "dies", "--replace", "--seconds", "60", "--json")
        with driving(bench, module, *words, bus="plain.toml") as (run, _, _):
            module.process.kill()
            code, out, err = run.wait()
    assert code == 1, err
    assert "HEARTBEAT_LOST" in json.loads(out)["faults"][0]
    log = list(can.LogReader(bench / "dies" / "frames.log"))
    assert not any([message for message in log if message.arbitration_id == DRIVE][-1].data[:6])


def test_a_module_that_only_stores_what_it_should_do_without_us_has_no_voltage(bench):
    with durand_module(bench, consumer="stores") as module:
        with controller(bench, "plain.toml", "--out", "stores", "--replace") as run:
            code, _, err = run.wait()
        lines = module.seen("pre-operational", False)
    assert code != 0
    assert "did not notice that our heartbeat ended" in " ".join(err.split())
    assert not any(line["driven"] for line in lines)


def test_canopens_master_finds_our_node_as_its_eds_says(bench):
    if is_fd(bench):
        pytest.skip("python-canopen sends classic frames only")
    with served(bench):
        network = canopen.Network()
        network.connect(interface="socketcan", channel="can0")
        try:
            node = network.add_node(NODE_ID, str(EDS))
            node.sdo.RESPONSE_TIMEOUT = 3
            node.nmt.send_command(0x81)
            node.nmt.wait_for_bootup(10)
            assert node.sdo[0x1000].raw == 0x000E0191
            assert node.sdo[0x1008].raw == "pkxyz comb amplifier"  # in segments
            assert [node.sdo[0x1018][part].raw for part in (1, 2, 3, 4)] == [0x7078797A, 3, 0x10000, 1]
            with pytest.raises(canopen.SdoAbortedError, match="0x06020000"):
                node.sdo.upload(0x5FFF, 0)
            with pytest.raises(canopen.SdoAbortedError, match="0x06010002"):
                node.sdo.download(0x1000, 0, bytes(4))
            node.sdo[0x1017].raw = 100
            node.nmt.state = "OPERATIONAL"
            assert node.nmt.wait_for_heartbeat(5) == "OPERATIONAL"
            node.nmt.state = "PRE-OPERATIONAL"
            node.sdo[0x1019].raw = 0
            node.tpdo.read()
            assert [variable.index for variable in node.tpdo[2].map] == [0x6401] * 3 + [0x2001] * 2
            node.nmt.state = "OPERATIONAL"
            time.sleep(0.2)
            for _ in range(8):
                network.sync.transmit()
                node.tpdo[2].wait_for_reception(5)
            assert all(-32768 <= variable.raw <= 32767 for variable in node.tpdo[2].map[:3])
            time.sleep(0.2)
            assert [error.code for error in node.emcy.log] == [0x8250]  # SYNC without a drive PDO
            node.nmt.state = "STOPPED"
            assert node.nmt.wait_for_heartbeat(5) == "STOPPED"
        finally:
            network.disconnect()


def test_canopens_local_node_stores_everything_and_is_not_enabled(bench):
    if is_fd(bench):
        pytest.skip("python-canopen sends classic frames only")
    network = canopen.Network()
    network.connect(interface="socketcan", channel="can0")
    try:
        node = network.create_node(NODE_ID, str(EDS))
        follow = {0x81: (129, 128), 0x80: (128,), 0x01: (1,)}

        def on_nmt(can_id, data, timestamp):
            if data[1] == NODE_ID:
                for command in follow[data[0]]:
                    node.nmt.send_command(command)

        network.subscribe(0, on_nmt)
        with controller(bench, "bus.toml", "--out", "local", "--replace") as run:
            code, _, err = run.wait()
        assert code != 0
        assert "did not notice that our heartbeat ended" in " ".join(err.split())
        assert node.sdo[0x1016][1].raw >> 16 == 127
    finally:
        network.disconnect()


def test_can_utils_and_cantools_read_a_run_and_anothers_nmt_is_a_fault(bench):
    """candump sees what our own log says, cantools reads it by our DBC; canplayer's NMT command ends it. Both are there
    before: a program that is started in the guest holds everybody up for too long.
    """
    log = bench / "dump"
    with (
        served(bench) as plant,
        log.open("w") as out,
        tool("candump", "-L", "can0", stdout=out),
        tool("canplayer", "-t", stdin=subprocess.PIPE, bufsize=0) as somebody,
    ):
        words = ("--out", "watched", "--replace", "--seconds", "60", "--json")
        for _ in range(ATTEMPTS):  # a guest that stands still meanwhile is a fault of its own
            with driving(bench, plant, *words) as (run, looking, _):
                somebody.stdin.write(b"(0.0) can0 000##10200\n" if is_fd(bench) else b"(0.0) can0 000#0200\n")
                assert drive_frames(looking, run, driven=False)
                run.signal(signal.SIGTERM)
                code, text, err = run.wait()
            (fault,) = json.loads(text)["faults"]
            if "FOREIGN_FRAME" in fault:
                break
            assert any(word in fault for word in STOOD_STILL), fault
    assert code == 128 + signal.SIGTERM, err
    assert "FOREIGN_FRAME" in fault
    assert "0x000 [02 00], an NMT command" in fault
    seen, ours = (
        [(m.arbitration_id, bytes(m.data), m.is_fd) for m in can.LogReader(path)]
        for path in (str(log.rename(log.with_suffix(".log"))), bench / "watched" / "frames.log")
    )
    assert len(seen) >= len(ours) > 300
    for can_id in (SYNC, DRIVE, SENSE, 0x58A, 0x60A):  # each party sees its own frames at another place among the rest
        theirs, own = ([frame for frame in frames if frame[0] == can_id] for frames in (seen, ours))
        own = own[:200]
        assert own
        assert any(theirs[at : at + len(own)] == own for at in range(len(theirs)))
    dbc = Command(bench, "dbc", "--bus", "bus.toml", "--out", "bench.dbc")
    with dbc:
        assert dbc.wait()[0] == 0
    database = cantools.database.load_file(bench / "bench.dbc")
    volts = [list(database.decode_message(can_id, data).values())[:3] for can_id, data, _ in seen if can_id == DRIVE]
    assert 0.0 < np.max(volts) <= 200.0


def test_canplayer_plays_a_run_to_the_socket(bench):
    log = bench / "short.log"
    lines = (bench / "watched" / "frames.log").read_text().splitlines()[:60]
    log.write_text("\n".join(lines) + "\n")
    channel = lines[0].split()[1]
    with observer(bench) as looking:
        subprocess.run(["canplayer", "-t", "-I", log, f"can0={channel}"], check=True)
        played = [next_frame(looking)[:2] for _ in lines]
    assert played == [(m.arbitration_id, bytes(m.data)) for m in can.LogReader(log)]


def set_up(is_up):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        request = struct.pack("16sh14x", b"can0", 0)
        flags = struct.unpack("16sh14x", fcntl.ioctl(any_socket, SIOCGIFFLAGS, request))[1]
        flags = flags | IFF_UP if is_up else flags & ~IFF_UP
        fcntl.ioctl(any_socket, SIOCSIFFLAGS, struct.pack("16sh14x", b"can0", flags))


def error_frame(kind):
    return struct.pack("<IBBBB8s", CAN_ERR_FLAG | kind, 8, 0, 0, 0, bytes(8))


def test_error_frames_are_looked_over_and_a_bus_off_is_a_fault_from_which_there_is_a_way_back(bench):
    """As the kernel tells both: error frames, and an interface that takes nothing until it is restarted."""
    with served(bench) as node:
        words = ("--out", "off", "--replace", "--seconds", "60", "--json")
        with driving(bench, node, *words) as (run, looking, _):
            for _ in range(20):
                looking.send(error_frame(CAN_ERR_RESTARTED))
            assert drive_frames(looking, run, driven=True, frames=30)  # it goes on
            set_up(False)
            try:
                code, out, err = run.wait()
            finally:
                set_up(True)
        assert code == 1, err
        assert json.loads(out)["faults"]
        assert "it is down" in " ".join((out + err).split())
        lines = [json.loads(line) for line in node.out.read_text().splitlines()]
        assert not lines[-1]["driven"]
        with driving(bench, node, "--out", "again", "--replace", "--seconds", "60"):
            pass


def test_the_tools_are_there():
    assert shutil.which("candump")
    assert os.environ["PATH"]
    assert EMCY == 0x08A
