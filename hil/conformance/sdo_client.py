"""SDO client of the conformance run: expedited and segmented transfers, each reply kept as it came."""

import struct
from collections.abc import Callable
from dataclasses import dataclass

from pkxyz_ctrl.can.sdo import abort_text

Exchange = Callable[[bytes], bytes | None]
"""Sends one request of eight bytes; the reply of eight bytes, None if none came in time."""

_SEGMENTS_MAX = 40  # 280 bytes: no object of this profile is longer, but an EDS in one is; such a one is cut off


@dataclass(frozen=True)
class SdoResult:
    """Of one transfer. ``data``: what was read (empty after a write); ``abort``: the server's code, else 0."""

    data: bytes | None
    abort: int = 0
    trouble: str = ""
    is_cut: bool = False
    """It was longer than anybody wants to know."""

    @property
    def ok(self) -> bool:
        return self.data is not None

    @property
    def text(self) -> str:
        """What came, for a person."""
        if self.data is not None:
            return self.data.hex(" ") if self.data else "accepted"
        return f"abort {abort_text(self.abort)}" if self.abort else self.trouble

    @property
    def unsigned(self) -> int:
        """The little-endian value that was read; -1 if none was."""
        return -1 if self.data is None else int.from_bytes(self.data, "little")


def upload_request(index: int, subindex: int) -> bytes:
    """Initiate upload."""
    return struct.pack("<BHB4x", 0x40, index, subindex)


def download_request(index: int, subindex: int, data: bytes) -> bytes:
    """Initiate an expedited download of 1 to 4 bytes."""
    return struct.pack("<BHB", 0x23 | (4 - len(data)) << 2, index, subindex) + data.ljust(4, b"\0")


def is_answer(request: bytes, reply: bytes) -> bool:
    """Whether ``reply`` can be the one to ``request``: initiated transfers and their aborts name the object."""
    command, is_abort = request[0] >> 5, reply[0] == 0x80
    if command in (1, 2):
        expected = 3 if command == 1 else 2
        return request[1:4] == reply[1:4] and (is_abort or reply[0] >> 5 == expected)
    return is_abort or reply[0] >> 5 == 0 if command == 3 else True


def read(exchange: Exchange, index: int, subindex: int) -> SdoResult:
    """Upload of an object of any length."""
    head = struct.pack("<HB", index, subindex)
    reply = exchange(upload_request(index, subindex))
    failed = _failure(reply, head)
    if failed is not None or reply is None:
        return failed or _SILENT
    if reply[0] & 0xE2 == 0x42:
        return SdoResult(reply[4 : 8 - (reply[0] >> 2 & 3)] if reply[0] & 1 else reply[4:8])
    if reply[0] & 0xE2 != 0x40:
        return SdoResult(None, trouble=f"a reply that is no upload: {reply.hex(' ')}")
    data, toggle = b"", 0
    for _ in range(_SEGMENTS_MAX):
        segment = exchange(bytes((0x60 | toggle << 4,)) + bytes(7))
        if segment is None:
            return _SILENT
        if segment[0] == 0x80:
            return SdoResult(None, int.from_bytes(segment[4:], "little"))
        if segment[0] >> 5 or segment[0] >> 4 & 1 != toggle:
            return SdoResult(None, trouble=f"a segment that does not fit: {segment.hex(' ')}")
        data += segment[1 : 8 - (segment[0] >> 1 & 7)]
        if segment[0] & 1:
            return SdoResult(data)
        toggle ^= 1
    return SdoResult(None, trouble=f"more than {7 * _SEGMENTS_MAX} bytes", is_cut=True)


def write(exchange: Exchange, index: int, subindex: int, data: bytes) -> SdoResult:
    """Expedited download of 1 to 4 bytes; of a longer object only the request with its length is made."""
    head = struct.pack("<HB", index, subindex)
    request = (
        download_request(index, subindex, data)
        if 1 <= len(data) <= 4
        else struct.pack("<BHBI", 0x21, index, subindex, len(data))
    )
    reply = exchange(request)
    failed = _failure(reply, head)
    if failed is not None or reply is None:
        return failed or _SILENT
    if reply[0] != 0x60:
        return SdoResult(None, trouble=f"a reply that is no download: {reply.hex(' ')}")
    return SdoResult(b"")


def _failure(reply: bytes | None, head: bytes) -> SdoResult | None:
    if reply is None:
        return _SILENT
    if reply[1:4] != head:
        return SdoResult(None, trouble=f"a reply about another object: {reply.hex(' ')}")
    if reply[0] == 0x80:
        return SdoResult(None, int.from_bytes(reply[4:], "little"))
    return None


_SILENT = SdoResult(None, trouble="no answer")
