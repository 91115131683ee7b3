"""Every frame on the wire, streamed to a candump log (``candump -L``): python-can, cantools and can-utils read it."""

import re
from pathlib import Path
from types import TracebackType
from typing import Self

from hil.bus.endpoint import Endpoint
from hil.bus.fault_confinement import ERROR_BUS
from hil.bus.wire import Wire
from pkxyz_ctrl.can.frame import BIT_RATE_SWITCH, ERROR, EXTENDED, FD, REMOTE, Frame

BLOCK_FRAMES = 512  # formatted and written together: few enough to stay in the cache, 35 ms of a busy wire
ERROR_FLAG = 0x2000_0000  # CAN_ERR_FLAG of linux/can.h

_THREE_DIGITS = tuple(f"{n:03d}" for n in range(1000))
_UNSEEN = (-1, "")
_NAME_LENGTH = 15  # IFNAMSIZ of linux/if.h without its zero: canplayer takes no longer name


def interface_name(channel: str) -> str:
    """What a log calls a channel: the channel, or of a path its end, without what no interface's name may hold."""
    end = re.sub(r"[^A-Za-z0-9_.-]+", "_", channel.rstrip("/").rpartition("/")[2])
    return end[-_NAME_LENGTH:] or "can"


class FrameLog:
    """Lines of ``(seconds.microseconds) channel ID#DATA``, FD frames as ``ID##<flags>DATA`` with flags 1 = BRS.

    An existing file is overwritten. The file holds whole lines at any time, also if the program is interrupted.
    """

    def __init__(self, path: str | Path, channel: str) -> None:
        self.path = Path(path)
        self.channel = interface_name(channel)
        self.frames = 0
        self._rows: list[tuple[Frame, int]] = []
        self._middles: dict[int, tuple[int, str]] = {}  # of an identifier: flags, text before the data
        self._endpoint: Endpoint | None = None
        self._file = self.path.open("w", encoding="ascii", newline="\n")

    def attach(self, wire: Wire) -> None:
        """Listen to ``wire``, error frames included, until closed."""
        # Frames wait in the endpoint's own queue: a call for each would cost a third of what writing it does.
        self._endpoint = wire.attach(
            f"log {self.path}", queue_limit=BLOCK_FRAMES, on_full=self.flush, listen_only=True, error_frames=True
        )

    def record(self, frame: Frame, t_us: int) -> None:
        """Add one frame that ended at ``t_us``."""
        rows = self._rows
        rows.append((frame, t_us))
        if len(rows) >= BLOCK_FRAMES:
            self.flush()

    def flush(self) -> None:
        """Write what was recorded so far."""
        rows, self._rows = self._rows, []
        if self._endpoint is not None:
            rows += self._endpoint.receive_all()
        if rows:
            self.frames += len(rows)
            self._file.write("".join(self._lines(rows)))
            self._file.flush()

    def write_lines(self, lines: bytes, frames: int) -> None:
        """Lines that somebody else has formatted (``log_lines``), behind what was recorded so far."""
        self.flush()
        self.frames += frames
        self._file.write(lines.decode("ascii"))
        self._file.flush()

    def close(self) -> None:
        if not self._file.closed:
            try:
                self.flush()
            finally:
                self._file.close()
                if self._endpoint is not None:
                    self._endpoint.detach()
                    self._endpoint = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def _lines(self, rows: list[tuple[Frame, int]]) -> list[str]:
        # Formatting a number takes as long as the rest of a line: the milliseconds are kept, the rest is looked up.
        lines: list[str] = []
        write, middles = lines.append, self._middles
        begin_us, end_us, begin = 0, 0, ""
        for (can_id, data, flags), t_us in rows:
            if not begin_us <= t_us < end_us:
                t_ms = t_us // 1000
                begin_us, end_us, begin = 1000 * t_ms, 1000 * t_ms + 1000, f"({t_ms // 1000}.{t_ms % 1000:03d}"
            known_flags, middle = middles.get(can_id, _UNSEEN)
            if flags != known_flags:
                middle = f") {self.channel} {_identifier(can_id, flags)}"
                middles[can_id] = flags, middle
            payload = data.hex().upper() if not flags & REMOTE else f"{len(data)}" if data else ""
            write(f"{begin}{_THREE_DIGITS[t_us - begin_us]}{middle}{payload}\n")
        return lines


def _identifier(can_id: int, flags: int) -> str:
    """The identifier, the mark of the kind of frame and, for FD, its flags."""
    if flags & ERROR:
        can_id |= ERROR_FLAG | ERROR_BUS  # without this class python-can's reader takes it for a data frame
    identifier = f"{can_id:08X}" if flags & (EXTENDED | ERROR) else f"{can_id:03X}"
    if flags & FD:
        return f"{identifier}##{1 if flags & BIT_RATE_SWITCH else 0}"
    return f"{identifier}#R" if flags & REMOTE else f"{identifier}#"
