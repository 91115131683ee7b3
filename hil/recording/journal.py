"""The journal of a recording that is being written: a line that says what it is, then rows as they lie in memory.

Whatever ends the program, each row that was handed to the operating system stays readable; a row that was cut is none.
"""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.loop.row import ROW

_HEAD_MAX_BYTES = 10_000_000


class RecordingError(RuntimeError):
    """A recording that can't be written or read. The message says which file, why, and what is left of it."""


def journal_of(path: str | Path) -> Path:
    """Where the rows of a recording are while it is being written."""
    path = Path(path)
    return path.with_name(path.name + ".journal")


class JournalWriter:
    """Appends rows. Raises ``OSError``."""

    def __init__(self, path: Path, metadata: dict[str, Any]) -> None:
        """``metadata``: plain data. Replaces an existing file."""
        self._file = path.open("wb", buffering=0)
        self._bytes = 0
        self._put(json.dumps({"pkxyz": metadata, "layout": _layout()}, allow_nan=False).encode() + b"\n")
        self._begin = self._bytes

    @property
    def ticks(self) -> int:
        """Whole rows that the operating system has."""
        return (self._bytes - self._begin) // ROW.itemsize

    def append(self, rows: NDArray[np.void]) -> None:
        """Add rows (n,) of ``ROW``, contiguous."""
        self._put(rows.view(np.uint8).data)

    def close(self) -> None:
        self._file.close()

    def _put(self, data: bytes | memoryview) -> None:
        left = memoryview(data)
        while left:
            written = self._file.write(left)
            self._bytes += written
            left = left[written:]


class JournalReader:
    """What a journal holds, read piece by piece."""

    def __init__(self, path: Path) -> None:
        """Raises ``OSError``, and ``RecordingError`` for what is no journal."""
        with path.open("rb") as file:
            head = file.readline(_HEAD_MAX_BYTES)
            size = os.fstat(file.fileno()).st_size
        try:
            described = json.loads(head if head.endswith(b"\n") else b"")
            self.metadata: dict[str, Any] = described["pkxyz"]
            layout = described["layout"]
        except (ValueError, TypeError, KeyError, RecursionError):
            raise RecordingError(f"{path}: is not a readable recording: its first line is none of a journal") from None
        if layout != _layout():
            raise RecordingError(f"{path}: is a journal of another version of this program, which can read it")
        self.ticks = (size - len(head)) // ROW.itemsize
        self._path = path
        self._begin = len(head)

    def rows(self, begin: int, end: int) -> NDArray[np.void]:
        """Rows ``begin`` to before ``end``, as far as there are so many. Raises ``OSError``."""
        count = min(end, self.ticks) - begin
        return np.fromfile(self._path, ROW, count, offset=self._begin + begin * ROW.itemsize)

    def mapped(self) -> NDArray[np.void]:
        """All rows (n,) as they lie in the file, which nobody may cut meanwhile. Raises ``OSError``."""
        if self.ticks == 0:  # nothing can't be mapped
            return np.zeros(0, ROW)
        return np.memmap(self._path, ROW, "r", self._begin, (self.ticks,))


def _layout() -> str:
    """How a row lies in memory: whoever reads a journal must mean the same."""
    return repr(ROW.descr)
