"""One emulated board: the emulator's process, its line for frames and time, and the file of its notes."""

import ctypes
import os
import signal
import socket
import subprocess
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Final, NamedTuple, Self

import can
import numpy as np
from numpy.typing import NDArray

from hil.emulator.image import EMULATOR, program
from hil.emulator.told import HEAD
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.io.can_port import to_frame, to_message

WAIT_UNTIL, RECEIVE_UNTIL, SPEND, DISCARD = range(0x1FFFFFF0, 0x1FFFFFF4)
"""What the board says to whoever owns the time, by the identifier of 29 bits; see firmware/time_owner.c."""
_NOW: Final = 0x1FFFFFF8
_FOLLOWS, _CLEARING, _IS_CLEARING = 1, 2, 4
_TIME_BITS: Final = 48
_SILENT_MOST_S: Final = 60.0
_PARENT_DEATH: Final = 1  # linux/prctl.h: PR_SET_PDEATHSIG

_libc = ctypes.CDLL(None)

INSTRUCTIONS_A_COUNT = 40
"""The board's counter runs at 25 MHz, and with ``-icount shift=0`` an instruction takes a nanosecond."""


class BoardGoneError(Exception):
    """There is no board any more; the message says how its process ended."""


class Request(NamedTuple):
    """``what``: WAIT_UNTIL to DISCARD; ``us``: a time or a duration; ``notes``: how many stand in the file."""

    what: int
    us: int
    notes: int


class Board:
    """A board that runs ``image`` (``with``); ``folder``: for its notes. Its line is slcan over TCP on the loopback
    interface, which no other machine reaches.
    """

    def __init__(self, image: Path, folder: Path) -> None:
        """Raises ``ConfigError`` without an emulator, ``BoardGoneError`` where it does not start."""
        self._said = folder / "said"
        with socket.create_server(("127.0.0.1", 0)) as listener, self._said.open("wb") as said:
            port, number = listener.getsockname()[1], listener.fileno()
            self._process = subprocess.Popen(
                [
                    program(EMULATOR), "-M", "mps2-an500", "-display", "none", "-monitor", "none", "-parallel", "none",
                    "-chardev", f"socket,id=can,fd={number},server=on,wait=on,nodelay=on", "-serial", "chardev:can",
                    "-icount", "shift=0", "-semihosting-config", "enable=on,target=native", "-kernel", str(image),
                ],
                cwd=folder, pass_fds=(number,), stdin=subprocess.DEVNULL, stdout=said, stderr=said,
                start_new_session=True, preexec_fn=partial(_dies_with_its_parent, os.getpid()),
            )  # fmt: skip
        self.pid = self._process.pid
        self._notes = folder / "notes"
        try:
            self._bus: Any = can.Bus(
                interface="slcan", channel=f"socket://127.0.0.1:{port}", sleep_after_open=0.0, timeout=0.1
            )
        except can.CanError as error:
            raise self._ending() from error
        with socket.socket(fileno=os.dup(self._bus.fileno())) as line:  # or a frame behind an answer waits for 40 ms
            line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.kill()
        can.BusABC.shutdown(self._bus)  # slcan's own would write to a board that is gone
        self._bus.serialPortOrig.close()

    def kill(self) -> None:
        """As by ``kill -9``."""
        self._process.kill()
        self._process.wait()

    def said(self) -> Frame | Request:
        """The next frame for the bus, or what is asked. Raises ``BoardGoneError``."""
        try:
            message = self._bus.recv(_SILENT_MOST_S)
        except can.CanError as error:
            raise self._ending() from error
        if message is None:
            self.kill()
            raise BoardGoneError(f"said nothing for {_SILENT_MOST_S:.0f} s and was ended")
        if message.is_extended_id and WAIT_UNTIL <= message.arbitration_id <= DISCARD:
            word = int.from_bytes(message.data, "little")
            return Request(message.arbitration_id, word & (1 << _TIME_BITS) - 1, word >> _TIME_BITS)
        return to_frame(message)

    def tell(self, now_us: int, unsent: int, clearing: bool | None, frame: Frame | None) -> None:
        """Answer: the time, frames that still wait to go out, what is to be cleared, and a frame that came."""
        bits = (_FOLLOWS if frame is not None else 0) | (0 if clearing is None else _CLEARING | _IS_CLEARING * clearing)
        word = now_us | min(unsent, 255) << _TIME_BITS | bits << _TIME_BITS + 8
        try:
            self._bus.send(to_message(Frame(_NOW, word.to_bytes(8, "little"), is_extended=True)))
            if frame is not None:
                self._bus.send(to_message(frame))
        except can.CanError as error:
            raise self._ending() from error

    def notes(self, count: int, held: int) -> Iterator[tuple[np.void, NDArray[np.uint8]]]:
        """Head and memory, of ``held`` bytes, of the ``count`` calls that are noted since the last answer."""
        size = HEAD.itemsize + held
        data = np.fromfile(self._notes, np.uint8, count * size)
        for at in range(0, count * size, size):
            head = data[at : at + HEAD.itemsize].view(HEAD)[0]
            yield head, data[at + HEAD.itemsize : at + size]

    def _ending(self) -> BoardGoneError:
        code = self._process.wait(timeout=_SILENT_MOST_S)
        if code < 0:
            return BoardGoneError(f"ended by signal {-code} ({signal.Signals(-code).name})")
        said = " ".join(self._said.read_text(encoding="utf-8", errors="replace").split())
        return BoardGoneError(f"ended with code {code}: {said[-300:]}")


def _dies_with_its_parent(parent: int) -> None:
    """The board would wait for ever for a time that nobody tells it any more."""
    _libc.prctl(_PARENT_DEATH, int(signal.SIGKILL), 0, 0, 0)
    if os.getppid() != parent:
        os.kill(os.getpid(), signal.SIGKILL)
