"""Frame durations against a frame that is built bit by bit, as a receiver would see it.

The construction shares nothing with the kernel: it is a string of bits, stuffed by looking at its own last five
characters, with CRCs from the crccheck package. FD frames are built with stuff count and CRC as well, which shows
that their content leaves the length alone.
"""

import itertools

import pytest
from crccheck.crc import Crc15, Crc17CanFd, Crc21CanFd
from hypothesis import given, settings
from hypothesis import strategies as st

from hil.bus.frame_time import (
    FD_LENGTHS,
    FrameFormatError,
    duration_ns_kernel,
    frame_bit_counts,
    frame_duration_ns,
    frame_range_us,
    worst_case_frame_us,
)
from pkxyz_ctrl.can.frame import BIT_RATE_SWITCH, Frame
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import load

TAIL = "1" + "0" + "1" + "1" * 7 + "1" * 3  # CRC delimiter, ACK, ACK delimiter, EOF, interframe space


def other(bit: str) -> str:
    return "1" if bit == "0" else "0"


def stuffed(bits: str, after_last: bool) -> tuple[str, list[int]]:
    """The stuffed string, and for each bit of ``bits`` the place where it ended up."""
    out, places = "", []
    for i, bit in enumerate(bits):
        places.append(len(out))
        out += bit
        if out[-5:] in ("00000", "11111") and (after_last or i + 1 < len(bits)):
            out += other(bit)
    return out, places


