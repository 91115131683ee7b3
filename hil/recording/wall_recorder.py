"""Writes recording and frame log of a loop at rate in a process of its own, so that no disk delays a tick.

The loop puts a row and its frames into a pipe, one write a tick. The other end outlives whatever ends the loop: it
closes the recording when the pipe is closed, also if that is because the loop was killed.
"""

import contextlib
import fcntl
import os
from collections import deque
from pathlib import Path
from typing import Any

from hil.recording.writer_process import FRAME, HEAD, READ_BYTES, ROW_KIND, Read, Watch, WriterProcess, end_entry
from pkxyz_ctrl.can.frame import Frame

_ROW_HEAD = bytes((ROW_KIND,))
_PIPE_BYTES = 1 << 20  # about a second at 2 kHz
_WAITING_MAX_BYTES = 1 << 24
_HANDED_OVER_MOST = 8  # ticks in a tick


class WallRecorder:
    """Rows and frames on their way to disk.

    ``lost_rows``, ``lost_bytes``: what the writer was too slow for, ticks whole, their frames with them.
    ``writer_pid``: the process that writes.
    """

    def __init__(
        self, recording: Path, frames: Path, metadata: dict[str, Any], channel: str, watch: Watch = lambda row: None
    ) -> None:
        """Files to write. Forks: make it before buses are opened and priorities raised. ``watch`` is called in the
        writer's process, where it delays no tick.
        """
        self.lost_bytes = 0
        self.lost_rows = 0
        self._tick: list[bytes] = []  # what has come since the last row
        self._waiting: deque[bytes] = deque()  # a tick each
        self._waiting_bytes = 0
        reading, self._pipe = os.pipe()
        with contextlib.suppress(OSError, AttributeError):
            fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)  # the limit of an ordinary user may be lower

        def begin() -> Read:
            os.close(self._pipe)
            return lambda: os.read(reading, READ_BYTES)

        self._writer = WriterProcess(recording, frames, metadata, channel, watch, begin)
        self.writer_pid = self._writer.pid
        os.close(reading)
        os.set_blocking(self._pipe, False)

    def frame(self, frame: Frame, t_us: int) -> None:
        """Note a frame that was sent or received at ``t_us``."""
        can_id, data, flags = frame
        self._tick.append(HEAD.pack(FRAME | flags << 1, len(data), t_us, can_id) + data)

    def row(self, row: memoryview) -> None:
        """Note the row of a tick and send all that waits. Raises ``RecordingError`` if the writer has given up."""
        self._tick.append(_ROW_HEAD)
        self._tick.append(bytes(row))
        entry = b"".join(self._tick)
        self._tick.clear()
        if self._waiting_bytes + len(entry) > _WAITING_MAX_BYTES:
            self.lost_rows += 1
            self.lost_bytes += len(entry)
        else:
            self._waiting.append(entry)
            self._waiting_bytes += len(entry)
        try:
            self._hand_over()
        except BlockingIOError:
            pass
        except BrokenPipeError:
            raise self._writer.gave_up() from None

    def _hand_over(self) -> None:
        """What waits, a few ticks' worth at most: a writer that stood still must not cost a tick its time."""
        waiting = self._waiting
        for _ in range(min(len(waiting), _HANDED_OVER_MOST)):
            written = os.write(self._pipe, waiting[0])
            self._waiting_bytes -= written
            if written < len(waiting[0]):
                waiting[0] = waiting[0][written:]
                return
            waiting.popleft()

    def close(self) -> None:
        """Send the rest, let the writer finish. Raises ``RecordingError`` if it could not write all."""
        if self._pipe < 0:
            return
        os.set_blocking(self._pipe, True)
        rest = b"".join([*self._waiting, *self._tick, end_entry(self.lost_bytes)])
        with contextlib.suppress(BrokenPipeError):
            while rest:
                rest = rest[os.write(self._pipe, rest) :]
        os.close(self._pipe)
        self._pipe = -1
        self._writer.wait()
