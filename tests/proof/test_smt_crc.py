"""CRC and codec, proven for every payload: controller, gate and node compute
AUTOSAR's CRC8H2F, and it finds what it should.

The standard's CRC, bit by bit and without any table, is the reference. One step of its register is shown to be linear
over GF(2), for all registers and bytes; hence the CRC of a payload is the exclusive or of what its words add, and
every table of ours is held against that, entry by entry.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import pytest
import z3
from gate_frames import crc8h2f
from symbolic import Bits, DisprovedError, LinearTable, Number, of, paths, prove, rebuilt, unknown

from hil.node import crc as node_crc
from hil.node.drive import DriveReceiver
from pkxyz_ctrl.can import process_pdo
from pkxyz_ctrl.can.codec import ProcessCodec
from pkxyz_ctrl.can.process_pdo import pdo_record
from pkxyz_ctrl.safety import gate_rules

DRIVE, SENSE = 0x30A, 0x28A


def step(register: Any, byte: Any) -> Any:
    """The register after one more byte, as the standard words it (specification of CRC routines, 7.2.1.2)."""
    register = register ^ byte
    for _ in range(8):
        register = z3.If(z3.Extract(7, 7, register) == 1, (register << 1) ^ 0x2F, register << 1)
    return register


@cache
def reference_tables(can_id: int) -> tuple[LinearTable, ...]:
    """What each count (by its two's complement) and the counter add to the CRC of a payload under ``can_id``."""
    head = can_id.to_bytes(2, "little")
    nothing = crc8h2f(head + bytes(7))
    words = [
        bytes(
            crc8h2f(head + bytes(2 * place) + word.to_bytes(2, "little") + bytes(5 - 2 * place)) ^ nothing
            for word in range(65536)
        )
        for place in range(3)
    ]
    last = bytes(crc8h2f(head + bytes(6) + bytes((byte,))) ^ nothing for byte in range(256))
    return tuple(map(LinearTable, (*words, last)))


def test_a_step_of_the_register_is_linear() -> None:
    """So a CRC is its value for zeros, with what each bit of the payload adds by itself."""
    r, s, d, e = (z3.BitVec(name, 8) for name in "rsde")
    prove(z3.BoolVal(True), step(r ^ s, d ^ e) == step(r, d) ^ step(s, e), "linear")
    with pytest.raises(DisprovedError):
        prove(z3.BoolVal(True), step(r ^ s, d | e) == step(r, d) ^ step(s, e), "a planted defect")


def test_the_reference_is_the_register_stepped() -> None:
    byte = z3.BitVec("byte", 8)
    for value in range(256):
        stepped = z3.simplify(z3.substitute(step(z3.BitVecVal(0xFF, 8), byte), (byte, z3.BitVecVal(value, 8))))
        assert stepped.as_long() ^ 0xFF == crc8h2f(bytes((value,)))


@pytest.mark.parametrize("can_id", [DRIVE, SENSE, 0x301, 0x37F])
def test_every_table_of_ours_is_the_reference(can_id: int) -> None:
    """Codec, gate and node look up the same numbers, each in tables that it has made its own way."""
    first, second, third, last = (table.table for table in reference_tables(can_id))
    nothing = crc8h2f(can_id.to_bytes(2, "little") + bytes(7))
    assert (first, second, third) == node_crc.WORDS
    assert node_crc.last_byte_table(can_id) == bytes(value ^ nothing for value in last)
    assert last == bytes(gate_rules._CRC)  # through which the gate looks up each byte (test_smt_gate.py)
    assert nothing == gate_rules.crc_start(can_id)


def standard_bits(can_id: int) -> tuple[int, ...]:
    """The eight bits of the CRC under ``can_id``, each by the bits of the payload that it is a sum of."""
    head = can_id.to_bytes(2, "little")
    nothing = crc8h2f(head + bytes(7))
    rows = [Bits.ONE if nothing >> place & 1 else 0 for place in range(8)]
    for bit in range(56):
        added = crc8h2f(head + (1 << bit).to_bytes(7, "little")) ^ nothing
        rows = [row | (1 << bit if added >> place & 1 else 0) for place, row in enumerate(rows)]
    return tuple(rows)


def gate_bits(can_id: int, old: str = "", new: str = "") -> tuple[int, ...]:
    """The same of the gate's shipped ``crc_of``, by running it."""
    crc_of = rebuilt(gate_rules.crc_of, {"_CRC": LinearTable(bytes(gate_rules._CRC))}, old, new)
    found: Bits = crc_of(gate_rules.crc_start(can_id), Bits.unknown())
    return found.of_width(8)


@pytest.mark.parametrize("can_id", [DRIVE, SENSE, 0x301, 0x37F])
def test_the_gate_computes_the_standard_s_crc(can_id: int) -> None:
    """Of every payload: both are sums of its bits, and of the same ones."""
    assert gate_bits(can_id) == standard_bits(can_id)


@pytest.mark.parametrize(
    ("old", "new"), [("8 * place", "4 * place"), ("range(7)", "range(6)"), ("crc ^ (word", "(word"), ("^ start", "")]
)
def test_the_gate_s_crc_is_another_with_a_planted_defect(old: str, new: str) -> None:
    assert gate_bits(DRIVE, old, new) != standard_bits(DRIVE)


@pytest.mark.parametrize("flipped", [1, 2, 3])
@pytest.mark.slow
def test_no_damage_of_up_to_three_bits_passes(flipped: int) -> None:
    """In counts, counter, CRC or identifier, for every payload: by linearity only the damage matters."""
    damage = z3.BitVec("damage", 80)  # two bytes of identifier, seven of payload, the CRC
    register = z3.BitVecVal(0, 8)
    for place in range(9):
        register = step(register, z3.Extract(79 - 8 * place, 72 - 8 * place, damage))
    count = z3.Sum([z3.ZeroExt(7, z3.Extract(bit, bit, damage)) for bit in range(80)])
    prove(z3.And(count == flipped), register != z3.Extract(7, 0, damage), f"{flipped} bits are found")


def test_the_hamming_distance_is_four_and_no_more() -> None:
    """The proof above fails where it should: some four bits do pass."""
    with pytest.raises(DisprovedError):
        test_no_damage_of_up_to_three_bits_passes(4)


def crc_of(numbers: list[Number], can_id: int) -> Any:
    tables = reference_tables(can_id)
    terms = [table[number].z for table, number in zip(tables, numbers, strict=True)]
    return terms[0] ^ terms[1] ^ terms[2] ^ terms[3] ^ crc8h2f(can_id.to_bytes(2, "little") + bytes(7))


CODEC_TABLE = {"_TABLE": LinearTable(bytes(process_pdo._TABLE))}


def codec_bits(can_id: int, old: str = "", new: str = "") -> tuple[int, ...]:
    """The codec's ``crc_of``, as the gate's above."""
    found: Bits = rebuilt(process_pdo.crc_of, CODEC_TABLE, old, new)(pdo_record(can_id, True), Bits.unknown())
    return found.of_width(8)


def encoded_bits(can_id: int, old: str = "", new: str = "") -> tuple[int, ...]:
    """What ``encode`` makes of any counts and counter: each bit of the payload by theirs, in their order."""
    crc_of = rebuilt(process_pdo.crc_of, CODEC_TABLE)
    counts = (Bits.unknown(16, 16 * place) for place in range(3))
    encode = rebuilt(process_pdo.encode, {"crc_of": crc_of, "_highest_byte": lambda crc: crc << 56}, old, new)
    found: Bits = encode(pdo_record(can_id, True), *counts, Bits.unknown(8, 48))
    return found.of_width(64)


@pytest.mark.parametrize("can_id", [DRIVE, SENSE, 0x301, 0x37F])
def test_the_codec(can_id: int) -> None:
    """For every payload: the counts and the counter as they are, and the standard's CRC behind them."""
    assert codec_bits(can_id) == standard_bits(can_id)
    assert encoded_bits(can_id) == (*(1 << bit for bit in range(56)), *standard_bits(can_id))


def prove_decoding(old: str = "", new: str = "") -> int:
    """What stands in a payload is read as it was written, with its sign. Returns the paths."""
    proven, word = 0, z3.BitVec("word", 64)
    count_of = rebuilt(process_pdo.count_of, {}, old, new)
    for place in range(3):
        written = z3.SignExt(48, z3.Extract(16 * place + 15, 16 * place, word))
        for path in paths(lambda place=place: count_of(Number(word), place), []):  # type: ignore[misc]
            prove(path.condition, z3.And(of(path.result) == written, *path.claims), "decode")
            proven += 1
    counter = rebuilt(process_pdo.counter_of, {})(Number(word))
    prove(z3.BoolVal(True), of(counter) == z3.ZeroExt(56, z3.Extract(55, 48, word)), "decode")
    return proven


def test_what_was_encoded_is_decoded() -> None:
    assert prove_decoding() == 3


@pytest.mark.parametrize("bit", range(64))
def test_a_payload_is_right_or_not_by_its_crc(bit: int) -> None:
    codec = ProcessCodec(SENSE, True)
    payload = int.from_bytes(codec.encode((-3, 17, 32767), 200), "little")
    assert codec.decode(payload.to_bytes(8, "little"))[4]
    assert not codec.decode((payload ^ 1 << bit).to_bytes(8, "little"))[4]


def test_the_codec_s_proofs_fail_for_a_planted_defect() -> None:
    assert codec_bits(DRIVE, "8 * place", "7 * place") != standard_bits(DRIVE)
    whole = encoded_bits(DRIVE)
    for old, new in (
        ("(third & 0xFFFF)", "(third & 0x7FFF)"),
        ("<< 48", "<< 40"),
        ("(counter & 0xFF)", "(second & 0xFF)"),
    ):
        with pytest.raises(AssertionError):
            assert encoded_bits(DRIVE, old, new) == whole
    with pytest.raises(DisprovedError, match="decode"):
        prove_decoding("^ 0x8000) - 0x8000", "^ 0x8000) - 0x7FFF")


def test_counts_that_do_not_fit_are_an_error_and_nothing_else() -> None:
    """One past each end."""
    codec = ProcessCodec(DRIVE, True)
    for low, high, place in ((-32769, 32768, 0), (-32769, 32768, 2), (-1, 256, 3)):
        for value in (low, high):
            numbers = [0, 0, 0, 0]
            numbers[place] = value
            with pytest.raises(ValueError, match="cannot carry"):
                codec.encode((numbers[0], numbers[1], numbers[2]), numbers[3])


# -- the node's side -----------------------------------------------------------------------------------------


def is_late(counts: Any, t_us: int) -> bool:
    """As ``DriveReceiver._is_late`` answers where a frame is owed: anything but 0 V is."""
    return any(count != 0 for count in counts)


def is_zeroed(counts: Any) -> bool:
    """As ``DriveReceiver._zeroed`` answers."""
    return not any(count != 0 for count in counts)


def prove_receiver(claim: str, old: str = "", new: str = "") -> int:
    """``DriveReceiver._receive_protected`` with an unknown frame and an unknown memory: what can become ``pending``."""
    ranges = [
        ("a", 0, 65535),
        ("b", 0, 65535),
        ("c", 0, 65535),
        ("counter", 0, 255),
        ("crc", 0, 255),
        ("last", 0, 255),
        ("limit", 0, 32767),
    ]
    made = {row[0]: unknown(*row) for row in ranges}
    n = {name: number for name, (number, _) in made.items()}
    assume = [condition for _, condition in made.values()]
    frame = [n[name] for name in ("a", "b", "c", "counter", "crc")]
    receive = rebuilt(
        DriveReceiver._receive_protected, {"_unpack_protected": lambda data: frame, "bytes": lambda x: b""}, old, new
    )
    tables = [LinearTable(table) for table in (*node_crc.WORDS, node_crc.last_byte_table(DRIVE))]
    proven = 0
    for is_known in (False, True):
        for is_owed in (False, True):
            for is_zero_due in (False, True):

                def call(is_known: bool = is_known, is_owed: bool = is_owed, is_zero_due: bool = is_zero_due) -> Any:
                    node = SimpleNamespace(
                        _w0=tables[0],
                        _w1=tables[1],
                        _w2=tables[2],
                        _w3=tables[3],
                        counter=n["last"] if is_known else None,
                        crc=0,
                        _limit=n["limit"],
                        _is_owed=is_owed,
                        _is_zero_due=is_zero_due,
                        _was_refused=False,
                        pending="nothing",
                    )
                    node._errors = SimpleNamespace(bad=lambda *a: None, good=lambda t: None, present=False)
                    node._refuse = lambda *a: None
                    node._is_late, node._zeroed = is_late, is_zeroed
                    receive(node, bytes(8), 0)
                    return node.pending

                for path in paths(call, assume):
                    if path.result == "nothing":
                        continue
                    counts = [of(x) for x in path.result]
                    voltage = z3.Or(*(x != 0 for x in counts))
                    holds = {
                        "range": z3.And(*(z3.And(x >= 0, x <= n["limit"].z) for x in counts)),
                        "CRC": n["crc"].z == crc_of(frame[:4], DRIVE),
                        "fresh": z3.BoolVal(not is_known)
                        if not is_known
                        else n["counter"].z == (n["last"].z + 1) & 0xFF,
                        "late or released": z3.Implies(voltage, z3.BoolVal(not is_owed and not is_zero_due)),
                        "content": z3.And(*(x == y.z for x, y in zip(counts, frame, strict=False))),
                    }
                    prove(path.condition, z3.And(holds[claim], *path.claims), claim)
                    proven += 1
    return proven


@pytest.mark.parametrize("claim", ["range", "CRC", "fresh", "late or released", "content"])
def test_what_the_node_will_apply(claim: str) -> None:
    assert prove_receiver(claim) >= 4


@pytest.mark.parametrize(
    ("claim", "old", "new"),
    [
        ("range", "or c > limit", ""),
        ("CRC", "^ self._w2[c]", "^ self._w1[c]"),
        ("fresh", "(last + 1) & 0xFF != counter", "last == counter"),
        ("late or released", "if self._is_owed and self._is_late((a, b, c), t_us):", "if self._is_owed and a == 1:"),
        ("content", "self.pending = (a, b, c)", "self.pending = (a, c, b)"),
    ],
)
def test_the_receiver_s_proof_fails_for_a_planted_defect(claim: str, old: str, new: str) -> None:
    with pytest.raises(DisprovedError, match=claim):
        prove_receiver(claim, old, new)
