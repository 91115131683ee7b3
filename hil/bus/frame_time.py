"""How long a CAN frame is on the wire, exactly, stuff bits included (ISO 11898-1:2015, section 10.4).

A duration runs from the start of frame to the end of the interframe space: everything that keeps another frame off
the wire. In FD frames with bit-rate switch the rate changes at the sample points of the BRS bit and of the CRC
delimiter; together these two bits last one nominal and one data bit wherever the sample point lies, as long as all
nodes share it. So BRS is counted as nominal here and the CRC delimiter as a data bit.

Dynamic stuff bits: after five equal bits one of the other value, which counts for the next run. Classic frames are
stuffed to the end of their CRC, so the CRC is computed; FD frames only to the last data bit, where a fixed stuff bit
takes over, so their CRC does not change their length.
"""

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.can.frame import BIT_RATE_SWITCH, ERROR, EXTENDED, FD, REMOTE, Frame
from pkxyz_ctrl.compiled.kernel import kernel

FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)

ERROR_PASSIVE = 32  # beside the flags of a frame: its sender's state, which an FD frame tells in its ESI bit

CRC15_POLYNOMIAL = 0x4599  # x^15+x^14+x^10+x^8+x^7+x^4+x^3+1, without its leading term
ACK_TO_END_BITS = 9  # ACK slot, ACK delimiter, 7 x end of frame
INTERFRAME_BITS = 3
FIXED_STUFFED_CRC17_BITS = 4 + 17 + 6  # stuff count with parity, CRC, a fixed stuff bit ahead and after every 4 bits
FIXED_STUFFED_CRC21_BITS = 4 + 21 + 7  # for more than 16 data bytes


class FrameFormatError(ValueError):
    """A frame that no CAN controller could send: identifier, length or flags out of range."""


@kernel
def _stuff(state: int, word: int, n_bits: int) -> int:
    """Pass the ``n_bits`` low bits of ``word``, most significant first, through the stuffing rule.

    ``state`` is stuff bits so far << 8 | run length << 1 | last bit, 1 before the start of frame. The stuff bit due
    after a run of five is counted when the next bit comes: whether one follows the last bit is the format's affair.
    """
    count, run, last = state >> 8, (state >> 1) & 0x7F, state & 1
    for i in range(n_bits - 1, -1, -1):
        if run == 5:
            count, run, last = count + 1, 1, 1 - last
        bit = (word >> i) & 1
        run = run + 1 if bit == last else 1
        last = bit
    return (count << 8) | (run << 1) | last


def _stuffed_bytes() -> NDArray[np.int16]:
    """(12, 256): what ``_stuff`` makes of a byte, by run and last bit before it."""
    before, byte = np.arange(2 * 5 + 2)[:, None], np.arange(256)
    count, run, last = np.zeros((len(before), 256), int), before >> 1, before & 1
    for i in range(7, -1, -1):
        is_due = run == 5
        count, run, last = count + is_due, np.where(is_due, 1, run), np.where(is_due, 1 - last, last)
        bit = byte >> i & 1
        run, last = np.where(bit == last, run + 1, 1), bit
    return (count << 8 | run << 1 | last).astype(np.int16)


_STUFFED = _stuffed_bytes()


@kernel
def _stuff_byte(state: int, byte: int) -> int:
    """``_stuff`` of eight bits, in one step."""
    return int((state & ~0xFF) + _STUFFED[state & 0xFF, byte])


@kernel
def _crc15(crc: int, word: int, n_bits: int) -> int:
    for i in range(n_bits - 1, -1, -1):
        feedback = (crc >> 14) ^ ((word >> i) & 1)
        crc = ((crc << 1) & 0x7FFF) ^ (CRC15_POLYNOMIAL * feedback)
    return crc


@kernel
def _fd_code(length: int) -> int:
    """Data length code of an FD frame, -1 if there is none."""
    if length <= 8:
        return length
    if length <= 24:
        return 6 + length // 4 if length % 4 == 0 else -1
    return 11 + length // 16 if length <= 64 and length % 16 == 0 else -1


@kernel
def _id_bits(can_id: int, extended: bool) -> int:
    """Start of frame and identifier: 12 bits, or 32 with SRR and IDE (both recessive) in their places."""
    if extended:
        return (can_id >> 18) << 20 | 3 << 18 | (can_id & 0x3FFFF)
    return can_id


