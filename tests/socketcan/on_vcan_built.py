"""Stacks that are built by hand, CANopenNode and lely-core, over the kernel's CAN sockets (CONTRIBUTING.md says how).

In a guest: ``python tests/socketcan/run.py tests/socketcan/on_vcan_built.py``. What is not in the guest's ``usr/bin``
is skipped. Each test leaves what was on the bus in ``.uml/guest/NAME.log``; those in ``tests/peers/recorded`` are its.
"""

import json
import multiprocessing
import os
import shutil
import signal
import socket
import struct
import subprocess
import tempfile
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace

import can
import pytest
from on_vcan import SCENARIO, Command, driving, served, slow_bus, slow_law

import hil.commands.check_amplifier  # noqa: F401
from hil.conformance.simulated import simulated_plant
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import CONFIG_DIR, load

EDS = CONFIG_DIR / "comb_amplifier.eds"
LOGS = Path(__file__).parents[2] / ".uml" / "guest"
PORT = 5077


@pytest.fixture(scope="module")
def bench():
    folder = Path(tempfile.mkdtemp(prefix="socketcan_classic"))
    slow_law(folder)
    (folder / "slow_scan.toml").write_text(SCENARIO, encoding="utf-8")
    text = slow_bus("socketcan_classic")
    (folder / "bus.toml").write_text(text, encoding="utf-8")
    (folder / "plain.toml").write_text(text.replace("protection = true", "protection = false"), encoding="utf-8")
    load_scenario(folder / "slow_scan.toml").setup().law  # noqa: B018  imports the rest, before processes part
    simulated_plant(load("buses", folder / "plain.toml", BusConfig))
    return folder


@contextmanager
def recorded(name):
    """Everything on the bus, as candump writes it."""
    with (LOGS / name).open("w") as out, subprocess.Popen(["candump", "-L", "can0"], stdout=out) as dump:
        time.sleep(0.5)
        try:
            yield
        finally:
            dump.send_signal(signal.SIGINT)


@contextmanager
def program(folder, *words, **environment):
    """A program in its process; begun anew where it ends, as CANopenLinux does at NMT reset: that is for its maker."""
    if shutil.which(words[0]) is None:
        pytest.skip(f"{words[0]} is not built")
    again = f"while true; do {' '.join(words)}; done"
    with (
        (folder / f"{words[0]}.out").open("w") as out,
        subprocess.Popen(
            ["sh", "-c", again],
            cwd=folder,
            stdout=out,
            stderr=out,
            env=os.environ | environment,
            start_new_session=True,
        ) as process,
    ):
        try:
            yield SimpleNamespace(kill=lambda: os.killpg(process.pid, signal.SIGKILL))
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def serve_plant(folder):
    """Counts to the combs come by UDP, sense counts go back; what changes is written down."""
    plant = simulated_plant(load("buses", folder / "plain.toml", BusConfig))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as door, (folder / "driven").open("a", buffering=1) as told:
        door.bind(("127.0.0.1", PORT))
        was, begin_us = False, time.monotonic_ns() // 1000
        while True:
            counts, sender = door.recvfrom(16)
            now_us = time.monotonic_ns() // 1000 - begin_us
            driven = struct.unpack("<3h", counts)
            door.sendto(struct.pack("<3h", *plant.exchange(now_us, driven, sample=True)), sender)
            if any(driven) != was:
                was = any(driven)
                told.write(json.dumps({"driven": was, "t_us": begin_us + now_us}) + "\n")


@contextmanager
def canopennode(folder, words=("canopennode_amplifier", "can0", "-i", "10")):
    """The amplifier; ``seen`` waits for its combs to be driven, or not, whatever the state is called."""
    (folder / "driven").write_text('{"driven": false, "t_us": 0}\n')
    plant = multiprocessing.get_context("fork").Process(target=serve_plant, args=(folder,))
    plant.start()

    def seen(state, driven):
        end_s = time.monotonic() + 120
        while (lines := [json.loads(line) for line in (folder / "driven").read_text().splitlines()]) == [] or (
            lines[-1]["driven"] != driven
        ):
            assert time.monotonic() < end_s, lines
            time.sleep(0.05)
        return lines

    try:
        with program(folder, *words, PLANT_PORT=str(PORT)) as process:
            time.sleep(1)
            yield SimpleNamespace(process=process, seen=seen)
    finally:
        plant.kill()
        plant.join()


def test_canopennode_is_driven_by_our_eds_and_does_without_a_controller_that_is_killed(bench):
    with recorded("canopennode_amplifier.log"), canopennode(bench) as amplifier:
        words = ("--out", "drives", "--replace", "--seconds", "60", "--json")
        with driving(bench, amplifier, *words, bus="plain.toml") as (run, _, _):
            run.signal(signal.SIGKILL)
            killed_us = time.monotonic_ns() // 1000
        lines = amplifier.seen("pre-operational", False)
        print(run.err.read_text())
        assert lines[-1]["t_us"] - killed_us < 1_300_000
        time.sleep(1)
    states = [m.data[0] for m in can.LogReader(LOGS / "canopennode_amplifier.log") if m.arbitration_id == 0x70A]
    assert states[-1] == 0x7F


