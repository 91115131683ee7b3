"""The transmit gate's arithmetic, proven: for all 16-bit counts, counters, limits and times, and for all histories.

``gate_rules.judge_drive`` runs with unknowns (``symbolic``): every payload of eight bytes, every time and limit, and
every state that its memory can be in. What is to hold of all histories is shown by induction: it holds at the
beginning, and whatever frame comes, it holds afterwards if it held before.
"""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest
import z3
from gate_frames import crc8h2f
from symbolic import DisprovedError, Number, of, paths, prove, rebuilt, unknown
from test_smt_crc import reference_tables

from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.safety import gate_rules
from pkxyz_ctrl.safety.gate import GateConfig, TransmitGate
from pkxyz_ctrl.safety.gate_rules import PERMITTED, FrameKind
from pkxyz_ctrl.safety.modes import Mode

CONFIG = GateConfig(count_max=20000, count_slew_max=1000, period_us=200)
DRIVE_ID = 0x300 + CONFIG.node_id


@dataclass(frozen=True)
class Unknowns:
    """A frame, the gate's memory and its limits, none of them known; ``assume`` says what each may be."""

    names: dict[str, Number]
    assume: tuple[Any, ...]

    def __getattr__(self, name: str) -> Any:
        return self.names[name].z


def unknowns() -> Unknowns:
    ranges = {
        "was_a": (0, 32767), "was_b": (0, 32767), "was_c": (0, 32767), "known": (0, 1),
        "last": (-1, 255), "next": (0, 255), "syncs": (0, 2), "row": (0, 2047),
        "maximum": (0, 32767), "slew": (1, 32767), "spacing": (0, 1_000_000),
        "now": (0, 1 << 60), "before": (-(1 << 62), 1 << 60),
    }  # fmt: skip
    made = {name: unknown(name, low, high) for name, (low, high) in ranges.items()}
    word = z3.BitVec("word", 64)
    payload = {
        "word": word,
        "a": z3.SignExt(48, z3.Extract(15, 0, word)),
        "b": z3.SignExt(48, z3.Extract(31, 16, word)),
        "c": z3.SignExt(48, z3.Extract(47, 32, word)),
        "counter": z3.ZeroExt(56, z3.Extract(55, 48, word)),
        "crc": z3.ZeroExt(56, z3.Extract(63, 56, word)),
    }
    names = {name: number for name, (number, _) in made.items()} | {name: Number(x) for name, x in payload.items()}
    u = Unknowns(names, tuple(c for _, c in made.values()))
    return Unknowns(u.names, (*u.assume, memory_holds(u), u.now >= u.before))


def memory_holds(u: Any) -> Any:
    """What is true of the gate's memory at any time: the invariant of the induction."""
    return z3.And(
        z3.Implies(u.last >= 0, u.next == (u.last + 1) & 0xFF),
        z3.Implies(u.known == 1, z3.And(u.was_a <= u.maximum, u.was_b <= u.maximum, u.was_c <= u.maximum)),
        z3.And(u.was_a >= 0, u.was_b >= 0, u.was_c >= 0),
    )


def judge(u: Unknowns, old: str = "", new: str = "") -> Any:
    """A call of the shipped ``judge_drive`` on unknowns; returns its answer and the gate's memory afterwards.

    In place of ``crc_of`` stands the standard's CRC, which it is (``test_smt_crc.py``).
    """
    n = u.names
    function = rebuilt(gate_rules.judge_drive, {"crc_of": lambda start, word: Number(crc_term(u, DRIVE_ID))}, old, new)
    settled = CONFIG.record[0]

    def call() -> tuple[Any, Any]:
        config = {name: settled[name] for name in settled.dtype.names}
        config |= {"count_max": n["maximum"], "count_slew_max": n["slew"], "spacing_us": n["spacing"]}
        memory = {
            "count": [n["was_a"], n["was_b"], n["was_c"]], "time_us": n["before"], "counter": n["last"],
            "counter_next": n["next"], "syncs": n["syncs"], "known": n["known"], "latched": 0,
        }  # fmt: skip
        return function(config, memory, 8, n["word"], n["row"], n["now"]), memory

    return call


