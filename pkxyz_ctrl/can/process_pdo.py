"""The process PDO, compiled: counts, alive counter and CRC in a word, and out of it. The layout is told in ``codec``.

A payload is its bytes as an integer of 64 bits, the first one lowest.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel

Records = NDArray[np.void]

CRC_POLYNOMIAL = 0x2F  # AUTOSAR SWS CRC library, CRC8H2F: Hamming distance 4 up to 119 data bits
CRC_INITIAL = 0xFF
CRC_FINAL_XOR = 0xFF

PDO = np.dtype(
    [
        ("cob_id", "i4"),
        ("length", "i4"),  # 8 with alive counter and CRC, 6 without
        ("crc_start", "i4"),  # CRC of the identifier with seven bytes of 0 behind it
    ],
    align=True,
)

PROTECTED_LENGTH: Final = 8
_PLAIN_LENGTH: Final = 6


def _crc_table() -> NDArray[np.uint8]:
    table = np.zeros(256, np.uint8)
    for byte in range(256):
        register = byte
        for _ in range(8):
            register = (register << 1) ^ (CRC_POLYNOMIAL if register & 0x80 else 0)
            register &= 0xFF
        table[byte] = register
    table.setflags(write=False)
    return table


_TABLE: Final = _crc_table()


def crc8(data: bytes) -> int:
    """CRC8H2F of ``data`` (AUTOSAR; ``crc8(b"123456789") == 0xDF``)."""
    register = CRC_INITIAL
    for byte in data:
        register = int(_TABLE[register ^ byte])
    return register ^ CRC_FINAL_XOR


def pdo_record(cob_id: int, protected: bool) -> NDArray[np.void]:
    """(1,) of ``PDO``."""
    record = np.zeros(1, PDO)
    record["cob_id"] = cob_id
    record["length"] = PROTECTED_LENGTH if protected else _PLAIN_LENGTH
    record["crc_start"] = crc8(cob_id.to_bytes(2, "little") + bytes(7))
    record.setflags(write=False)
    return record


@kernel
def encode(pdo: Records, first: int, second: int, third: int, counter: int) -> int:
    """The payload, a number with sign. Counts -32768..32767, counter 0..255: of what is beyond, only low bits go."""
    word = first & 0xFFFF | (second & 0xFFFF) << 16 | (third & 0xFFFF) << 32
    if pdo[0]["length"] != PROTECTED_LENGTH:
        return word
    word |= (counter & 0xFF) << 48
    return word | _highest_byte(crc_of(pdo, word))


@kernel
def _highest_byte(value: int) -> int:
    """A byte in its place, with the sign that it gives the word."""
    return int((value ^ 0x80) - 0x80) << 56


@kernel
def crc_of(pdo: Records, word: int) -> int:
    """CRC of a payload's first seven bytes. A CRC is linear: what the identifier leaves is added at the end."""
    register = 0
    for place in range(7):
        register = _TABLE[register ^ (word >> 8 * place & 0xFF)]
    return register ^ pdo[0]["crc_start"]


@kernel
def count_of(word: int, place: int) -> int:
    """Count 0, 1 or 2 of a payload, with its sign."""
    return (word >> 16 * place & 0xFFFF ^ 0x8000) - 0x8000


@kernel
def counter_of(word: int) -> int:
    """The alive counter of a protected payload."""
    return word >> 48 & 0xFF


@kernel
def is_right(pdo: Records, word: int) -> bool:
    """Whether the CRC is right, if there has to be one."""
    return pdo[0]["length"] != PROTECTED_LENGTH or word >> 56 & 0xFF == crc_of(pdo, word)
