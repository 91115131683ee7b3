"""Lines of a frame log written by compiled code; ``frame_log`` says how they look, and a test that both agree."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.can.frame import BIT_RATE_SWITCH, FD
from pkxyz_ctrl.compiled.kernel import kernel

Bytes = NDArray[np.uint8]

LINE_MOST: Final = 80  # bytes, with a channel's name of 15
_DIGITS: Final = np.frombuffer(b"0123456789ABCDEF", np.uint8)
_BEGIN, _DOT, _CLOSE, _SPACE, _MARK, _END = b"(.) #\n"
_US_DIGITS: Final = 6


@kernel
def _decimal(text: Bytes, at: int, value: int, digits: int) -> int:
    """``value`` with at least so many digits; returns where it ends."""
    size, rest = digits, value // 10**digits
    while rest > 0:
        size, rest = size + 1, rest // 10
    for place in range(at + size - 1, at - 1, -1):
        text[place] = _DIGITS[value % 10]
        value //= 10
    return at + size


@kernel
def write_line(text: Bytes, at: int, channel: Bytes, t_us: int, can_id: int, flags: int, length: int, word: int) -> int:
    """A data frame with an 11-bit identifier and at most eight bytes, those of ``word``, the first one lowest. It ended
    at ``t_us``. Returns where the line ends in ``text``, at most ``LINE_MOST`` behind ``at``.
    """
    text[at] = _BEGIN
    at = _decimal(text, at + 1, t_us // 10**_US_DIGITS, 1)
    text[at] = _DOT
    at = _decimal(text, at + 1, t_us % 10**_US_DIGITS, _US_DIGITS)
    text[at], text[at + 1] = _CLOSE, _SPACE
    at += 2
    for byte in channel:
        text[at] = byte
        at += 1
    text[at] = _SPACE
    for place in range(3):
        text[at + 1 + place] = _DIGITS[can_id >> 8 - 4 * place & 0xF]
    text[at + 4] = _MARK
    at += 5
    if flags & FD:
        text[at], text[at + 1] = _MARK, _DIGITS[1 if flags & BIT_RATE_SWITCH else 0]
        at += 2
    for place in range(length):
        text[at] = _DIGITS[word >> 8 * place + 4 & 0xF]
        text[at + 1] = _DIGITS[word >> 8 * place & 0xF]
        at += 2
    text[at] = _END
    return at + 1
