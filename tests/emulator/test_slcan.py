"""The firmware's slcan, compiled for this machine, beside python-can's: what one writes the other reads."""

import shutil
import subprocess
from pathlib import Path

import can
import pytest

import pkxyz_ctrl.export.folder as exporting

FIRMWARE = Path(exporting.__file__).parent / "firmware"
ECHO = """
#include <stdio.h>
#include <stdlib.h>
#include "slcan.h"
void uart_put(char c) { putchar(c); }
char uart_get(void) { int c = getchar(); if (c == EOF) exit(0); return (char)c; }
int main(void) { can_frame frame; for (;;) { slcan_receive(&frame); slcan_send(&frame); } }
"""
FRAMES = [
    can.Message(arbitration_id=0x080, data=b"\x01", is_extended_id=False),
    can.Message(arbitration_id=0x7FF, data=bytes(range(8)), is_extended_id=False),
    can.Message(arbitration_id=0x000, is_extended_id=False),
    can.Message(arbitration_id=0x1FFFFFF8, data=b"\xff" * 8, is_extended_id=True),
    can.Message(arbitration_id=0x181, is_remote_frame=True, dlc=8, is_extended_id=False),
    can.Message(arbitration_id=0x305, data=b"\x80\x00\x7f\xff\x00\x01\xf0\x0f", is_fd=True, is_extended_id=False),
    can.Message(arbitration_id=0x305, data=b"\xa5" * 7, is_fd=True, bitrate_switch=True, is_extended_id=False),
    can.Message(arbitration_id=0x12345678, data=b"\x5a", is_fd=True, bitrate_switch=True, is_extended_id=True),
]


@pytest.fixture(scope="module")
def echo(tmp_path_factory):
    if shutil.which("cc") is None:
        pytest.skip("no cc on this machine")
    folder = tmp_path_factory.mktemp("slcan")
    (folder / "echo.c").write_text(ECHO)
    words = ["cc", "-std=c11", "-Wall", "-Wextra", "-Werror", f"-I{FIRMWARE}", "-o", folder / "echo", folder / "echo.c"]
    subprocess.run([*words, FIRMWARE / "slcan.c"], check=True)
    return lambda data: subprocess.run([folder / "echo"], input=data, capture_output=True, check=True).stdout


@pytest.fixture
def bus():
    with can.Bus(interface="slcan", channel="loop://", sleep_after_open=0.0, timeout=5.0) as made:
        made.serialPortOrig.reset_input_buffer()  # of its own "O"
        yield made


@pytest.mark.parametrize("frame", FRAMES, ids=str)
def test_python_can_reads_back_what_it_has_sent(echo, bus, frame):
    bus.send(frame)
    port = bus.serialPortOrig
    port.write(echo(port.read(port.in_waiting)))
    back = bus.recv(5.0)
    assert back is not None
    assert back.equals(frame, timestamp_delta=None, check_direction=False, check_channel=False)


def test_of_a_long_frame_the_head_is_kept_and_the_next_one_is_whole(echo):
    long = b"b305F" + b"0123456789ABCDEF" * 8 + b"\r"
    assert echo(long + b"t08012A\r").endswith(b"t08012A\r")


@pytest.mark.parametrize("line", [b"t08", b"t08012", b"tXYZ0", b"t0801ZZ", b"q", b"\xff\xfe", b"t" * 500])
def test_what_is_no_frame_is_refused_and_forgotten(echo, line):
    assert echo(line + b"\rt08012A\r") == b"\at08012A\r"


def test_open_close_and_bit_rate_are_granted(echo):
    assert echo(b"C\rS8\rY5\rO\r\r") == b"\r\r\r\r"
