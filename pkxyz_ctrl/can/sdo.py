"""Expedited SDO, client side: requests and replies, compiled, and their words (CiA 301, 7.2.4).

A message is its eight bytes as an integer, the first one lowest. Every object that the driver needs has at most four
bytes, so expedited transfers are enough.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from pkxyz_ctrl.compiled.kernel import kernel

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

UPLOAD: Final = 0x40
ABORT: Final = 0x80
_DOWNLOAD_REPLY: Final = 0x60
_LENGTH: Final = 8


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


class ReplyKind(IntEnum):
    """What a server's frame is. OTHER: a segmented or block transfer, which nothing of ours asks for."""

    READ = 0
    WRITTEN = 1
    ABORT = 2
    OTHER = 3


_READ, _WRITTEN, _ABORTED, _OTHER = (int(kind) for kind in ReplyKind)


@kernel
def message(command: int, index: int, subindex: int, value: int) -> int:
    """A message, a number with sign. ``value`` 0 to 0xFFFF_FFFF."""
    return command | index << 8 | subindex << 24 | ((value ^ 0x8000_0000) - 0x8000_0000) << 32


@kernel
def download(size: int) -> int:
    """The command that writes ``size`` bytes: expedited, size indicated; bits 2 and 3 tell how many are empty."""
    return 0x23 | (4 - size) << 2


@kernel
def kind_of(word: int) -> int:
    """What a server's message is, a ``ReplyKind``."""
    command = word & 0xFF
    if command == ABORT:
        return _ABORTED
    if command == _DOWNLOAD_REPLY:
        return _WRITTEN
    return _READ if command & 0xE2 == 0x42 else _OTHER  # initiate upload, expedited


@kernel
def size_of(word: int) -> int:
    """Bytes of what was read; 0: it does not say."""
    return 4 - (word >> 2 & 3) if word & 1 else 0


@kernel
def value_of(word: int) -> int:
    """What was read, or the abort code."""
    value, size = word >> 32 & 0xFFFF_FFFF, size_of(word)
    if kind_of(word) == _READ and 0 < size < 4:
        return value & ((1 << 8 * size) - 1)
    return value


def request(step: SdoStep) -> bytes:
    """The eight bytes of an expedited request."""
    if not step.write:
        return _bytes(message(UPLOAD, step.index, step.subindex, 0))
    if step.value is None:
        raise ValueError(f"{step.name}: nothing to write")
    return _bytes(message(download(step.size), step.index, step.subindex, step.value))


def _bytes(word: int) -> bytes:
    return word.to_bytes(_LENGTH, "little", signed=True)


def abort_text(code: int) -> str:
    """``0x06020000, object does not exist in the object dictionary``."""
    return f"0x{code:08X}, {ABORT_TEXT.get(code, 'a code that CiA 301 does not know')}"