def is_voltage(u: Unknowns) -> Any:
    return z3.Or(u.a != 0, u.b != 0, u.c != 0)


def crc_term(u: Unknowns, can_id: int) -> Any:
    """The CRC of the frame by the standard's words (``test_smt_crc``: the bits of a payload count one by one)."""
    tables = reference_tables(can_id)
    terms = [table[u.names[name]].z for table, name in zip(tables, ("a", "b", "c", "counter"), strict=True)]
    return terms[0] ^ terms[1] ^ terms[2] ^ terms[3] ^ crc8h2f(can_id.to_bytes(2, "little") + bytes(7))


def within(new: Any, old: Any, slew: Any) -> Any:
    return z3.And(new - old <= slew, old - new <= slew)


# What follows for a frame that passes. Each is a term over the unknowns and the memory afterwards.
PROPERTIES = {
    "voltage": lambda u, g: z3.And(*(z3.And(x >= 0, x <= u.maximum) for x in (u.a, u.b, u.c))),
    "slew": lambda u, g: z3.Implies(
        is_voltage(u),
        z3.And(u.known == 1, within(u.a, u.was_a, u.slew), within(u.b, u.was_b, u.slew), within(u.c, u.was_c, u.slew)),
    ),
    "one voltage a SYNC": lambda u, g: z3.Implies(is_voltage(u), u.syncs == 1),
    "spacing": lambda u, g: z3.Implies(is_voltage(u), u.now - u.before >= u.spacing),
    "freshness": lambda u, g: z3.And(
        u.counter != u.last, z3.Implies(z3.And(is_voltage(u), u.last >= 0), u.counter == (u.last + 1) & 0xFF)
    ),
    "mode": lambda u, g: u.row & z3.If(is_voltage(u), of(FrameKind.DRIVE), of(FrameKind.DRIVE_ZERO)) != 0,
    "CRC": lambda u, g: u.crc == crc_term(u, DRIVE_ID),
    "remembered": lambda u, g: z3.And(
        *(of(now) == x for now, x in zip(g["count"], (u.a, u.b, u.c), strict=True)),
        of(g["counter"]) == u.counter,
        of(g["counter_next"]) == (u.counter + 1) & 0xFF,
        of(g["time_us"]) == u.now,
        of(g["syncs"]) == 0,
    ),
    "known after": lambda u, g: z3.Implies(
        z3.And(of(g["known"]) == 1, u.last >= 0), z3.Or(is_voltage(u), u.counter == (u.last + 1) & 0xFF)
    ),
}


def prove_property(name: str, old: str = "", new: str = "") -> int:
    """Proves one property on every path; returns how many there are."""
    u, count = unknowns(), 0
    for path in paths(judge(u, old, new), list(u.assume)):
        answer, gate = path.result
        count += 1
        if answer == 0:
            prove(path.condition, PROPERTIES[name](u, gate), name)
    return count


@pytest.mark.parametrize("name", PROPERTIES)
def test_whatever_passes(name: str) -> None:
    assert prove_property(name) > 20


def test_the_memory_is_what_the_induction_needs_after_any_drive_frame() -> None:
    """The step of the induction for a frame that passes; one that doesn't changes nothing of the memory."""
    u = unknowns()
    for path in paths(judge(u), list(u.assume)):
        answer, gate = path.result
        after = SimpleNamespace(
            last=of(gate["counter"]), next=of(gate["counter_next"]), maximum=u.maximum, known=of(gate["known"]),
            was_a=of(gate["count"][0]), was_b=of(gate["count"][1]), was_c=of(gate["count"][2]),
        )  # fmt: skip
        prove(path.condition, memory_holds(after), "the invariant of the memory")
        if answer != 0:
            same = [
                (gate["count"][0], u.was_a),
                (gate["counter"], u.last),
                (gate["time_us"], u.before),
                (gate["syncs"], u.syncs),
                (gate["known"], u.known),
            ]
            prove(path.condition, z3.And(*(of(x) == y for x, y in same)), "a frame that is held back leaves no trace")