@kernel
def _bit_counts(can_id: int, data: bytes, flags: int) -> int:
    """Bits at nominal rate | bits at data rate << 16; -1 if there is no such frame."""
    length = len(data)
    extended = (flags & EXTENDED) != 0
    if can_id < 0 or can_id >= (1 << 29 if extended else 1 << 11):
        return -1
    header, n_header = _id_bits(can_id, extended), 32 if extended else 12
    if flags & FD == 0:
        if length > 8 or flags & BIT_RATE_SWITCH:
            return -1
        remote = 1 if flags & REMOTE else 0
        header, n_header = header << 7 | remote << 6 | length, n_header + 7  # RTR, IDE or r1, r0, DLC
        state, crc = _stuff(1, header, n_header), _crc15(0, header, n_header)
        if remote:
            length = 0
        for i in range(length):
            byte = np.int64(data[i])
            state, crc = _stuff_byte(state, byte), _crc15(crc, byte, 8)
        state = _stuff(state, crc, 15)
        stuffed = (state >> 8) + (1 if (state >> 1) & 0x7F == 5 else 0)
        return int(n_header + 8 * length + 15 + stuffed + 1 + ACK_TO_END_BITS + INTERFRAME_BITS)
    code = _fd_code(length)
    if code < 0 or flags & REMOTE:
        return -1
    switch = 1 if flags & BIT_RATE_SWITCH else 0
    # RRS, IDE, FDF, res, BRS; an extended frame has had its IDE
    header, n_header = (header << 4, n_header + 4) if extended else (header << 5, n_header + 5)
    state = _stuff(1, header | 4 | switch, n_header)  # FDF differs from res, and no run of five spans them
    nominal = n_header + (state >> 8) + ACK_TO_END_BITS + INTERFRAME_BITS
    state = _stuff(state & 0xFF, (16 if flags & ERROR_PASSIVE else 0) | code, 5)  # ESI, DLC
    for i in range(length):
        state = _stuff_byte(state, np.int64(data[i]))
    crc_field = FIXED_STUFFED_CRC21_BITS if length > 16 else FIXED_STUFFED_CRC17_BITS
    fast = 5 + 8 * length + (state >> 8) + crc_field + 1
    return int(nominal | fast << 16 if switch else nominal + fast)


