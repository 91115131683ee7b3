"""The process PDO's bytes: CRC against its definition, layout against struct, protection against every small error."""

import itertools
import math
import struct

import pytest
from crccheck.crc import Crc8Autosar
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pkxyz_ctrl.can import process_pdo
from pkxyz_ctrl.can.codec import (
    COUNTS_MAX,
    COUNTS_MIN,
    DRIVE_SCALE,
    AnalogScale,
    CountsOutOfRangeError,
    ProcessCodec,
)
from pkxyz_ctrl.can.process_pdo import crc8

DRIVE, SENSE = 0x30A, 0x28A
counts = st.integers(COUNTS_MIN, COUNTS_MAX)
triples = st.tuples(counts, counts, counts)
alive = st.integers(0, 255)


def crc8_bit_by_bit(data: bytes) -> int:
    """Polynomial division, one bit at a time, as the AUTOSAR specification draws it."""
    register = 0xFF
    for bit in (byte >> place & 1 for byte in data for place in range(7, -1, -1)):
        carry = (register >> 7) ^ bit
        register = (register << 1 & 0xFF) ^ (0x2F if carry else 0)
    return register ^ 0xFF


def test_crc_has_the_published_check_value():
    assert crc8(b"123456789") == 0xDF


@pytest.mark.parametrize(  # AUTOSAR SWS CRC library, table of example data for CRC8H2F
    ("data", "expected"),
    [
        ("00000000", 0x12),
        ("f20183", 0xC2),
        ("0faa0055", 0xC6),
        ("00ff5511", 0x77),
        ("332255aabbccddeeff", 0x11),
        ("926b55", 0x33),
        ("ffffffff", 0x6C),
    ],
)
def test_crc_of_the_autosar_examples(data, expected):
    assert crc8(bytes.fromhex(data)) == expected


@given(st.binary(max_size=40))
def test_crc_equals_both_oracles(data):
    assert crc8(data) == crc8_bit_by_bit(data) == Crc8Autosar.calc(data)


@given(st.integers(0, 0x7FF), triples, alive)
@example(SENSE, (COUNTS_MIN, -1, COUNTS_MAX), 255)
def test_payload_is_counts_counter_and_crc_over_the_cob_id(cob_id, values, counter):
    codec = ProcessCodec(cob_id, protected=True)
    body = struct.pack("<3hB", *values, counter)
    payload = codec.encode(values, counter)
    assert payload == body + bytes((crc8_bit_by_bit(struct.pack("<H", cob_id) + body),))
    assert codec.decode(payload) == (*values, counter, True)


@given(triples, alive)
def test_plain_payload_is_the_counts_alone(values, counter):
    codec = ProcessCodec(DRIVE, protected=False)
    assert codec.encode(values, counter) == struct.pack("<3h", *values)
    assert codec.decode(codec.encode(values, counter)) == (*values, 0, True)


def test_literal_bytes():
    # 0 V, 100 V, 200 V, alive counter 7
    payload = ProcessCodec(DRIVE, protected=True).encode((0, 16384, 32767), 7)
    assert payload[:7].hex(" ") == "00 00 00 40 ff 7f 07"
    assert payload[7] == crc8_bit_by_bit(bytes.fromhex("0a03") + payload[:7]) == 0x94


@pytest.mark.parametrize("place", [0, 1, 2])
@pytest.mark.parametrize("count", [COUNTS_MIN, COUNTS_MAX])
def test_each_count_goes_to_its_limits(place, count):
    values = [0, 0, 0]
    values[place] = count
    for protected in (True, False):
        assert ProcessCodec(DRIVE, protected).decode(ProcessCodec(DRIVE, protected).encode(tuple(values), 0))[:3] == (
            *values,
        )


@pytest.mark.parametrize("protected", [True, False])
@pytest.mark.parametrize("place", [0, 1, 2])
@pytest.mark.parametrize("bad", [COUNTS_MIN - 1, COUNTS_MAX + 1, 65535, 65536, -65536, -65537, 10**9, 1.5, math.nan])
def test_counts_beyond_int16_are_a_named_error(protected, place, bad):
    values = [0, 0, 0]
    values[place] = bad
    with pytest.raises((CountsOutOfRangeError, TypeError)) as caught:
        ProcessCodec(DRIVE, protected).encode(tuple(values), 0)
    assert isinstance(bad, float) or caught.type is CountsOutOfRangeError