def number(bits: str) -> bytes:
    """Leading zeros do not change a CRC that starts from 0, so bits may be padded to bytes on the left."""
    return int(bits, 2).to_bytes((len(bits) + 7) // 8, "big")


def identifier(frame: Frame) -> str:
    if frame.is_extended:
        return f"{frame.can_id >> 18:011b}" + "11" + f"{frame.can_id & 0x3FFFF:018b}"
    return f"{frame.can_id:011b}"


def classic_bits(frame: Frame) -> str:
    payload = "" if frame.is_remote else "".join(f"{byte:08b}" for byte in frame.data)
    body = "0" + identifier(frame) + ("1" if frame.is_remote else "0") + "00" + f"{len(frame.data):04b}" + payload
    crc = f"{Crc15.calc(number(body)):015b}"
    return stuffed(body + crc, after_last=True)[0] + TAIL


def fd_bits(frame: Frame, error_passive: bool) -> tuple[str, int, int]:
    """The bits, and the places of the BRS bit and of the CRC delimiter."""
    ident = identifier(frame) + ("0" if frame.is_extended else "00")  # RRS, and IDE where it is not there yet
    head = "0" + ident + "10" + ("1" if frame.bitrate_switch else "0")
    dlc = FD_LENGTHS.index(len(frame.data))
    body = head + ("1" if error_passive else "0") + f"{dlc:04b}" + "".join(f"{byte:08b}" for byte in frame.data)
    dynamic, places = stuffed(body, after_last=False)
    n_stuffed = (len(dynamic) - len(body)) % 8
    gray = f"{n_stuffed ^ (n_stuffed >> 1):03b}"
    count = gray + str(gray.count("1") % 2)
    width, poly = (17, Crc17CanFd._poly) if len(frame.data) <= 16 else (21, Crc21CanFd._poly)
    protected = dynamic + count
    register = 1 << (width - 1)
    for bit in protected:
        feedback = (register >> (width - 1)) ^ int(bit)
        register = ((register << 1) & ((1 << width) - 1)) ^ (poly if feedback else 0)
    tail = count + f"{register:0{width}b}"
    bits = dynamic
    for i in range(0, len(tail), 4):
        bits += other(bits[-1]) + tail[i : i + 4]
    if len(tail) % 4 == 0:
        bits += other(bits[-1])
    return bits + TAIL, places[len(head) - 1], len(bits)


def expected_counts(frame: Frame, error_passive: bool = False) -> tuple[int, int]:
    if not frame.is_fd:
        return len(classic_bits(frame)), 0
    bits, brs, delimiter = fd_bits(frame, error_passive)
    if not frame.bitrate_switch:
        return len(bits), 0
    return brs + 1 + len(bits) - delimiter - 1, delimiter - brs


identifiers = st.booleans().flatmap(
    lambda extended: st.tuples(st.integers(0, (1 << 29 if extended else 1 << 11) - 1), st.just(extended))
)
runs = st.lists(st.sampled_from([0x00, 0xFF, 0xF8, 0x07, 0x1F, 0x78, 0x87, 0x55]), max_size=64).map(bytes)
payloads = st.one_of(st.binary(max_size=64), runs)
"""Random bytes seldom hold long runs; the second kind is made of them."""


def cut(data: bytes, longest: int) -> bytes:
    return data[: max(length for length in FD_LENGTHS if length <= min(len(data), longest))]


@given(ident=identifiers, data=payloads, remote=st.booleans())
@settings(max_examples=400)
def test_classic_frame_has_the_length_of_its_bits(ident: tuple[int, bool], data: bytes, remote: bool) -> None:
    frame = Frame(ident[0], data[:8], is_remote=remote, is_extended=ident[1])
    assert frame_bit_counts(frame) == expected_counts(frame)


@given(ident=identifiers, data=payloads, switch=st.booleans(), passive=st.booleans())
@settings(max_examples=400)
def test_fd_frame_has_the_length_of_its_bits(ident: tuple[int, bool], data: bytes, switch: bool, passive: bool) -> None:
    frame = Frame(ident[0], cut(data, 64), True, switch, is_extended=ident[1])
    assert frame_bit_counts(frame, passive) == expected_counts(frame, passive)


def test_every_identifier_and_every_length() -> None:
    for can_id in range(2048):
        for frame in (Frame(can_id, b"\x00"), Frame(can_id, b"\xff", True, True), Frame(can_id, b"", is_remote=True)):
            assert frame_bit_counts(frame) == expected_counts(frame), frame
    for length, fill in itertools.product(FD_LENGTHS, (0x00, 0xFF, 0xAA)):
        frame = Frame(0x155, bytes([fill]) * length, True, True)
        assert frame_bit_counts(frame) == expected_counts(frame), frame


def test_a_run_of_five_at_the_end_of_fd_data_gets_the_fixed_stuff_bit_only() -> None:
    # ...1 00000 at the end, against ...1 0000 1: the fixed stuff bit comes anyway, so both are as long
    ends_in_run, ends_without = Frame(0x155, b"\xe0", True, True), Frame(0x155, b"\xe1", True, True)
    assert frame_bit_counts(ends_in_run) == frame_bit_counts(ends_without)
    # the classic frame does stuff there: 5 zeros at the end of the CRC still get their stuff bit
    crc_ends_in_run = next(
        frame
        for value in range(1 << 16)
        if (frame := Frame(0x155, value.to_bytes(2, "big")))
        and classic_bits(frame)[: -len(TAIL)].endswith(("000001", "111110"))
    )
    assert frame_bit_counts(crc_ends_in_run) == expected_counts(crc_ends_in_run)


def test_figures_from_the_literature() -> None:
    """Davis, Burns, Bril, Lukkien 2007: 8 bytes take 55 + 10 * 8 = 135 bits at most, 80 + 10 * 8 = 160 if extended."""
    for length in range(9):
        assert worst_case_frame_us(length, 1_000_000) == 55 + 10 * length
        assert worst_case_frame_us(length, 1_000_000, is_extended=True) == 80 + 10 * length
    assert worst_case_frame_us(8, 500_000) == 270.0
    # 1 + 11 + 1 + 1 + 1 + 4 + 64 + 15 + 1 + 2 + 7 + 3 = 111 without stuffing
    shortest = min(frame_bit_counts(Frame(0x555, bytes([0x55, 0xAA, b, 0x55, 0x5A, 0xA5, 0x55, a])))[0]
                   for a in range(0, 256, 5) for b in range(0, 256, 5))  # fmt: skip
    assert shortest == 111


@given(ident=identifiers, data=payloads, is_fd=st.booleans())
@settings(max_examples=200)
def test_no_frame_is_longer_than_its_worst_case(ident: tuple[int, bool], data: bytes, is_fd: bool) -> None:
    frame = Frame(ident[0], cut(data, 64 if is_fd else 8), is_fd, is_fd, is_extended=ident[1])
    bound_us = worst_case_frame_us(
        len(frame.data), 1_000_000, 5_000_000, is_fd=is_fd, bitrate_switch=is_fd, is_extended=ident[1]
    )
    assert frame_duration_ns(frame, 1_000_000, 5_000_000) <= bound_us * 1000 + 0.5


@pytest.mark.parametrize("can_id", [0x000, 0x080, 0x28A, 0x30A, 0x555, 0x77F, 0x7FF])
@pytest.mark.parametrize("is_fd", [False, True])
def test_the_range_of_one_identifier_is_attained_and_not_left(can_id: int, is_fd: bool) -> None:
    """Exhaustively over one data byte. FD attains both ends; a classic CRC is not free, so it may miss them."""
    low_us, high_us = frame_range_us(can_id, 1, 1_000_000, 5_000_000, is_fd=is_fd)
    times = [
        frame_duration_ns(Frame(can_id, bytes([b]), is_fd, is_fd), 1_000_000, 5_000_000) / 1000 for b in range(256)
    ]
    if is_fd:
        assert (min(times), max(times)) == pytest.approx((low_us, high_us), abs=1e-9)
    assert low_us <= min(times) <= low_us + 3
    assert high_us - 3 <= max(times) <= high_us


def test_two_bit_rates_add_up_to_the_nanosecond() -> None:
    frame = Frame(0x30A, bytes(8), True, True)
    nominal, fast = frame_bit_counts(frame)
    assert (nominal, fast) == expected_counts(frame)
    assert frame_duration_ns(frame, 1_000_000, 5_000_000) == nominal * 1000 + fast * 200
    assert frame_duration_ns(frame, 500_000, 8_000_000) == nominal * 2000 + fast * 125
    assert frame_duration_ns(frame, 300_000, 300_000) == round(nominal * 1e5 / 30) + round(fast * 1e5 / 30)
    assert frame_duration_ns(frame._replace(flags=frame.flags & ~BIT_RATE_SWITCH), 1_000_000, 5_000_000) % 1000 == 0


@pytest.mark.parametrize(
    ("frame", "what"),
    [
        (Frame(0x800, b""), "11 bits"),
        (Frame(-1, b""), "11 bits"),
        (Frame(1 << 29, b"", is_extended=True), "29 bits"),
        (Frame(1, bytes(9)), "at most 8"),
        (Frame(1, bytes(9), True), "9 data bytes"),
        (Frame(1, bytes(65), True), "65 data bytes"),
        (Frame(1, b"", True, is_remote=True), "no remote"),
        (Frame(1, b"", False, True), "cannot switch"),
        (Frame(1, b"", is_error=True), "error frame"),
    ],
)
def test_impossible_frames_are_named(frame: Frame, what: str) -> None:
    with pytest.raises(FrameFormatError, match=what):
        frame_duration_ns(frame, 1_000_000, 5_000_000)


def test_fd_lengths_are_the_sixteen_and_no_others() -> None:
    possible = [n for n in range(80) if duration_ns_kernel(1_000_000, 1_000_000, 1, bytes(n), 1) > 0]
    assert possible == list(FD_LENGTHS)


@pytest.mark.parametrize(
    ("bus", "period_us", "with_sdo_us", "with_signature_us"),
    [("fd_5k", 200, 244, 191), ("classic_2k", 500, 558, 431)],
)
def test_beside_a_ticks_frames_eight_bytes_fit_and_a_read_back_does_not(
    bus: str, period_us: int, with_sdo_us: int, with_signature_us: int
) -> None:
    """The wire's page draws on it."""
    config = load("buses", bus, BusConfig)
    assert config.can is not None
    nominal, fd = config.can.nominal_bitrate_bit_per_s, config.can.driver.fd
    data = config.can.data_bitrate_bit_per_s or nominal

    def together_us(*frames: tuple[int, bytes]) -> float:
        return (
            sum(frame_duration_ns(Frame(can_id, payload, fd, fd), nominal, data) for can_id, payload in frames) / 1000
        )

    tick = ((0x080, b"\x11"), (0x28A, bytes(8)), (0x30A, bytes(8)))
    assert config.period_us == period_us
    assert round(together_us(*tick, (0x60A, bytes(8)), (0x60A, bytes(8)))) == with_sdo_us > period_us
    assert round(together_us(*tick, (0x18A, bytes(8)))) == with_signature_us < period_us