def test_canopennode_that_dies_is_a_fault(bench):
    with canopennode(bench) as amplifier:
        words = ("--out", "dies", "--replace", "--seconds", "60", "--json")
        with driving(bench, amplifier, *words, bus="plain.toml") as (run, _, _):
            amplifier.process.kill()
            code, out, err = run.wait()
    assert code == 1, err
    assert "HEARTBEAT_LOST" in json.loads(out)["faults"][0]


def test_what_the_check_says_of_canopennode(bench):
    with canopennode(bench), recorded("canopennode_check.log"):
        words = ("--bus", "plain.toml", "--allow-voltage", "--out", "report")
        with Command(bench, "check-amplifier", *words) as check:
            code, out, err = check.wait(600)
    (LOGS / "canopennode_check.txt").write_text(f"{code}\n{out}\n{err}")
    assert out, err


COMMANDS = """10 reset node
10 preop
10 r 0x1000 0 u32
10 r 0x1018 1 u32
10 r 0x1018 2 u32
10 r 0x1018 3 u32
10 r 0x1018 4 u32
10 r 0x1008 0 vs
10 r 0x1001 0 u8
10 w 0x1017 0 u16 100
10 r 0x1017 0 u16
10 w 0x6443 1 u8 1
10 r 0x6444 1 i32
10 r 0x5FFF 0 u8
10 r 0x1018 9 u32
10 w 0x1000 0 u32 0
10 w 0x1017 0 u32 5
10 w 0x6443 1 u8 9
10 start
10 w 0x6444 1 i32 7
10 stop
10 preop
"""


def test_canopenlinux_as_master_of_our_node(bench):
    with served(bench) as plant, recorded("canopenlinux_master.log"):
        plant.seen("pre-operational", False)
        with program(bench, "canopend", "can0", "-i", "1", "-c", f"local-{bench}/gateway"):
            time.sleep(2)
            (bench / "commands").write_text("".join(f"[{n}] {c}\n" for n, c in enumerate(COMMANDS.splitlines(), 1)))
            words = ["cocomm", "-s", f"{bench}/gateway", "-f", str(bench / "commands")]
            done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    (LOGS / "canopenlinux_master.txt").write_text(done.stdout + done.stderr)
    assert "0x06020000" in done.stdout + done.stderr


def test_lely_as_master_of_our_node(bench):
    with served(bench) as plant, recorded("lely_master.log"):
        plant.seen("pre-operational", False)
        shutil.copy(LOGS.parent / "root" / "usr" / "bin" / "coctl.dcf", bench / "coctl.dcf")
        if shutil.which("coctl") is None:
            pytest.skip("coctl is not built")
        begin = "set network 1\nset id 1\ninit 0\n"
        words = ["coctl", "--no-wait", "--monitor", "--inhibit=300", "can0", "coctl.dcf"]
        pipe = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        with subprocess.Popen(words, cwd=bench, text=True, **pipe) as master:
            master.stdin.write(begin + COMMANDS)
            master.stdin.close()
            time.sleep(20)
            master.send_signal(signal.SIGTERM)
            said = master.stdout.read() + master.stderr.read()
    (LOGS / "lely_master.txt").write_text(said)
    assert "06020000" in said.upper()


@contextmanager
def lely(bench):
    """Its control tool, as an amplifier by our EDS; NMT resets it does by itself."""
    if shutil.which("coctl") is None:
        pytest.skip("coctl is not built")
    (bench / "amplifier.dcf").write_text(EDS.read_text(encoding="utf-8") + "\n[DeviceComissioning]\nNodeID=10\n")
    words = ["coctl", "--no-wait", "can0", "amplifier.dcf"]
    with (
        (bench / "coctl.out").open("w") as out,
        subprocess.Popen(words, cwd=bench, text=True, stdin=subprocess.PIPE, stdout=out, stderr=out) as node,
    ):
        try:
            node.stdin.write("set network 1\nset id 10\ninit 0\n")
            node.stdin.flush()
            time.sleep(3)
            yield
        finally:
            node.kill()


def test_lely_with_our_eds_is_started_and_tried(bench):
    """Its sense values stay 0, so the run ends in a fault at 0 V; what counts is the start-up before it."""
    with recorded("lely_amplifier.log"), lely(bench):
        words = ("run", "slow_scan.toml", "--bus", "plain.toml", "--out", "lely", "--seconds", "3", "--json")
        with Command(bench, *words) as run:
            _, told, err = run.wait()
    (LOGS / "lely_amplifier.txt").write_text(told + err + (bench / "coctl.out").read_text())
    assert json.loads(told)["ticks"] > 0, err


def test_what_the_check_says_of_lely(bench):
    with recorded("lely_check.log"), lely(bench):
        words = ("--bus", "plain.toml", "--allow-voltage", "--out", "report_lely")
        with Command(bench, "check-amplifier", *words) as check:
            code, out, err = check.wait(600)
    (LOGS / "lely_check.txt").write_text(f"{code}\n{out}\n{err}\n{(bench / 'coctl.out').read_text()}")
    assert out, err