@kernel
def duration_ns_kernel(nominal_bitrate: int, data_bitrate: int, can_id: int, data: bytes, flags: int) -> int:
    """``frame_duration_ns`` for the hot path: -1 if there is no such frame."""
    counts = _bit_counts(can_id, data, flags)
    if counts < 0:
        return -1
    nominal_ns = ((counts & 0xFFFF) * 1_000_000_000 + nominal_bitrate // 2) // nominal_bitrate
    if counts >> 16 == 0:
        return int(nominal_ns)
    return int(nominal_ns + ((counts >> 16) * 1_000_000_000 + data_bitrate // 2) // data_bitrate)


def bits_ns(n_bits: int, bitrate: int) -> int:
    """Duration of ``n_bits`` at ``bitrate`` bit/s, to the nearest ns."""
    return (n_bits * 1_000_000_000 + bitrate // 2) // bitrate


def to_end_ns(nominal_bitrate: int) -> int:
    """What, added to a frame's start and duration, gives 1000 times the microsecond at which its EOF has ended."""
    return 999 - bits_ns(INTERFRAME_BITS, nominal_bitrate)


def frame_flags(frame: Frame, error_passive: bool = False) -> int:
    """The flags of ``duration_ns_kernel``. Raises FrameFormatError for an error frame."""
    flags = frame.flags
    if flags & ERROR:
        raise FrameFormatError("an error frame has no length of its own")
    return flags | ERROR_PASSIVE if error_passive else flags


def frame_duration_ns(frame: Frame, nominal_bitrate: int, data_bitrate: int, error_passive: bool = False) -> int:
    """Time from start of frame to the end of the interframe space, in ns, each bit rate's share rounded once.

    ``data_bitrate`` (bit/s) matters for frames with ``bitrate_switch`` only. ``error_passive``: the sender's state,
    which an FD frame carries in its ESI bit. Raises FrameFormatError.
    """
    duration_ns: int = duration_ns_kernel(
        nominal_bitrate, data_bitrate, frame.can_id, frame.data, frame_flags(frame, error_passive)
    )
    if duration_ns < 0:
        raise FrameFormatError(_what_is_wrong(frame))
    return duration_ns


def frame_bit_counts(frame: Frame, error_passive: bool = False) -> tuple[int, int]:
    """Bits at the nominal and at the data bit rate, interframe space included. Raises FrameFormatError."""
    counts: int = _bit_counts(frame.can_id, frame.data, frame_flags(frame, error_passive))
    if counts < 0:
        raise FrameFormatError(_what_is_wrong(frame))
    return counts & 0xFFFF, counts >> 16


def _what_is_wrong(frame: Frame) -> str:
    if not 0 <= frame.can_id < (1 << 29 if frame.is_extended else 1 << 11):
        return f"identifier {frame.can_id:#x} does not fit into {29 if frame.is_extended else 11} bits"
    if frame.is_fd and frame.is_remote:
        return "CAN FD has no remote frames"
    if frame.bitrate_switch and not frame.is_fd:
        return "a classic frame cannot switch its bit rate"
    return f"{len(frame.data)} data bytes, but {'an FD' if frame.is_fd else 'a classic'} frame has " + (
        f"one of {FD_LENGTHS}" if frame.is_fd else "at most 8"
    )


def worst_case_frame_us(
    length: int,
    nominal_bitrate: int,
    data_bitrate: int = 0,
    *,
    is_fd: bool = False,
    bitrate_switch: bool = False,
    is_extended: bool = False,
) -> float:
    """The customary upper bound in us over all identifiers and data of ``length`` bytes (Davis et al. 2007).

    A stuff bit after the first five bits and then after every fourth. Fixed bits make the bound unreachable for some
    identifiers: ``frame_range_us`` is exact. Raises FrameFormatError.
    """
    frame = Frame(0, bytes(length), is_fd, bitrate_switch, is_extended=is_extended)
    frame_bit_counts(frame)
    n_header = 32 if is_extended else 12
    if not is_fd:
        stuffable = n_header + 7 + 8 * length + 15
        bits = stuffable + (stuffable - 1) // 4 + 1 + ACK_TO_END_BITS + INTERFRAME_BITS
        return bits * 1e6 / nominal_bitrate
    n_header += 4 if is_extended else 5
    stuffed_nominal, stuffed = (n_header - 2) // 4, (n_header + 5 + 8 * length - 2) // 4
    crc_field = FIXED_STUFFED_CRC21_BITS if length > 16 else FIXED_STUFFED_CRC17_BITS
    nominal = n_header + stuffed_nominal + ACK_TO_END_BITS + INTERFRAME_BITS
    fast = 5 + 8 * length + stuffed - stuffed_nominal + crc_field + 1
    return nominal * 1e6 / nominal_bitrate + fast * 1e6 / (data_bitrate if bitrate_switch else nominal_bitrate)


def frame_range_us(
    can_id: int, length: int, nominal_bitrate: int, data_bitrate: int = 0, *, is_fd: bool = False
) -> tuple[float, float]:
    """Shortest and longest duration in us of a data frame with this 11-bit identifier, over all its data.

    FD frames are taken with bit-rate switch, ``data_bitrate`` then matters. Exact for FD; for classic frames the CRC
    is taken as free, so the range may be a few bits wider than any data attain. Raises FrameFormatError.
    """
    frame_bit_counts(Frame(can_id, bytes(length), is_fd))
    if not is_fd:
        stuffable = f"{can_id:012b}000{length:04b}" + "x" * (8 * length + 15)
        fixed = len(stuffable) + 1 + ACK_TO_END_BITS + INTERFRAME_BITS
        fewest, most = _stuff_bit_range(stuffable + "x")  # one more bit: a stuff bit may follow the CRC's last
        return (fixed + fewest) * 1e6 / nominal_bitrate, (fixed + most) * 1e6 / nominal_bitrate
    header = f"{can_id:012b}00101"  # RRS, IDE, FDF, res, BRS
    stuffable = f"{header}0{_fd_code(length):04b}" + "x" * (8 * length)
    stuffed, (fewest, most) = _stuff_bit_range(header)[0], _stuff_bit_range(stuffable)
    crc_field = FIXED_STUFFED_CRC21_BITS if length > 16 else FIXED_STUFFED_CRC17_BITS
    nominal = len(header) + stuffed + ACK_TO_END_BITS + INTERFRAME_BITS
    fast = len(stuffable) - len(header) - stuffed + crc_field + 1
    slow_us = nominal * 1e6 / nominal_bitrate
    return slow_us + (fast + fewest) * 1e6 / data_bitrate, slow_us + (fast + most) * 1e6 / data_bitrate


def _stuff_bit_range(bits: str) -> tuple[int, int]:
    """Fewest and most stuff bits ahead of the last of ``bits``, where "x" may be either."""
    reached = {1: (0, 0)}
    for place in bits:
        following: dict[int, tuple[int, int]] = {}
        for state, (fewest, most) in reached.items():
            for bit in (0, 1) if place == "x" else (int(place),):
                after = _stuff(state, bit, 1)
                low, high = following.get(after & 0xFF, (len(bits), 0))
                following[after & 0xFF] = min(low, fewest + (after >> 8)), max(high, most + (after >> 8))
        reached = following
    return min(low for low, _ in reached.values()), max(high for _, high in reached.values())
