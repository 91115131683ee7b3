"""Process PDOs: three 16-bit counts, an alive counter and a CRC-8, as bytes.

Layout, little endian::

    byte   0 1       2 3       4 5       6              7
           counts 1  counts 2  counts 3  alive counter  CRC-8

The CRC is AUTOSAR's CRC8H2F (polynomial 0x2F, initial value and final XOR 0xFF, not reflected) over nine bytes: the
COB-ID, low byte first, as data identity, then bytes 0..6. A drive PDO that is taken for a sense PDO therefore fails.
"""

import struct
from dataclasses import dataclass
from functools import cache

Counts = tuple[int, int, int]

CRC_POLYNOMIAL = 0x2F  # AUTOSAR SWS CRC library, CRC8H2F: Hamming distance 4 up to 119 data bits
CRC_INITIAL = 0xFF
CRC_FINAL_XOR = 0xFF

COUNTS_MIN = -32768
COUNTS_MAX = 32767
DRIVE_COUNTS_MAX = 32767  # 0x6411: 0..32767 is 0..200 V, a negative count is invalid
DRIVE_VOLT_PER_COUNT = 200.0 / DRIVE_COUNTS_MAX

_PROTECTED = struct.Struct("<3hBB")
_PLAIN = struct.Struct("<3h")


class CountsOutOfRangeError(ValueError):
    """A count does not fit INTEGER16, or an alive counter does not fit UNSIGNED8."""


@cache
def _crc_table() -> bytes:
    table = bytearray(256)
    for byte in range(256):
        register = byte
        for _ in range(8):
            register = (register << 1) ^ (CRC_POLYNOMIAL if register & 0x80 else 0)
            register &= 0xFF
        table[byte] = register
    return bytes(table)


def crc8(data: bytes) -> int:
    """CRC8H2F of ``data`` (AUTOSAR; ``crc8(b"123456789") == 0xDF``)."""
    table = _crc_table()
    register = CRC_INITIAL
    for byte in data:
        register = table[register ^ byte]
    return register ^ CRC_FINAL_XOR


@cache
def _byte_contribution(bytes_after: int) -> bytes:
    """What a byte adds to the CRC when ``bytes_after`` more bytes follow it; the CRC is affine over GF(2)."""
    table = _crc_table()
    contribution = bytes(table)
    for _ in range(bytes_after):
        contribution = bytes(table[value] for value in contribution)
    return contribution


@cache
def _word_contribution(bytes_after: int) -> bytes:
    """What a 16-bit word, low byte first, adds to the CRC. Python's negative indices are the two's complement."""
    low, high = _byte_contribution(bytes_after + 1), _byte_contribution(bytes_after)
    return bytes(low[word & 0xFF] ^ high[word >> 8] for word in range(0x10000))


class ProcessCodec:
    """Encodes and decodes the process PDO with one COB-ID; drive and sense differ in nothing else.

    ``protected``: with alive counter and CRC, 8 bytes; otherwise the three counts alone, 6 bytes, as a plain CiA 401
    module has them. ``cob_id`` is the 11-bit identifier of the frame.
    """

    __slots__ = ("_counter_crc", "_word_1_crc", "_word_2_crc", "_word_3_crc", "cob_id", "length", "protected")

    def __init__(self, cob_id: int, protected: bool) -> None:
        if not 0 <= cob_id <= 0x7FF:
            raise ValueError(f"COB-ID 0x{cob_id:X} does not fit 11 bits")
        self.cob_id = cob_id
        self.protected = protected
        self.length = 8 if protected else 6
        self._word_1_crc = _word_contribution(5)
        self._word_2_crc = _word_contribution(3)
        self._word_3_crc = _word_contribution(1)
        constant = crc8(cob_id.to_bytes(2, "little") + bytes(7))
        self._counter_crc = bytes(constant ^ value for value in _byte_contribution(0))

    def encode(self, counts: Counts, counter: int) -> bytes:
        """The payload. ``counts`` -32768..32767 each, ``counter`` 0..255 (unused if not protected).

        Raises CountsOutOfRangeError; nothing is wrapped or clamped here.
        """
        first, second, third = counts
        try:
            if self.protected:
                crc = (
                    self._word_1_crc[first]
                    ^ self._word_2_crc[second]
                    ^ self._word_3_crc[third]
                    ^ self._counter_crc[counter]
                )
                return _PROTECTED.pack(first, second, third, counter, crc)
            return _PLAIN.pack(first, second, third)
        except (struct.error, IndexError):
            raise CountsOutOfRangeError(
                f"process PDO 0x{self.cob_id:03X} cannot carry counts {counts!r} with alive counter {counter!r}: "
                f"counts are {COUNTS_MIN}..{COUNTS_MAX}, the counter 0..255"
            ) from None

    def decode(self, data: bytes) -> tuple[int, int, int, int, bool]:
        """``(counts 1, counts 2, counts 3, alive counter, CRC right)``; counter 0 and True if not protected.

        ``data`` has ``length`` bytes, else struct.error: the caller has looked at the length already.
        """
        if self.protected:
            first, second, third, counter, crc = _PROTECTED.unpack(data)
            return (
                first,
                second,
                third,
                counter,
                crc
                == self._word_1_crc[first]
                ^ self._word_2_crc[second]
                ^ self._word_3_crc[third]
                ^ self._counter_crc[counter],
            )
        first, second, third = _PLAIN.unpack(data)
        return first, second, third, 0, True


@dataclass(frozen=True, slots=True)
class AnalogScale:
    """``physical = offset + scale * counts``: volts of a drive comb (0x6411), farads of a sense comb (0x6401)."""

    scale: float
    offset: float = 0.0

    def physical(self, counts: int) -> float:
        """The physical value that a count stands for."""
        return self.offset + self.scale * counts

    def counts(self, physical: float) -> int:
        """The nearest count, clamped to INTEGER16. NaN raises ValueError."""
        if physical != physical:
            raise ValueError("not a number has no count")
        return round(min(max((physical - self.offset) / self.scale, COUNTS_MIN), COUNTS_MAX))


DRIVE_SCALE = AnalogScale(DRIVE_VOLT_PER_COUNT)
