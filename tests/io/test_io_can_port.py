"""Frames through python-can and back, on its own virtual bus and between Unix sockets."""

import errno
import os
import re
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.bus.unix_bus import UnixBus
from hil.bus.unix_folder import folder_of
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.config.bus import BusConfig, CanConfig
from pkxyz_ctrl.config.files import ConfigError, load
from pkxyz_ctrl.io.can_port import CanPort, open_bus, to_frame, to_message
from pkxyz_ctrl.io.clocks import WallClock

pytestmark = pytest.mark.at_rate

FD_LENGTHS = [*range(9), 12, 16, 20, 24, 32, 48, 64]


@st.composite
def frames(draw):
    is_extended = draw(st.booleans())
    can_id = draw(st.integers(0, 0x1FFF_FFFF if is_extended else 0x7FF))
    kind = draw(st.sampled_from(["data", "fd", "remote", "error"]))
    if kind == "fd":
        length = draw(st.sampled_from(FD_LENGTHS))
        data = draw(st.binary(min_size=length, max_size=length))
        return Frame(can_id, data, True, draw(st.booleans()), is_extended=is_extended)
    if kind == "remote":
        return Frame(can_id, bytes(draw(st.integers(0, 8))), is_remote=True, is_extended=is_extended)
    return Frame(can_id, draw(st.binary(max_size=8)), is_extended=is_extended, is_error=kind == "error")


@given(frames())
def test_a_frame_survives_python_can(frame):
    assert to_frame(to_message(frame)) == frame


@settings(max_examples=150)
@given(st.lists(frames(), min_size=1, max_size=5))
def test_frames_cross_between_sockets_in_order_and_whole(tmp_path_factory, sent):
    folder = tmp_path_factory.getbasetemp() / "crossing"
    clock = WallClock()
    with UnixBus(f"{folder}") as a, UnixBus(f"{folder}") as b, UnixBus(f"{folder}") as c:
        out, into, third = CanPort(a, clock), CanPort(b, clock), CanPort(c, clock, spin_us=50)
        begin_us = clock.now_us
        assert all(out.send(frame) for frame in sent)
        for port in (into, third):
            for frame in sent:
                assert port.receive(clock.now_us + 1_000_000) == frame
                assert begin_us - 1000 <= port.last_us <= clock.now_us
            assert port.receive(0) is None
        assert out.receive(0) is None
        assert out.refused == 0
    assert list(folder.iterdir()) == []  # a folder given by its path stays


def test_waiting_ends_at_the_deadline_and_not_before(tmp_path):
    clock = WallClock()
    with UnixBus(f"{tmp_path}/bus") as bus:
        for spin_us in (0, 500, 10_000):
            port = CanPort(bus, clock, spin_us)
            deadline_us = clock.now_us + 3000
            assert port.receive(deadline_us) is None
            assert clock.now_us >= deadline_us - 5  # python-can waits in seconds as a float
        assert port.unsent() == 0


def test_when_a_frame_was_sent_is_known_though_the_time_of_day_was_set_meanwhile(tmp_path, monkeypatch):
    """A machine that asks for the time now and then sets it by some milliseconds: the node's time is that of frames."""
    clock, of_day = WallClock(), time.time
    with UnixBus(f"{tmp_path}/bus") as a, UnixBus(f"{tmp_path}/bus") as b:
        port = CanPort(b, clock)
        begin_us = clock.now_us
        for step_s in (-3.0, 0.0, -0.02, 0.2):
            a.send(can.Message(arbitration_id=1, is_extended_id=False))
            sent_us = clock.now_us
            monkeypatch.setattr(time, "time", lambda step_s=step_s: of_day() + step_s)
            assert port.receive(clock.now_us + 1_000_000) is not None
            assert begin_us - 5 <= port.last_us <= sent_us + 5
            begin_us = port.last_us


def test_a_classic_bus_refuses_fd_frames_and_does_not_see_them(tmp_path):
    clock = WallClock()
    with UnixBus(f"{tmp_path}/bus", fd=False) as classic, UnixBus(f"{tmp_path}/bus") as flexible:
        port = CanPort(classic, clock)
        assert not port.send(Frame(0x123, bytes(12), is_fd=True))
        assert port.refused == 1
        fd = CanPort(flexible, clock)
        fd.send(Frame(0x123, bytes(12), is_fd=True))
        fd.send(Frame(0x124, b"ok"))
        assert port.receive(clock.now_us + 100_000) == Frame(0x124, b"ok")


