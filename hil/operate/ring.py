"""A ring of records in memory that processes share: one writes, any number read, nobody waits.

Each slot carries the number of its record and a CRC over both, so whoever reads knows by itself whether a record is
the one that was meant, whole, and not being overwritten: no lock, and no reliance on the order in which stores become
visible. A reader that falls behind loses records and is told how many; the writer never knows that readers exist.
"""

import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

_HEAD_BYTES = 64
_NUMBER = np.dtype("<u8")


def slot_of(record: np.dtype[Any]) -> np.dtype[Any]:
    """How a record lies in its slot: its number, from 1 on, the record, and the CRC of both."""
    return np.dtype([("number", _NUMBER), ("record", record), ("crc", "<u4")], align=True)


def bytes_for(record: np.dtype[Any], slots: int) -> int:
    """Bytes of memory for a ring of so many slots."""
    return _HEAD_BYTES + slots * slot_of(record).itemsize


class _Ring:
    def __init__(self, memory: memoryview, record: np.dtype[Any], slots: int) -> None:
        """``memory``: ``bytes_for`` these; zeroed where nobody has written yet."""
        layout = slot_of(record)
        fields = dict(layout.fields or {})
        self.slots = slots
        self._layout = layout
        self._size = layout.itemsize
        self._crc_at = fields["crc"][1]
        self._record_at = fields["record"][1]
        self._record_bytes = record.itemsize
        self._newest = np.frombuffer(memory, _NUMBER, 1)
        self._numbers = np.ndarray((slots,), _NUMBER, memory, _HEAD_BYTES, (self._size,))
        self._bytes = memory[_HEAD_BYTES:]

    def _slot(self, number: int) -> memoryview:
        at = (number - 1) % self.slots * self._size
        return self._bytes[at : at + self._size]


class Writer(_Ring):
    """The one that writes. It goes on where an earlier writer of the same memory ended."""

    def __init__(self, memory: memoryview, record: np.dtype[Any], slots: int) -> None:
        super().__init__(memory, record, slots)
        self.written = int(self._newest[0])
        """records so far"""

    def write(self, record: bytes | memoryview) -> int:
        """Write a record as bytes; returns its number."""
        number = self.written + 1
        slot = self._slot(number)
        slot[0:8] = number.to_bytes(8, "little")
        slot[self._record_at : self._record_at + self._record_bytes] = record
        crc_at = self._crc_at
        slot[crc_at : crc_at + 4] = zlib.crc32(slot[:crc_at]).to_bytes(4, "little")
        self._newest[0] = self.written = number
        return number


class Reader(_Ring):
    """One that reads. ``lost``: records that were overwritten before it came to them."""

    def __init__(self, memory: memoryview, record: np.dtype[Any], slots: int, *, from_start: bool = False) -> None:
        """From the next record on, or with ``from_start`` from the oldest that there is."""
        super().__init__(memory, record, slots)
        newest = self.newest
        self.next = max(1, newest - slots + 1) if from_start else newest + 1
        self.lost = 0

    @property
    def newest(self) -> int:
        """Number of the newest record as the writer says, 0 if there is none: a hint, not a promise."""
        return int(self._newest[0])

    def read(self) -> bytes | None:
        """The next record, or None if it isn't there yet, or not whole."""
        number = self.next
        seen = int(self._numbers[(number - 1) % self.slots])
        if seen < number:
            return None
        if seen > number:  # overwritten: go on with the older half of what there is
            self.lost += self._skip_to(seen - self.slots // 2)
            return None
        slot = bytes(self._slot(number))
        crc_at = self._crc_at
        crc = int.from_bytes(slot[crc_at : crc_at + 4], "little")
        if int.from_bytes(slot[0:8], "little") != number or zlib.crc32(slot[:crc_at]) != crc:
            return None
        self.next = number + 1
        return slot[self._record_at : self._record_at + self._record_bytes]

    def read_block(self, most: int) -> NDArray[np.void]:
        """Up to ``most`` next records (n,), copies; none where there is none, or it is not whole."""
        block = self._straight(most)
        is_at_front = (self.next - 1) % self.slots == 0
        if not 0 < len(block) < most or not is_at_front or not len(rest := self._straight(most - len(block))):
            return block
        both = np.empty(len(block) + len(rest), block.dtype)  # np.concatenate looks at each field of a record anew
        both[: len(block)], both[len(block) :] = block, rest
        return both

    def skip(self) -> None:
        """Leave out what there is, as nobody wants it."""
        self.next = max(self.next, self.newest + 1)

    def latest(self) -> NDArray[np.void] | None:
        """The newest whole record, (1,), whatever was read before; None if there is none."""
        number = self.newest
        for back in range(3):
            if number - back < 1:
                return None
            found = self._checked(number - back, 1)
            if len(found):
                return found
        return None

    def before(self, number: int, count: int) -> NDArray[np.void]:
        """Records (n,) of ``count`` up to and with ``number``, as far as they are still there, oldest first."""
        first = max(1, number - count + 1, self.newest - self.slots + 2)
        kept, self.next = self.next, first
        lost = self.lost
        blocks = self.read_block(max(0, number - first + 1))
        self.next, self.lost = kept, lost
        return blocks

    def _straight(self, most: int) -> NDArray[np.void]:
        """Up to the end of the memory."""
        at = (self.next - 1) % self.slots
        seen = int(self._numbers[at])
        if seen > self.next:
            self.lost += self._skip_to(seen - self.slots // 2)
            at = (self.next - 1) % self.slots
        count = min(most, self.slots - at, max(0, self.newest - self.next + 1))
        found = self._checked(self.next, count)
        self.next += len(found)
        return found

    def _checked(self, first: int, count: int) -> NDArray[np.void]:
        """Records from ``first`` on as long as they are whole; ``count`` must not reach past the end of the memory."""
        at = (first - 1) % self.slots
        size, crc_at = self._size, self._crc_at
        data = bytearray(self._bytes[at * size : (at + count) * size])  # padding, too, which an array's copy leaves out
        copy = np.frombuffer(data, self._layout, count)
        whole, view = 0, memoryview(data)
        for number, (seen, crc) in enumerate(zip(copy["number"].tolist(), copy["crc"].tolist(), strict=True), first):
            begin = whole * size
            if seen != number or zlib.crc32(view[begin : begin + crc_at]) != crc:
                break
            whole += 1
        return copy["record"][:whole]

    def _skip_to(self, number: int) -> int:
        """Go on at a record; returns how many are left out."""
        left_out = max(0, number - self.next)
        self.next = max(self.next, number)
        return left_out
