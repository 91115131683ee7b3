"""CRC-8 of the process PDOs as the amplifier computes it: AUTOSAR CRC8H2F, shared with no one.

Polynomial 0x2F, initial value 0xFF, no reflection, final XOR 0xFF (AUTOSAR SWS CRC Library, "CRC8H2F", check value
0xDF), over the COB-ID as two bytes, low byte first, and then the payload up to the CRC byte.
"""

from functools import cache

import numpy as np

_POLYNOMIAL = 0x2F


def _shift_byte(register: int) -> int:
    for _ in range(8):
        register = (register << 1 ^ _POLYNOMIAL if register & 0x80 else register << 1) & 0xFF
    return register


STEP = bytes(_shift_byte(register) for register in range(256))  # one byte of input: register -> STEP[register ^ byte]


def crc8h2f(data: bytes) -> int:
    """CRC8H2F of ``data``, byte by byte."""
    register = 0xFF
    for byte in data:
        register = STEP[register ^ byte]
    return register ^ 0xFF


def _word_tables() -> tuple[bytes, bytes, bytes]:
    step = np.frombuffer(STEP, np.uint8)
    after = [step]  # after[k][byte]: what is left of a byte, k bytes further on
    for _ in range(6):
        after.append(step[after[-1]])
    word = np.arange(65536)
    w0, w1, w2 = (after[6 - 2 * i][word & 0xFF] ^ after[5 - 2 * i][word >> 8] for i in range(3))
    return w0.tobytes(), w1.tobytes(), w2.tobytes()


WORDS = _word_tables()


@cache
def last_byte_table(cob_id: int) -> bytes:
    """Table w3 such that ``w0[a] ^ w1[b] ^ w2[c] ^ w3[n]`` with w0, w1, w2 = `WORDS` is the CRC of (a, b, c, n).

    The payload is three 16-bit words and one byte, sent under ``cob_id``. The CRC is affine over GF(2), so each word
    contributes by itself; w3 also holds the constant part: initial value, COB-ID, final XOR. The tables of `WORDS` have
    65536 entries, so a negative count, used as a Python index from the end, finds its two's complement.
    """
    constant = crc8h2f(cob_id.to_bytes(2, "little") + bytes(7))
    return bytes(step ^ constant for step in STEP)
