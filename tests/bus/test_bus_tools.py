"""python-can's and cantools' command lines on our interfaces, each in its own process, as an engineer calls them."""

import contextlib
import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from functools import partial

import can
import pytest

from hil.bus.frame_log import FrameLog
from hil.bus.unix_bus import UnixBus
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.config.files import CONFIG_DIR

pytestmark = pytest.mark.at_rate


@contextlib.contextmanager
def tool(*words):
    """A module's command line in a process; ended by Ctrl-C, as they are."""
    process = subprocess.Popen(
        [sys.executable, "-m", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # a shell's background jobs ignore it
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            process.communicate(timeout=20)
        finally:
            process.kill()


def until(condition, process):
    end_s = time.monotonic() + 60
    while not condition():
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < end_s
        time.sleep(0.02)


@pytest.mark.slow
def test_player_and_bridge_carry_a_log_from_one_channel_to_another_and_the_logger_writes_it(tmp_path):
    here, there, log, copy = (str(tmp_path / name) for name in ("a", "b", "frames.log", "copy.log"))
    for channel in (here, there):
        os.mkdir(channel, 0o700)
    sent = [Frame(0x30A, bytes((n, 2, 3, 4, 5, 6, 7, 8)), True, True) for n in range(20)]
    with FrameLog(log, here) as frames:
        for n, frame in enumerate(sent):
            frames.record(frame, 1000 * n)
    options = ("-i", "pkxyz-unix", "--fd")
    bridge_words = [f"--bus{n}-{word}" for n, channel in ((1, here), (2, there)) for word in (
        "interface=pkxyz-unix", f"channel={channel}", "fd")]  # fmt: skip
    with (
        tool("can.bridge", *bridge_words) as bridge,
        tool("can.logger", *options, "-c", there, "-f", copy) as logger,
        UnixBus(there) as seen,
    ):
        until(lambda: len(os.listdir(here)) >= 1 and len(os.listdir(there)) >= 3, bridge)
        with tool("can.player", *options, "-c", here, log) as player:
            said, _ = player.communicate(timeout=60)
            assert player.returncode == 0, said
        assert [bytes(seen.recv(5.0).data) for _ in sent] == [frame.data for frame in sent]
        time.sleep(0.5)
        assert logger.poll() is None
    logged = [(m.arbitration_id, bytes(m.data), m.is_fd) for m in can.LogReader(copy)]
    assert logged == [(frame.can_id, frame.data, True) for frame in sent]


@pytest.mark.parametrize("name", ["viewer", "monitor"])
def test_viewer_and_monitor_show_what_comes(tmp_path, name):
    """They want a terminal: they get one of eighty columns."""
    words = {
        "viewer": ("can.viewer", "-i", "pkxyz-unix", "-c", str(tmp_path / "bus"), "--fd"),
        "monitor": ("cantools", "monitor", "-i", "pkxyz-unix", "-c", str(tmp_path / "bus"), "--fd",
                    str(CONFIG_DIR / "comb_amplifier.dbc")),
    }[name]  # fmt: skip
    child, screen = pty.fork()
    if child == 0:
        os.environ |= {"TERM": "xterm", "COLUMNS": "80", "LINES": "25"}
        os.execv(sys.executable, [sys.executable, "-m", *words])
    shown, end_s = b"", time.monotonic() + 60
    try:
        with UnixBus(str(tmp_path / "bus")) as bus:
            while not re.search({"viewer": rb"0x?30A", "monitor": rb"[Dd]rive"}[name], shown):
                bus.send(can.Message(arbitration_id=0x30A, is_extended_id=False, data=bytes(8), is_fd=True))
                if select.select([screen], [], [], 0.1)[0]:
                    shown += os.read(screen, 4096)
                assert time.monotonic() < end_s, shown[-2000:]
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        os.close(screen)


@pytest.mark.parametrize("words", [("can.logger",), ("can.player", "LOG"), ("can.bridge",)])
def test_they_open_a_simulated_wire(tmp_path, words):
    """It ends with its process, so there is nobody to talk to: to be tried, and for scripts that publish one."""
    log = tmp_path / "frames.log"
    with FrameLog(log, "pkxyz") as frames:
        frames.record(Frame(0x123, b"12"), 0)
    options = ("-i", "pkxyz-sim", "-c", "pkxyz") if words != ("can.bridge",) else tuple(
        f"--bus{n}-{word}" for n in (1, 2) for word in ("interface=pkxyz-sim", f"channel={n}"))  # fmt: skip
    with tool(words[0], *options, *(str(log) for word in words if word == "LOG")) as process:
        if words[0] == "can.player":
            said, _ = process.communicate(timeout=60)
            assert process.returncode == 0, said
        else:
            line = process.stdout.readline()
            while "Started" not in line and "Connected" not in line:
                assert line, process.communicate()
                assert "Traceback" not in line
                line = process.stdout.readline()


@pytest.mark.parametrize(
    "channel", ["pkxyz", "/tmp/some/where/my bus", "/", "sim 0", "a" * 40, "\N{GREEK SMALL LETTER MU}"]
)
def test_a_log_names_an_interface_as_the_kernel_would(tmp_path, channel):
    """can-utils' canplayer takes no name of 16 characters or more (IFNAMSIZ, linux/if.h)."""
    path = tmp_path / "frames.log"
    with FrameLog(path, channel) as log:
        log.record(Frame(0x123, b"12"), 5)
    name = path.read_text(encoding="ascii").split()[1]
    assert re.fullmatch(r"[A-Za-z0-9_.-]{1,15}", name)
    assert name == channel or channel != "pkxyz"
    assert [m.arbitration_id for m in can.LogReader(path)] == [0x123]
