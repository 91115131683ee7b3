"""Expedited SDO, client side: requests, replies and a dialogue of steps with time-outs (CiA 301, 7.2.4).

Every object that the driver needs has at most four bytes, so expedited transfers are enough.
"""

import struct
from dataclasses import dataclass
from enum import Enum, auto
from typing import NamedTuple

TIMEOUT_ABORT = 0x05040000

ABORT_TEXT = {  # CiA 301, table "SDO abort codes"
    0x05030000: "toggle bit not alternated",
    0x05040000: "SDO protocol timed out",
    0x05040001: "client/server command specifier not valid or unknown",
    0x05040002: "invalid block size",
    0x05040003: "invalid sequence number",
    0x05040004: "CRC error",
    0x05040005: "out of memory",
    0x06010000: "unsupported access to an object",
    0x06010001: "attempt to read a write only object",
    0x06010002: "attempt to write a read only object",
    0x06020000: "object does not exist in the object dictionary",
    0x06040041: "object cannot be mapped to the PDO",
    0x06040042: "number and length of the objects to be mapped would exceed the PDO length",
    0x06040043: "general parameter incompatibility",
    0x06040047: "general internal incompatibility in the device",
    0x06060000: "access failed due to a hardware error",
    0x06070010: "data type does not match, length of service parameter does not match",
    0x06070012: "data type does not match, length of service parameter too high",
    0x06070013: "data type does not match, length of service parameter too low",
    0x06090011: "sub-index does not exist",
    0x06090030: "invalid value for parameter",
    0x06090031: "value of parameter written too high",
    0x06090032: "value of parameter written too low",
    0x06090036: "maximum value is less than minimum value",
    0x060A0023: "resource not available: SDO connection",
    0x08000000: "general error",
    0x08000020: "data cannot be transferred or stored to the application",
    0x08000021: "data cannot be transferred or stored because of local control",
    0x08000022: "data cannot be transferred or stored because of the present device state",
    0x08000023: "no object dictionary present",
    0x08000024: "no data available",
}

NO_SUCH_OBJECT = (0x06020000, 0x06090011)
"""The node has no such object, or no such part of it."""

_REQUEST = struct.Struct("<BHBI")
_UPLOAD_REQUEST = 0x40
_DOWNLOAD_REPLY = 0x60
_ABORT = 0x80


@dataclass(frozen=True, slots=True)
class SdoStep:
    """One transfer. ``write``: ``value`` is written; otherwise it is what must be read, or None for anything.

    ``size`` is 1, 2 or 4 bytes, values are unsigned. ``what`` and ``remedy`` end up in the failure text. ``optional``:
    a refusal is an answer, too. ``alike``: bits in which what is read may differ.
    """

    index: int
    subindex: int
    size: int
    value: int | None
    write: bool
    what: str
    remedy: str
    optional: bool = False
    alike: int = 0

    @property
    def name(self) -> str:
        """``0x1018:01 (vendor)``: how messages call it."""
        return f"0x{self.index:04X}:{self.subindex:02X} ({self.what})"


class ReplyKind(Enum):
    """What a server's frame is. OTHER: a segmented or block transfer, which nothing of ours asks for."""

    READ = auto()
    WRITTEN = auto()
    ABORT = auto()
    OTHER = auto()


class SdoReply(NamedTuple):
    """A server's answer. ``value`` is what was read, or the abort code; ``size`` 0 means that it was not said."""

    kind: ReplyKind
    object_index: int
    subindex: int
    value: int
    size: int


def request(step: SdoStep) -> bytes:
    """The eight bytes of an expedited request."""
    if not step.write:
        return _REQUEST.pack(_UPLOAD_REQUEST, step.index, step.subindex, 0)
    if step.value is None:
        raise ValueError(f"{step.name}: nothing to write")
    # 0x23: initiate download, expedited, size indicated; bits 2 and 3 tell how many bytes are empty
    return _REQUEST.pack(0x23 | (4 - step.size) << 2, step.index, step.subindex, step.value)


def abort(index: int, subindex: int, code: int) -> bytes:
    """The eight bytes that end a transfer."""
    return _REQUEST.pack(_ABORT, index, subindex, code)


def parse_reply(data: bytes) -> SdoReply | None:
    """A server's frame; None if it has not eight bytes."""
    if len(data) != _REQUEST.size:
        return None
    command, index, subindex, value = _REQUEST.unpack(data)
    if command == _ABORT:
        return SdoReply(ReplyKind.ABORT, index, subindex, value, 4)
    if command == _DOWNLOAD_REPLY:
        return SdoReply(ReplyKind.WRITTEN, index, subindex, 0, 0)
    if command & 0xE2 == 0x42:  # initiate upload, expedited
        size = 4 - (command >> 2 & 3) if command & 1 else 0
        return SdoReply(ReplyKind.READ, index, subindex, value & ((1 << 8 * (size or 4)) - 1), size)
    return SdoReply(ReplyKind.OTHER, index, subindex, value, 0)


