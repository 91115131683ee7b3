"""SDO server of CiA 301 (7.2.4.3): expedited and segmented transfers; block transfers are refused.

Sans-I/O: a request of 8 bytes in, a reply of 8 bytes or None out. One transfer at a time, as the default SDO channel
has one client. What may be read and written is decided by the `Objects` behind it, which raise `SdoAbortError`.
"""

import struct
from typing import Protocol

from hil.node.object_dictionary import Abort, SdoAbortError

_LONGEST_DOWNLOAD = 1024  # bytes; far above any object here, and a bound on what a hostile client can make us keep


class Objects(Protocol):
    def read(self, index: int, subindex: int) -> bytes: ...

    def check_download(self, index: int, subindex: int, length: int | None) -> None: ...

    def write(self, index: int, subindex: int, data: bytes) -> None: ...

    def unsized_length(self, index: int, subindex: int) -> int: ...


class SdoServer:
    """Answers the requests of one client."""

    def __init__(self, objects: Objects) -> None:
        self._objects = objects
        self.reset()

    def reset(self) -> None:
        """Forget the transfer under way (a communication reset, or the client's abort)."""
        self._multiplexer = b"\0\0\0"
        self._upload: bytes | None = None  # what is still to be sent
        self._download: bytearray | None = None  # what has come so far
        self._declared: int | None = None
        self._toggle = 0

    def serve(self, request: bytes) -> bytes | None:
        """The reply to ``request``. None: not an SDO (8 bytes, always), or an abort by the client."""
        if len(request) != 8:
            return None
        command = request[0]
        if command >> 5 == 4:
            self.reset()
            return None
        try:
            match command >> 5:
                case 1:
                    return self._start_download(request)
                case 0:
                    return self._download_segment(request)
                case 2:
                    return self._start_upload(request)
                case 3:
                    return self._upload_segment(command)
            self._multiplexer = request[1:4]  # 5 and 6: block upload and download; 7 does not exist
            raise SdoAbortError(Abort.COMMAND)
        except SdoAbortError as abort:
            reply = b"\x80" + self._multiplexer + struct.pack("<I", abort.code)
            self.reset()
            return reply

    def _start(self, request: bytes) -> tuple[int, int]:
        self.reset()
        self._multiplexer = request[1:4]
        index, subindex = struct.unpack_from("<HB", request, 1)
        return index, subindex

    def _start_download(self, request: bytes) -> bytes:
        index, subindex = self._start(request)
        command = request[0]
        expedited, sized = command & 2, command & 1
        if expedited:
            if sized:
                length = 4 - (command >> 2 & 3)
                self._objects.check_download(index, subindex, length)
            else:
                self._objects.check_download(index, subindex, None)
                length = min(4, self._objects.unsized_length(index, subindex))
            self._objects.write(index, subindex, request[4 : 4 + length])
        else:
            declared = struct.unpack_from("<I", request, 4)[0] if sized else None
            self._objects.check_download(index, subindex, declared)
            if declared is not None and declared > _LONGEST_DOWNLOAD:
                raise SdoAbortError(Abort.OUT_OF_MEMORY)
            self._download, self._declared = bytearray(), declared
        return b"\x60" + self._multiplexer + b"\0\0\0\0"

    def _download_segment(self, request: bytes) -> bytes:
        received = self._download
        if received is None:
            raise SdoAbortError(Abort.COMMAND)
        command = request[0]
        self._check_toggle(command)
        received += request[1 : 8 - (command >> 1 & 7)]
        if len(received) > (_LONGEST_DOWNLOAD if self._declared is None else self._declared):
            raise SdoAbortError(Abort.TOO_LONG)
        if command & 1:
            if self._declared is not None and len(received) != self._declared:
                raise SdoAbortError(Abort.LENGTH)
            index, subindex = struct.unpack("<HB", self._multiplexer)
            self._objects.write(index, subindex, bytes(received))
            self._download = None
        reply = bytes([0x20 | self._toggle << 4]) + bytes(7)
        self._toggle ^= 1
        return reply

    def _start_upload(self, request: bytes) -> bytes:
        index, subindex = self._start(request)
        data = self._objects.read(index, subindex)
        if 1 <= len(data) <= 4:
            return bytes([0x43 | (4 - len(data)) << 2]) + self._multiplexer + data.ljust(4, b"\0")
        self._upload = data
        return b"\x41" + self._multiplexer + struct.pack("<I", len(data))

    def _upload_segment(self, command: int) -> bytes:
        if self._upload is None:
            raise SdoAbortError(Abort.COMMAND)
        self._check_toggle(command)
        segment, rest = self._upload[:7], self._upload[7:]
        last = not rest
        reply = bytes([self._toggle << 4 | (7 - len(segment)) << 1 | last]) + segment.ljust(7, b"\0")
        self._upload = None if last else rest
        self._toggle ^= 1
        return reply

    def _check_toggle(self, command: int) -> None:
        if (command >> 4 & 1) != self._toggle:
            raise SdoAbortError(Abort.TOGGLE)