def test_a_receiver_that_stands_still_misses_nothing_for_256_frames_and_delays_nobody(tmp_path):
    """The kernel's queue holds some, the others wait with their sender, and beyond that the newest are lost."""
    queue = int(Path("/proc/sys/net/unix/max_dgram_qlen").read_text(encoding="ascii"))
    sent = queue + 256 + 50
    with UnixBus(f"{tmp_path}/bus") as sender, UnixBus(f"{tmp_path}/bus") as deaf, UnixBus(f"{tmp_path}/bus") as awake:
        for n in range(sent):
            sender.send(can.Message(arbitration_id=n & 0x7FF, is_extended_id=False))
            assert awake.recv(1.0).arbitration_id == n & 0x7FF
        kept = 0
        while (message := deaf.recv(0)) is not None:
            assert message.arbitration_id == kept
            kept += 1
            sender.recv(0)  # hands over what waits
        assert queue + 256 <= kept <= queue + 257
        assert sender.dropped == sent - kept
        sender.send(can.Message(arbitration_id=0x123, is_extended_id=False))
        assert deaf.recv(1.0).arbitration_id == 0x123


def test_what_waits_can_be_forgotten_and_goes_out_before_its_sender_leaves(tmp_path):
    """No voltage of before a fault may reach the node after it; 0 V and pre-operational, sent last, should."""
    queue = int(Path("/proc/sys/net/unix/max_dgram_qlen").read_text(encoding="ascii"))
    with UnixBus(f"{tmp_path}/bus") as deaf:
        sender = UnixBus(f"{tmp_path}/bus")
        for n in range(queue + 20):
            sender.send(can.Message(arbitration_id=n, is_extended_id=False))
        sender.flush_tx_buffer()
        sender.send(can.Message(arbitration_id=0x700, is_extended_id=False))
        leaving = threading.Thread(target=sender.shutdown)
        leaving.start()
        seen = [deaf.recv(0.05) for _ in range(queue + 2)]
        leaving.join()
        identifiers = [message.arbitration_id for message in seen if message is not None]
        assert identifiers == [*range(len(identifiers) - 1), 0x700]
        assert len(identifiers) in (queue + 1, queue + 2)


def test_what_a_killed_process_leaves_behind_is_cleared_away(tmp_path):
    channel = f"{tmp_path}/bus"
    script = "import os, sys; from hil.bus.unix_bus import UnixBus; bus = UnixBus(sys.argv[1]); os.kill(os.getpid(), 9)"
    done = subprocess.run([sys.executable, "-c", script, channel], check=False, env=os.environ)
    assert done.returncode == -9
    with UnixBus(channel) as bus, UnixBus(channel) as other:
        assert len(list((tmp_path / "bus").iterdir())) == 3
        bus.send(can.Message(arbitration_id=1))
        assert other.recv(1.0) is not None
        assert len(list((tmp_path / "bus").iterdir())) == 2
    assert list((tmp_path / "bus").iterdir()) == []


@settings(max_examples=200)
@given(st.lists(st.binary(max_size=100), max_size=5))
def test_what_is_not_a_frame_is_passed_over(tmp_path_factory, rubbish):
    folder = tmp_path_factory.getbasetemp() / "rubbish"
    with UnixBus(f"{folder}") as bus, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as stranger:
        path = next(str(p) for p in folder.iterdir())
        for datagram in rubbish:
            stranger.sendto(datagram, path)
        for _ in rubbish:
            message = bus.recv(0)
            assert message is None or len(to_frame(message).data) <= 64
        with UnixBus(f"{folder}") as friend:
            friend.send(can.Message(arbitration_id=0x77, is_extended_id=False, data=b"real"))
            seen = [bus.recv(0) for _ in range(len(rubbish) + 1)]
        assert any(m is not None and m.arbitration_id == 0x77 and bytes(m.data) == b"real" for m in seen)