@pytest.mark.parametrize("counter", [-1, -255, 256])
def test_alive_counter_beyond_a_byte_is_a_named_error(counter):
    with pytest.raises(CountsOutOfRangeError, match="counter"):
        ProcessCodec(DRIVE, protected=True).encode((0, 0, 0), counter)


@pytest.mark.parametrize("cob_id", [-1, 0x800])
def test_cob_id_must_fit_eleven_bits(cob_id):
    with pytest.raises(ValueError, match="11 bits"):
        ProcessCodec(cob_id, protected=True)


PAYLOADS = [((0, 0, 0), 0), ((0, 16384, 32767), 7), ((-1, -1, -1), 255), ((-32768, 12345, -777), 128)]


@pytest.mark.parametrize(("values", "counter"), PAYLOADS)
def test_every_single_and_double_bit_error_is_rejected(values, counter):
    codec = ProcessCodec(SENSE, protected=True)
    word = int.from_bytes(codec.encode(values, counter), "little")
    masks = [1 << a for a in range(64)] + [1 << a | 1 << b for a, b in itertools.combinations(range(64), 2)]
    assert len(masks) == 64 + 2016
    accepted = [mask for mask in masks if codec.decode((word ^ mask).to_bytes(8, "little"))[4]]
    assert accepted == []


@pytest.mark.parametrize(("values", "counter"), PAYLOADS)
def test_every_burst_of_up_to_eight_bits_is_rejected(values, counter):
    # A CRC of degree 8 catches them all; bursts run in the order on the wire, most significant bit of a byte first.
    codec = ProcessCodec(SENSE, protected=True)
    word = int.from_bytes(codec.encode(values, counter), "big")
    bursts = {burst << shift for burst in range(1, 256) for shift in range(57)}
    assert not any(codec.decode((word ^ burst).to_bytes(8, "big"))[4] for burst in bursts)


@pytest.mark.parametrize("node_id", range(1, 128))
def test_drive_and_sense_are_never_taken_for_each_other(node_id):
    # The COB-ID only adds a constant to the CRC, so one payload stands for all.
    drive, sense = (ProcessCodec(base + node_id, protected=True) for base in (0x300, 0x280))
    assert not sense.decode(drive.encode((1, 2, 3), 4))[4]
    assert not drive.decode(sense.encode((1, 2, 3), 4))[4]


def test_no_two_nodes_share_a_drive_identity():
    check_bytes = {ProcessCodec(0x300 + node_id, protected=True).encode((0, 0, 0), 0)[7] for node_id in range(1, 128)}
    assert len(check_bytes) == 127


@settings(max_examples=200)
@given(counts, st.floats(1e-18, 1e3), st.floats(-1e3, 1e3))
def test_scale_returns_the_count_it_came_from(count, scale, offset):
    analog = AnalogScale(scale, offset if abs(offset) < 1e9 * scale else 0.0)
    assert analog.counts(analog.physical(count)) == count


def test_scale_clamps_and_refuses_nan():
    assert DRIVE_SCALE.physical(32767) == pytest.approx(200.0, rel=1e-15)
    assert DRIVE_SCALE.physical(0) == 0.0
    assert [DRIVE_SCALE.counts(volt) for volt in (1e9, math.inf, -math.inf, 100.0)] == [32767, 32767, -32768, 16384]
    with pytest.raises(ValueError, match="not a number"):
        DRIVE_SCALE.counts(math.nan)


# -- what the compiled codec reads -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("protected", "length"), [(True, 8), (False, 6)])
def test_the_record_of_a_pdo_is_one_and_nobody_changes_it(protected, length):
    record = process_pdo.pdo_record(DRIVE, protected)
    assert record.shape == (1,)
    assert (record[0]["cob_id"], record[0]["length"]) == (DRIVE, length)
    for fixed in (record["cob_id"], process_pdo._TABLE):
        with pytest.raises(ValueError, match="read-only"):
            fixed[0] = 1


@pytest.mark.parametrize(("values", "counter"), PAYLOADS)
def test_a_payload_is_a_number_of_64_bits_with_a_sign(values, counter):
    """As the compiled gate takes it; without the compiler a number may have any size."""
    word = process_pdo.encode(process_pdo.pdo_record(DRIVE, True), *values, counter)
    assert int(word).to_bytes(8, "little", signed=True) == ProcessCodec(DRIVE, True).encode(values, counter)
