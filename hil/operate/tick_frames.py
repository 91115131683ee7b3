"""The frames of each tick, as they cross to whoever keeps them: packed where they come, copied once a tick."""

import struct
from collections.abc import Iterator
from typing import Final

import numpy as np

from pkxyz_ctrl.can.frame import Frame

FRAMES_MOST: Final = 16
"""Of a tick that are kept; what is more is counted."""
_PACKED = struct.Struct("<qIBBxx64s")  # time in us, identifier, flags, length, data

FRAMES: Final = np.dtype(
    [
        ("tick", "<i8"),
        ("count", "<u4"),
        ("left_out", "<u4"),
        ("frames", f"V{_PACKED.size}", (FRAMES_MOST,)),
    ]
)
"""A tick's frames."""


class TickFrames:
    """Of the tick that is under way."""

    def __init__(self) -> None:
        self._record = np.zeros(1, FRAMES)
        self._bytes = self._record.view(np.uint8).data
        self._at = FRAMES.fields["frames"][1] if FRAMES.fields is not None else 0
        self._count = self._left_out = 0

    def note(self, frame: Frame, t_us: int) -> None:
        """One that was sent, or has come."""
        if self._count >= FRAMES_MOST:
            self._left_out += 1
            return
        at = self._at + self._count * _PACKED.size
        _PACKED.pack_into(self._bytes, at, t_us, frame.can_id, frame.flags, len(frame.data), frame.data)
        self._count += 1

    def taken(self, tick: int) -> memoryview:
        """What there is, as bytes of ``FRAMES``, valid until the next is noted; the next tick begins."""
        record = self._record[0]
        record["tick"], record["count"], record["left_out"] = tick, self._count, self._left_out
        self._count = self._left_out = 0
        return self._bytes


def frames_of(record: np.void) -> Iterator[tuple[Frame, int]]:
    """Frames of a record of ``FRAMES`` and their times in us."""
    packed = record["frames"].tobytes()
    for n in range(min(int(record["count"]), FRAMES_MOST)):
        t_us, can_id, flags, length, data = _PACKED.unpack_from(packed, n * _PACKED.size)
        yield Frame._make((can_id, data[:length], flags)), t_us
