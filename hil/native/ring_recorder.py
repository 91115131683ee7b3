"""Writes recording and frame log of a native loop: the writer reads the ring, which the loop never waits for.

A pipe that only the loop holds open tells the writer when it is gone, however it ended, and the loop when the writer
is.
"""

import os
import select
from pathlib import Path
from typing import Any

from hil.native.held_pipe import HeldPipe
from hil.native.mapped import Mapped
from hil.recording.writer_process import Read, Watch, WriterProcess

_LOOK_S = 0.005
_READ_MOST_BYTES = 1 << 20


class RingRecorder:
    """Rows and frames on their way from the ring to disk. ``held``: the pipe between the loop and the writer."""

    def __init__(
        self, mapped: Mapped, recording: Path, frames: Path, metadata: dict[str, Any], channel: str,
        watch: Watch = lambda row: None,
    ) -> None:  # fmt: skip
        """Files to write. Forks: make it before the loop is begun. ``watch`` is called in the writer's process."""
        self._mapped = mapped
        self.held = held = HeldPipe()

        def begin() -> Read:
            held.handed_over()  # the writer has the other end
            return _reader(RingBytes(mapped), held.alive)

        self._writer = WriterProcess(recording, frames, metadata, channel, watch, begin)
        self.writer_pid = self._writer.pid
        os.close(held.alive)

    @property
    def lost_rows(self) -> int:
        """Rows for which the writer was too slow, ticks whole."""
        return int(self._mapped.shared["ring"]["lost_rows"][0, 0])

    def close(self) -> None:
        """Let the writer finish. Raises ``RecordingError`` if it could not write all."""
        self.held.handed_over()
        self._writer.wait()


class RingBytes:
    """What the loop has put into the ring; one alone may take it."""

    def __init__(self, mapped: Mapped) -> None:
        self._ring, self._bytes = mapped.shared["ring"][0, 0], mapped.ring

    def take(self) -> bytes:
        """What there is, as whole ticks unless it is very much; nothing if there is nothing."""
        tail = int(self._ring["tail"])
        count = min(int(self._ring["head"]) - tail, _READ_MOST_BYTES)
        part = self._at(tail % len(self._bytes), count)
        self._ring["tail"] = tail + count
        return part

    def _at(self, begin: int, count: int) -> bytes:
        first = bytes(self._bytes[begin : begin + count])
        return first + bytes(self._bytes[: count - len(first)])


def _reader(ring: RingBytes, alive: int) -> Read:
    def read() -> bytes:
        is_alive = True
        while True:
            part = ring.take()
            if part or not is_alive:
                return part
            is_alive = not select.select((alive,), (), (), _LOOK_S)[0]

    return read
