"""The memory in which a loop in operation and everybody else meet: rings, and words that one side counts up.

It lies in a file of the user's own, in memory where the system has such files. The loop makes it and removes it; others
map it, and nothing that they do or leave undone makes the loop wait.
"""

import contextlib
import mmap
import os
from pathlib import Path
from typing import Any, Self
from zlib import crc32

import numpy as np

from hil.operate.commands import ANSWER, COMMAND, PATH_BLOCK, TICK
from hil.operate.law_change import OFFER
from hil.operate.ring import Reader, Writer, bytes_for
from hil.operate.tick_frames import FRAMES
from pkxyz_ctrl.client import place

_HEAD = np.dtype([("kept_ticks", "<u8"), ("server", "<u8"), ("stop", "<u8")])
_HEAD_BYTES = 4096
_COMMANDS, _ANSWERS, _BLOCKS, _LAWS = 256, 1024, 128, 4
_FRAMES_SHARE = 12  # of the ticks, the frames are kept of one in so many: the last 5 s of 60
_IN_MEMORY = Path("/dev/shm")


class StageMemory:
    """``head["server"]`` is counted up by the server while it lives; ``head["stop"]`` is the number of the newest
    stop.
    """

    def __init__(self, path: Path, kept_ticks: int | None = None) -> None:
        """Map ``path``; with ``kept_ticks`` it is made anew, for so many ticks. Raises ``OSError``."""
        self.path = path
        is_new = kept_ticks is not None
        flags = os.O_RDWR | (os.O_CREAT | os.O_EXCL if is_new else 0)
        if is_new:
            path.unlink(missing_ok=True)
        descriptor = os.open(path, flags | getattr(os, "O_NOFOLLOW", 0), 0o600)
        try:
            if kept_ticks is not None:
                os.ftruncate(descriptor, _total(kept_ticks))
            self._map = mmap.mmap(descriptor, 0)
        finally:
            os.close(descriptor)
        memory = memoryview(self._map)
        self.head: Any = np.frombuffer(memory, _HEAD, 1)[0:1]
        if kept_ticks is not None:
            self.head["kept_ticks"] = kept_ticks
        self._kept_ticks = int(self.head["kept_ticks"][0])
        self._parts: dict[str, tuple[memoryview, np.dtype[Any], int]] = {}
        at = _HEAD_BYTES
        for name, record, slots in _rings(self._kept_ticks):
            size = bytes_for(record, slots)
            self._parts[name] = (memory[at : at + size], record, slots)
            at += _rounded(size)

    @classmethod
    def made(cls, name: str, kept_ticks: int) -> Self:
        """New memory for a stage of that name. Stages are alike in name where their folders differ, so those tell them
        apart; one of before, of a loop that was killed, gives way.
        """
        folder = place.folder()
        base = _IN_MEMORY if os.access(_IN_MEMORY, os.W_OK) else folder
        return cls(base / f"pkxyz-{os.getuid()}-{crc32(os.fsencode(folder)):08x}-{name}", kept_ticks)

    def writer(self, ring: str) -> Writer:
        """To write to a ring: "ticks", "frames" and "answers" are the loop's, the others the server's."""
        return Writer(*self._parts[ring])

    def reader(self, ring: str, *, from_start: bool = False) -> Reader:
        """To read from a ring."""
        return Reader(*self._parts[ring], from_start=from_start)

    def sign_of_life(self) -> None:
        """Of the server."""
        self.head["server"] += 1

    def stop(self, command_id: int) -> None:
        """Ask for a stop, which is known by that number; one that the loop has not seen yet is this one, too."""
        self.head["stop"] = command_id

    def remove(self) -> None:
        """Take the file away; whoever has mapped it keeps what is there."""
        with contextlib.suppress(FileNotFoundError):
            self.path.unlink()


def _rings(kept_ticks: int) -> list[tuple[str, np.dtype[Any], int]]:
    return [
        ("commands", COMMAND, _COMMANDS),
        ("answers", ANSWER, _ANSWERS),
        ("path", PATH_BLOCK, _BLOCKS),
        ("laws", OFFER, _LAWS),
        ("ticks", TICK, kept_ticks),
        ("frames", FRAMES, max(1, kept_ticks // _FRAMES_SHARE)),
    ]


def _rounded(size: int) -> int:
    return -(-size // mmap.PAGESIZE) * mmap.PAGESIZE


def _total(kept_ticks: int) -> int:
    return _HEAD_BYTES + sum(_rounded(bytes_for(record, slots)) for _, record, slots in _rings(kept_ticks))