def abort_text(code: int) -> str:
    """``0x06020000, object does not exist in the object dictionary``."""
    return f"0x{code:08X}, {ABORT_TEXT.get(code, 'a code that CiA 301 does not know')}"


class SdoDialogue:
    """A list of transfers, one after the other. Bytes in, bytes out; ends with ``done`` or with a ``failure``.

    An answer that does not belong to the open request (late, repeated, for another object) is ignored; a request
    without an answer is aborted and repeated, at most ``retries`` times.
    """

    def __init__(self, steps: tuple[SdoStep, ...], timeout_us: int, retries: int) -> None:
        self._steps = steps
        self._timeout_us = timeout_us
        self._retries = retries
        self._position = 0
        self._tries = 0
        self._deadline_us = 0
        self.failure = ""
        self.values: dict[tuple[int, int], int | None] = {}
        """What was read, by index and sub-index; None where there is no such object."""

    @property
    def is_begun(self) -> bool:
        """Whether anything was answered."""
        return self._position > 0

    @property
    def done(self) -> bool:
        """Whether every step has been answered as it should."""
        return self._position == len(self._steps)

    def begin(self, t_us: int) -> tuple[bytes, ...]:
        """The first request."""
        return self._ask(t_us)

    def poll(self, t_us: int) -> tuple[bytes, ...]:
        """Repeats the open request after a time-out, or gives up."""
        if self.done or self.failure or t_us < self._deadline_us:
            return ()
        step = self._steps[self._position]
        if self._tries > self._retries:
            self.failure = (
                f"no answer to {step.name} within {self._timeout_us / 1000:g} ms, asked {self._tries} times; "
                "check node id, bit rates, wiring and termination"
            )
            return (abort(step.index, step.subindex, TIMEOUT_ABORT),)
        return (abort(step.index, step.subindex, TIMEOUT_ABORT), *self._ask(t_us))

    def receive(self, data: bytes, t_us: int) -> tuple[bytes, ...]:
        """Takes the server's frame and returns the next request, if there is one."""
        reply = parse_reply(data)
        if reply is None or self.done or self.failure:
            return ()
        step = self._steps[self._position]
        if (reply.object_index, reply.subindex) != (step.index, step.subindex):
            return ()
        if reply.kind is ReplyKind.ABORT and reply.value == TIMEOUT_ABORT:
            return ()  # the server has lost a transfer, too: our own time-out repeats it
        if step.optional and (reply.kind is ReplyKind.ABORT or (reply.kind is ReplyKind.OTHER and not step.write)):
            if reply.kind is ReplyKind.ABORT and reply.value in NO_SUCH_OBJECT:
                self.values[step.index, step.subindex] = None
            return self._next(t_us)
        if reply.kind is ReplyKind.ABORT:
            verb = "writing" if step.write else "reading"
            self.failure = f"{verb} {step.name} was refused: {abort_text(reply.value)}; {step.remedy}"
            return ()
        if reply.kind is ReplyKind.OTHER and not step.write:
            self.failure = f"{step.name} is longer than four bytes or not a number; {step.remedy}"
            return ()
        if reply.kind is not (ReplyKind.WRITTEN if step.write else ReplyKind.READ):
            return ()
        if not step.write and not self._accept(step, reply):
            return ()
        return self._next(t_us)

    def _next(self, t_us: int) -> tuple[bytes, ...]:
        self._position += 1
        self._tries = 0
        return () if self.done else self._ask(t_us)

    def _accept(self, step: SdoStep, reply: SdoReply) -> bool:
        self.values[step.index, step.subindex] = reply.value
        digits = 2 * step.size
        if reply.size not in (0, step.size):
            self.failure = f"{step.name} has {reply.size} bytes instead of {step.size}; {step.remedy}"
        elif step.value is not None and (reply.value ^ step.value) & ((1 << 8 * step.size) - 1) & ~step.alike:
            self.failure = (
                f"{step.name} is 0x{reply.value:0{digits}X}, expected 0x{step.value:0{digits}X}; {step.remedy}"
            )
        return not self.failure

    def _ask(self, t_us: int) -> tuple[bytes, ...]:
        self._tries += 1
        self._deadline_us = t_us + self._timeout_us
        return (request(self._steps[self._position]),)
