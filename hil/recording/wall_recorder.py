"""Writes recording and frame log of a loop at rate in a process of its own, so that no disk delays a tick.

The loop puts a row and its frames into a pipe, one write a tick. The other end outlives whatever ends the loop: it
closes the recording when the pipe is closed, also if that is because the loop was killed.
"""

import contextlib
import fcntl
import os
import signal
import struct
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.bus.frame_log import FrameLog
from hil.recording.recording import RecordingError, RecordingWriter
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.loop.row import ROW

_HEAD = struct.Struct("<BBqI")  # kind of entry, length of the data that follow, time in us, identifier
_FRAME, _ROW, _END = 0, 1, 3  # a frame's kind is a bit set of its flags, shifted past the kind
_ROW_HEAD = bytes((_ROW,))
_END_ENTRY = struct.Struct("<BQ")  # the last one, with how many bytes were lost: without it, the loop was killed
_PIPE_BYTES = 1 << 20  # about a second at 2 kHz
_WAITING_MAX_BYTES = 1 << 24
_READ_BYTES = 1 << 16
_HANDED_OVER_MOST = 8  # ticks in a tick
_SAFE_AFTER_S = 0.05  # rows and frames are with the operating system, whatever becomes of the writer


Watch = Callable[[NDArray[np.void]], object]
"""Is shown each row, (1,) of ``ROW``, as it is written down."""


class WallRecorder:
    """Rows and frames on their way to disk.

    ``lost_rows``, ``lost_bytes``: what the writer was too slow for, ticks whole, their frames with them.
    """

    def __init__(
        self, recording: Path, frames: Path, metadata: dict[str, Any], channel: str, watch: Watch = lambda row: None
    ) -> None:
        """Files to write. Forks: make it before buses are opened and priorities raised. ``watch`` is called in the
        writer's process, where it delays no tick.
        """
        self.lost_bytes = 0
        self._path = recording
        self._status: int | None = None
        self._told = False
        self.lost_rows = 0
        self._tick: list[bytes] = []  # what has come since the last row
        self._waiting: deque[bytes] = deque()  # a tick each
        self._waiting_bytes = 0
        reading, self._pipe = os.pipe()
        said, saying = os.pipe()
        with contextlib.suppress(OSError, AttributeError):
            fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)  # the limit of an ordinary user may be lower
        self._child = os.fork()
        if self._child == 0:
            os.close(self._pipe)
            os.close(said)
            _be_the_writer(reading, saying, recording, frames, metadata, channel, watch)
        os.close(reading)
        os.close(saying)
        self._said = said
        os.set_blocking(self._pipe, False)

    def frame(self, frame: Frame, t_us: int) -> None:
        """Note a frame that was sent or received at ``t_us``."""
        can_id, data, flags = frame
        self._tick.append(_HEAD.pack(_FRAME | flags << 1, len(data), t_us, can_id) + data)

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
            self._told = True
            raise RecordingError(self._last_words() or self._ended()) from None

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
        rest = b"".join([*self._waiting, *self._tick, _END_ENTRY.pack(_END, self.lost_bytes)])
        with contextlib.suppress(BrokenPipeError):
            while rest:
                rest = rest[os.write(self._pipe, rest) :]
        os.close(self._pipe)
        self._pipe = -1
        words = self._last_words() or self._ended()
        if words and not self._told:
            raise RecordingError(words)

    def _ended(self) -> str:
        """What became of the writer, if it came to no good end; waits for it."""
        if self._status is None:
            self._status = os.waitstatus_to_exitcode(os.waitpid(self._child, 0)[1])
        if self._status == 0:
            return ""
        how = f"was killed by signal {-self._status}" if self._status < 0 else f"ended with {self._status}"
        return (
            f"{self._path}: the process that writes it {how}; what it had written until then, all but the last "
            f"{_SAFE_AFTER_S:g} s, is kept and opens as ever"
        )

    def _last_words(self) -> str:
        words = b""
        if self._said >= 0:
            while part := os.read(self._said, _READ_BYTES):
                words += part
            os.close(self._said)
            self._said = -1
        return words.decode()


def _length_at(entries: bytes, at: int) -> int:
    """Of the entry that begins there; as much as is needed to know it, if it isn't all there yet."""
    if entries[at] == _ROW:
        return 1 + ROW.itemsize
    if entries[at] == _END:
        return _END_ENTRY.size
    return _HEAD.size + (entries[at + 1] if at + 1 < len(entries) else 0)


def _be_the_writer(
    reading: int, saying: int, rows_to: Path, frames_to: Path, metadata: dict[str, Any], channel: str, watch: Watch
) -> None:
    """Never returns. Deaf to Ctrl-C: the end of the pipe is the end."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    status = 0
    try:
        with RecordingWriter(rows_to, metadata) as recording, FrameLog(frames_to, channel) as log:
            recording.close(whole=_write_down(reading, recording, log, watch))
    except (RecordingError, OSError) as error:
        os.write(saying, str(error).encode())
        status = 1
    except BaseException as error:  # a fork must not return into its parent's code, whatever happens
        os.write(saying, f"the recording was given up: {error!r}".encode())
        status = 1
    finally:
        os._exit(status)


def _write_down(reading: int, recording: RecordingWriter, log: FrameLog, watch: Watch) -> bool:
    """Whether all came, up to the end that the loop made."""
    pending = b""
    whole = False
    flush_s = time.monotonic() + _SAFE_AFTER_S
    row = np.zeros(1, ROW)
    row_bytes = row.view(np.uint8).data
    while part := os.read(reading, _READ_BYTES):
        pending += part
        at = 0
        while at < len(pending) and len(pending) - at >= _length_at(pending, at):
            end = at + _length_at(pending, at)
            if pending[at] == _ROW:
                row_bytes[:] = pending[at + 1 : end]
                recording.write(row)
                watch(row)
            elif pending[at] == _END:
                whole = _END_ENTRY.unpack_from(pending, at)[1] == 0
            else:
                kind, _, t_us, can_id = _HEAD.unpack_from(pending, at)
                log.record(Frame._make((can_id, pending[at + _HEAD.size : end], kind >> 1)), t_us)
            at = end
        pending = pending[at:]
        if (now_s := time.monotonic()) >= flush_s:
            flush_s = now_s + _SAFE_AFTER_S
            recording.flush()
            log.flush()
    return whole
