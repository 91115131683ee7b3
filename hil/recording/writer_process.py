"""A process of its own that writes a recording and a frame log, whoever hands it their entries, and outlives that one.

A frame's entry: kind, length of the data, time in us, identifier, data. A row's: kind, and the bytes of the row. The
last one says how many bytes were lost; without it, whoever handed them over was killed.
"""

import os
import signal
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.bus.frame_log import FrameLog
from hil.recording.recording import RecordingError, RecordingWriter
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.loop.row import ROW

HEAD = struct.Struct("<BBqI")
FRAME, ROW_KIND, END_KIND = 0, 1, 3  # a frame's kind is a bit set of its flags, shifted past the kind
END_ENTRY = struct.Struct("<BQ")
READ_BYTES = 1 << 16
_SAFE_AFTER_S = 0.05  # rows and frames are with the operating system, whatever becomes of the writer

Watch = Callable[[NDArray[np.void]], object]
"""Is shown each row, (1,) of ``ROW``, as it is written down."""

Read = Callable[[], bytes]
"""The next bytes of the entries, of any number; waits for them; none once there will be no more."""


def end_entry(lost_bytes: int) -> bytes:
    """The last one."""
    return END_ENTRY.pack(END_KIND, lost_bytes)


class WriterProcess:
    """The writer, forked here: make it before buses are opened and priorities raised. ``begin`` runs in it first, and
    gives what it reads; ``watch`` runs there, too, where it delays no tick. ``pid``: of the writer.
    """

    def __init__(
        self, recording: Path, frames: Path, metadata: dict[str, Any], channel: str, watch: Watch,
        begin: Callable[[], Read],
    ) -> None:  # fmt: skip
        self._path = recording
        self._status: int | None = None
        self._told = False
        said, saying = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            os.close(said)
            _be_the_writer(begin(), saying, recording, frames, metadata, channel, watch)
        os.close(saying)
        self._said = said

    def gave_up(self) -> RecordingError:
        """The error that says why it takes nothing any more; waits for its end."""
        self._told = True
        return RecordingError(self._words())

    def wait(self) -> None:
        """Let it finish. Raises ``RecordingError`` if it could not write all, once."""
        words = self._words()
        if words and not self._told:
            raise RecordingError(words)

    def _words(self) -> str:
        return self._last_words() or self._ended()

    def _ended(self) -> str:
        """What became of the writer, if it came to no good end; waits for it."""
        if self._status is None:
            self._status = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
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
            while part := os.read(self._said, READ_BYTES):
                words += part
            os.close(self._said)
            self._said = -1
        return words.decode()


def _length_at(entries: bytes, at: int) -> int:
    """Of the entry that begins there; as much as is needed to know it, if it isn't all there yet."""
    if entries[at] == ROW_KIND:
        return 1 + ROW.itemsize
    if entries[at] == END_KIND:
        return END_ENTRY.size
    return HEAD.size + (entries[at + 1] if at + 1 < len(entries) else 0)


def entries_of(pending: bytes) -> Iterator[tuple[int, int]]:
    """Where each whole entry begins and ends; the first byte is its kind."""
    at = 0
    while at < len(pending) and len(pending) - at >= _length_at(pending, at):
        end = at + _length_at(pending, at)
        yield at, end
        at = end


def frame_at(pending: bytes, at: int, end: int) -> tuple[Frame, int]:
    """The frame of an entry, and its time in us."""
    kind, _, t_us, can_id = HEAD.unpack_from(pending, at)
    return Frame._make((can_id, pending[at + HEAD.size : end], kind >> 1)), t_us


def _be_the_writer(
    read: Read, saying: int, rows_to: Path, frames_to: Path, metadata: dict[str, Any], channel: str, watch: Watch
) -> None:
    """Never returns. Deaf to Ctrl-C: the end of what it reads is the end."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    status = 0
    try:
        with RecordingWriter(rows_to, metadata) as recording, FrameLog(frames_to, channel) as log:
            recording.close(whole=_write_down(read, recording, log, watch))
    except (RecordingError, OSError) as error:
        os.write(saying, str(error).encode())
        status = 1
    except BaseException as error:  # a fork must not return into its parent's code, whatever happens
        os.write(saying, f"the recording was given up: {error!r}".encode())
        status = 1
    finally:
        os._exit(status)


def _write_down(read: Read, recording: RecordingWriter, log: FrameLog, watch: Watch) -> bool:
    """Whether all came, up to the end that the loop made."""
    pending = b""
    whole = False
    flush_s = time.monotonic() + _SAFE_AFTER_S
    row = np.zeros(1, ROW)
    row_bytes = row.view(np.uint8).data
    while part := read():
        pending += part
        end = 0
        for at, end in entries_of(pending):
            if pending[at] == ROW_KIND:
                row_bytes[:] = pending[at + 1 : end]
                recording.write(row)
                watch(row)
            elif pending[at] == END_KIND:
                whole = END_ENTRY.unpack_from(pending, at)[1] == 0
            else:
                log.record(*frame_at(pending, at, end))
        pending = pending[end:]
        if (now_s := time.monotonic()) >= flush_s:
            flush_s = now_s + _SAFE_AFTER_S
            recording.flush()
            log.flush()
    return whole