def test_no_sum_or_look_up_goes_beyond_its_bounds() -> None:
    u, claims = unknowns(), 0
    for path in paths(judge(u), list(u.assume)):
        if path.claims:
            prove(path.condition, z3.And(*path.claims), "no overflow, no index out of range")
            claims += len(path.claims)
    assert claims > 100


def remembering() -> TransmitGate:
    """A gate whose memory no rule has to explain."""
    gate = TransmitGate(CONFIG)
    record = gate.memory[0]
    record["known"], record["count"], record["counter"], record["counter_next"] = 1, (5, 6, 7), 9, 10
    return gate


def remembered(gate: TransmitGate) -> tuple[object, ...]:
    record = gate.memory[0]
    return int(record["known"]), tuple(record["count"].tolist()), int(record["counter"]), int(record["counter_next"])


def test_the_induction_begins_and_no_other_frame_breaks_it() -> None:
    """At the start nothing is known; SYNC only counts, NMT makes the combs unknown, everything else changes nothing."""
    assert remembered(TransmitGate(CONFIG))[:3] == (0, (0, 0, 0), -1)
    for mode in Mode:
        gate = remembering()
        for expected in (1, 2, 2):
            assert gate.check(Frame(0x080, b"\x01"), mode, 0) is None
            assert gate.memory["syncs"] == expected
        assert remembered(gate) == (1, (5, 6, 7), 9, 10)
        for command, kind in (
            (1, FrameKind.NMT_START),
            (2, FrameKind.NMT_STOP),
            (128, FrameKind.NMT_PRE_OPERATIONAL),
            (129, FrameKind.NMT_RESET),
        ):
            gate = remembering()
            passed = gate.check(Frame(0x000, bytes((command, CONFIG.node_id))), mode, 0) is None
            assert passed == bool(PERMITTED[mode] & kind)
            counter = -1 if passed and command == 129 else 9
            assert remembered(gate) == (int(not passed), (5, 6, 7), counter, 10)
        gate = remembering()
        gate.clear()
        assert remembered(gate) == (1, (5, 6, 7), 9, 10)


PLANTED = [
    ("voltage", "0 <= c <= maximum", "c <= maximum"),
    ("voltage", "0 <= a <= maximum", "0 <= a <= maximum + 1"),
    ("voltage", "0 <= b <= maximum and ", ""),
    ("slew", "-slew <= b - was[1] <= slew", "-slew <= b - was[0] <= slew"),
    ("slew", "c - was[2] <= slew)", "c - was[2] <= slew + 1)"),
    ("slew", 'memory["known"] == 0 or memory["syncs"] == 2', 'memory["syncs"] == 2'),
    ("slew", "a == 0 and b == 0 and c == 0", "a == 0 and b == 0"),
    ("one voltage a SYNC", 'if memory["syncs"] == 0:', 'if memory["syncs"] < 0:'),
    ("one voltage a SYNC", 'or memory["syncs"] == 2', ""),
    ("spacing", '        if since_us < config["spacing_us"]:', "        if since_us < 0:"),
    ("freshness", 'counter == memory["counter"]:', 'counter == memory["counter_next"]:'),
    ("freshness", 'counter != memory["counter_next"]:', 'counter == memory["counter"]:'),
    ("mode", "if permitted & _DRIVE == 0:", "if permitted == 0:"),
    ("CRC", "word >> 56 & 0xFF != crc_of", "word >> 56 & 0x7F != crc_of"),
    ("CRC", "    if protected:\n        if word", "    if protected and not known:\n        if word"),
    ("remembered", "was[0], was[1], was[2] = a, b, c", "was[0], was[1], was[2] = a, b, b"),
    ("remembered", "counter + 1 & 0xFF", "counter + 1 & 0x7F"),
    ("known after", 'or counter == memory["counter_next"]', 'or counter != memory["counter"]'),
]  # fmt: skip


@pytest.mark.parametrize(("name", "old", "new"), PLANTED)
def test_each_proof_fails_for_a_planted_defect(name: str, old: str, new: str) -> None:
    with pytest.raises(DisprovedError, match=name):
        prove_property(name, old, new)


def test_every_property_has_a_planted_defect() -> None:
    assert {name for name, _, _ in PLANTED} == set(PROPERTIES)