def test_two_processes_meet_on_a_named_channel(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert folder_of("lab").parent.parent == tmp_path
    script = (
        "import can, sys\n"
        "with can.Bus(interface='pkxyz-unix', channel='lab', fd=True) as bus:\n"
        "    bus.send(can.Message(arbitration_id=0x10, is_extended_id=False))\n"
        "    m = bus.recv(20); m.arbitration_id += 1; bus.send(m)\n"
    )
    sent = Frame(0x20, bytes(64), True, True)
    with (
        can.Bus(interface="pkxyz-unix", channel="lab", fd=True) as bus,
        subprocess.Popen([sys.executable, "-c", script], env=os.environ) as process,
    ):
        assert bus.recv(20).arbitration_id == 0x10
        bus.send(to_message(sent))
        answer = bus.recv(20)
        assert to_frame(answer) == sent._replace(can_id=0x21)
        assert abs(answer.timestamp - time.time()) < 5
        assert process.wait(20) == 0


def config(**changes) -> CanConfig:
    can_config = load("buses", "unix_2k", BusConfig).can
    assert can_config is not None
    return can_config.model_copy(update=changes)


def test_open_bus_hands_options_on_and_names_what_is_wrong(tmp_path):
    with open_bus(config(channel=f"{tmp_path}/bus", options={"receive_own_messages": True}), "mine") as bus:
        bus.send(can.Message(arbitration_id=5, is_extended_id=False))
        assert bus.recv(0).arbitration_id == 5
    for changes, words in (
        ({"interface": "no-such"}, "no-such"),
        ({"channel": "/" + 200 * "x"}, "too long"),
        ({"interface": "socketcan", "channel": "no-can-9"}, "no-can-9"),
        ({"channel": f"{tmp_path}/bus", "options": {"speed": 3}}, "speed"),
    ):
        with pytest.raises(ConfigError, match=re.escape(words)) as caught:
            open_bus(config(**changes), "mine")
        assert "bus 'mine': can.interface" in str(caught.value)
        assert "\n" not in str(caught.value)


def test_a_port_works_on_a_bus_of_python_can_itself():
    clock = WallClock()
    with (
        open_bus(config(interface="virtual", channel="port"), "a") as a,
        open_bus(config(interface="virtual", channel="port"), "b") as b,
    ):
        CanPort(a, clock).send(Frame(0x30A, bytes(8), True, True))
        port = CanPort(b, clock)
        assert port.receive(clock.now_us + 100_000) == Frame(0x30A, bytes(8), True, True)
        b.shutdown()
        assert port.receive(clock.now_us + 1000) is None
        assert not port.send(Frame(1, b""))
        assert port.refused == 1


class Refusing(can.BusABC):
    """A bus that takes no frame, with the error that the kernel gives for it."""

    def __init__(self, error):
        super().__init__("refusing")
        self.channel_info, self._error = "refusing", error

    def send(self, msg, timeout=None):
        raise self._error


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (can.CanOperationError("Failed to transmit: Invalid argument", errno.EINVAL), "carries no FD frames"),
        (can.CanOperationError("Failed to transmit: Network is down", errno.ENETDOWN), "ip link set"),
        (OSError(errno.ENOBUFS, "No buffer space available"), "termination"),
        (ValueError("CAN FD is not for this adapter"), "CAN FD is not for this adapter"),
    ],
)
def test_a_frame_that_is_refused_is_told_with_what_to_do(error, words):
    with Refusing(error) as bus:
        port = CanPort(bus, WallClock())
        assert not port.send(Frame(0, b"\x81\x0a", True, True))
        assert (port.sent, port.refused) == (0, 1)
        assert words in port.refusal
        assert "\n" not in port.refusal


def test_what_stands_in_the_way_is_told_while_it_does():
    """An interface that is down and up again; a chip that is off the bus, as its error frames say, and restarted."""
    with can.Bus(interface="virtual", channel="way") as bus, can.Bus(interface="virtual", channel="way") as other:
        clock = WallClock()
        port = CanPort(bus, clock)
        usual = bus.send
        assert port.complaint == ""
        bus.send = Refusing(can.CanOperationError("Network is down", errno.ENETDOWN)).send
        assert not port.send(Frame(0x80, b""))
        assert port.complaint.startswith("; the interface refuses frames (Network is down")
        assert port.complaint.endswith("; it is down: ip link set ... up)")
        bus.send = usual
        assert port.send(Frame(0x80, b""))
        assert (port.complaint, port.refused) == ("", 1)
        for kind, is_off in ((0x04, False), (0x40, True), (0x100, False), (0x44, True)):
            other.send(can.Message(arbitration_id=kind, data=bytes(8), is_error_frame=True, is_extended_id=False))
            assert port.receive(clock.now_us + 100_000).is_error
            assert port.complaint.startswith("; the interface is off the bus") == is_off
            assert port.complaint == "" or is_off


def test_what_cannot_carry_fd_frames_is_refused_as_such(tmp_path):
    with pytest.raises(ConfigError, match=r"carries no FD frames.*fd = false"):
        open_bus(config(channel=f"{tmp_path}/bus", options={"fd": False}), "mine")
    assert list((tmp_path / "bus").iterdir()) == []


def test_an_adapter_without_its_driver_is_one_line(tmp_path):
    """In a process of its own: python-can looks for the libraries as it is imported, and says what it lacks."""
    script = (
        "from pkxyz_ctrl.config.bus import BusConfig\n"
        "from pkxyz_ctrl.config.files import ConfigError, load\n"
        "from pkxyz_ctrl.io.can_port import open_bus\n"
        "config = load('buses', 'unix_2k', BusConfig).can\n"
        "for interface in ('kvaser', 'pcan', 'vector', 'ixxat'):\n"
        "    try:\n"
        "        open_bus(config.model_copy(update={'interface': interface, 'channel': '0'}), 'mine')\n"
        "    except ConfigError as error:\n"
        "        print(interface, error)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.stderr == ""
    assert [line.split()[0] for line in done.stdout.splitlines()] == ["kvaser", "pcan", "vector", "ixxat"]
