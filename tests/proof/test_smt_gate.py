"""The transmit gate's arithmetic, proven: for all 16-bit counts, counters, limits and times, and for all histories.

``TransmitGate._judge_drive`` runs with unknowns (``symbolic``): every count of 16 bits, every counter, CRC, time,
limit, and every state that its memory can be in. What is to hold of all histories is shown by induction: it holds at
the beginning, and whatever frame comes, it holds afterwards if it held before.
"""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest
import z3
from gate_frames import crc8h2f
from symbolic import DisprovedError, LinearTable, Number, Truth, of, paths, prove, rebuilt, truth, unknown
from test_smt_crc import reference_tables

from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.safety import gate as gate_module
from pkxyz_ctrl.safety.gate import PERMITTED, FrameKind, GateConfig, TransmitGate
from pkxyz_ctrl.safety.modes import Mode

CONFIG = GateConfig(count_max=20000, count_slew_max=1000, period_us=200)
TABLES = {name: LinearTable(getattr(gate_module, name)) for name in ("_CRC", "_CRC_1", "_CRC_2", "_CRC_3")}
KNOWN = z3.Bool("known")


@dataclass(frozen=True)
class Unknowns:
    """A frame, the gate's memory and its limits, none of them known; ``assume`` says what each may be."""

    names: dict[str, Number]
    assume: tuple[Any, ...]

    def __getattr__(self, name: str) -> Any:
        return self.names[name].z


def unknowns() -> Unknowns:
    ranges = {
        "a": (-32768, 32767), "b": (-32768, 32767), "c": (-32768, 32767), "counter": (0, 255), "crc": (0, 255),
        "was_a": (0, 32767), "was_b": (0, 32767), "was_c": (0, 32767),
        "last": (-1, 255), "next": (0, 255), "syncs": (0, 2), "row": (0, 1023),
        "maximum": (0, 32767), "slew": (1, 32767), "spacing": (0, 1_000_000),
        "now": (0, 1 << 60), "before": (-(1 << 62), 1 << 60),
    }  # fmt: skip
    made = {name: unknown(name, low, high) for name, (low, high) in ranges.items()}
    u = Unknowns({name: number for name, (number, _) in made.items()}, tuple(c for _, c in made.values()))
    return Unknowns(u.names, (*u.assume, memory_holds(u), u.now >= u.before))


def memory_holds(u: Any) -> Any:
    """What is true of the gate's memory at any time: the invariant of the induction."""
    return z3.And(
        z3.Implies(u.last >= 0, u.next == (u.last + 1) & 0xFF),
        z3.Implies(KNOWN, z3.And(u.was_a <= u.maximum, u.was_b <= u.maximum, u.was_c <= u.maximum)),
        z3.And(u.was_a >= 0, u.was_b >= 0, u.was_c >= 0),
    )


def judge(u: Unknowns, old: str = "", new: str = "") -> Any:
    """A call of the shipped ``_judge_drive`` on unknowns; returns its answer and the gate's memory afterwards."""
    n = u.names
    frame = [n[name] for name in ("a", "b", "c", "counter", "crc")]
    function = rebuilt(TransmitGate._judge_drive, TABLES | {"_PROTECTED": lambda data: frame}, old, new)
    real = TransmitGate(CONFIG)

    def call() -> tuple[Any, Any]:
        gate = SimpleNamespace(**vars(real))
        gate._counts = (n["was_a"], n["was_b"], n["was_c"])
        gate._time_us, gate._counter, gate._counter_next = n["before"], n["last"], n["next"]
        gate._syncs, gate._known, gate.latched = n["syncs"], Truth(KNOWN), ""
        gate._count_max, gate._count_slew_max, gate._spacing_us = n["maximum"], n["slew"], n["spacing"]
        gate._too_soon = lambda t_us: "too soon"
        return function(gate, bytes(8), n["row"], n["now"]), gate

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
        z3.And(KNOWN, within(u.a, u.was_a, u.slew), within(u.b, u.was_b, u.slew), within(u.c, u.was_c, u.slew)),
    ),
    "one voltage a SYNC": lambda u, g: z3.Implies(is_voltage(u), u.syncs == 1),
    "spacing": lambda u, g: z3.Implies(is_voltage(u), u.now - u.before >= u.spacing),
    "freshness": lambda u, g: z3.And(
        u.counter != u.last, z3.Implies(z3.And(is_voltage(u), u.last >= 0), u.counter == (u.last + 1) & 0xFF)
    ),
    "mode": lambda u, g: u.row & z3.If(is_voltage(u), of(FrameKind.DRIVE), of(FrameKind.DRIVE_ZERO)) != 0,
    "CRC": lambda u, g: u.crc == crc_term(u, 0x300 + CONFIG.node_id),
    "remembered": lambda u, g: z3.And(
        *(of(now) == x for now, x in zip(g._counts, (u.a, u.b, u.c), strict=True)),
        of(g._counter) == u.counter,
        of(g._counter_next) == (u.counter + 1) & 0xFF,
        of(g._time_us) == u.now,
        of(g._syncs) == 0,
    ),
    "known after": lambda u, g: z3.Implies(
        z3.And(truth(g._known), u.last >= 0), z3.Or(is_voltage(u), u.counter == (u.last + 1) & 0xFF)
    ),
}


def prove_property(name: str, old: str = "", new: str = "") -> int:
    """Proves one property on every path; returns how many there are."""
    u, count = unknowns(), 0
    for path in paths(judge(u, old, new), list(u.assume)):
        answer, gate = path.result
        count += 1
        if answer is None:
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
            last=of(gate._counter), next=of(gate._counter_next), maximum=u.maximum,
            was_a=of(gate._counts[0]), was_b=of(gate._counts[1]), was_c=of(gate._counts[2]),
        )  # fmt: skip
        holds = z3.substitute(memory_holds(after), (KNOWN, truth(gate._known)))
        prove(path.condition, holds, "the invariant of the memory")
        if answer is not None:
            same = [
                (gate._counts[0], u.was_a),
                (gate._counter, u.last),
                (gate._time_us, u.before),
                (gate._syncs, u.syncs),
            ]
            prove(path.condition, z3.And(*(of(x) == y for x, y in same)), "a frame that is held back leaves no trace")


def test_no_sum_or_look_up_goes_beyond_its_bounds() -> None:
    u, claims = unknowns(), 0
    for path in paths(judge(u), list(u.assume)):
        if path.claims:
            prove(path.condition, z3.And(*path.claims), "no overflow, no index out of range")
            claims += len(path.claims)
    assert claims > 100


def test_the_induction_begins_and_no_other_frame_breaks_it() -> None:
    """At the start nothing is known; SYNC only counts, NMT makes the combs unknown, everything else changes nothing."""
    new = TransmitGate(CONFIG)
    assert not new._known
    assert new._counts == (0, 0, 0)
    assert new._counter == -1
    for mode in Mode:
        gate = TransmitGate(CONFIG)
        gate._known, gate._counts, gate._counter, gate._counter_next = True, (5, 6, 7), 9, 10
        for expected in (1, 2, 2):
            assert gate.check(Frame(0x080, b"\x01"), mode, 0) is None
            assert gate._syncs == expected
        assert (gate._known, gate._counts, gate._counter, gate._counter_next) == (True, (5, 6, 7), 9, 10)
        for command, kind in (
            (1, FrameKind.NMT_START),
            (2, FrameKind.NMT_STOP),
            (128, FrameKind.NMT_PRE_OPERATIONAL),
            (129, FrameKind.NMT_RESET),
        ):
            gate = TransmitGate(CONFIG)
            gate._known, gate._counts, gate._counter, gate._counter_next = True, (5, 6, 7), 9, 10
            passed = gate.check(Frame(0x000, bytes((command, CONFIG.node_id))), mode, 0) is None
            assert passed == bool(PERMITTED[mode] & kind)
            assert gate._known == (not passed)
            assert gate._counts == (5, 6, 7)
            assert gate._counter == (-1 if passed and command == 129 else 9)
        gate = TransmitGate(CONFIG)
        gate._known, gate._counts, gate._counter, gate._counter_next = True, (5, 6, 7), 9, 10
        gate.clear()
        assert (gate._known, gate._counts, gate._counter, gate._counter_next) == (True, (5, 6, 7), 9, 10)


PLANTED = [
    ("voltage", "0 <= c <= maximum", "c <= maximum"),
    ("voltage", "0 <= a <= maximum", "0 <= a <= maximum + 1"),
    ("voltage", "0 <= b <= maximum and ", ""),
    ("slew", "-slew <= b - was_b <= slew", "-slew <= b - was_a <= slew"),
    ("slew", "c - was_c <= slew)", "c - was_c <= slew + 1)"),
    ("slew", "not self._known or self._syncs == 2", "self._syncs == 2"),
    ("slew", "a == b == c == 0", "a == b == 0"),
    ("one voltage a SYNC", "if self._syncs == 0:", "if self._syncs < 0:"),
    ("one voltage a SYNC", "or self._syncs == 2", ""),
    ("spacing", "if t_us - self._time_us < self._spacing_us:", "if t_us - self._time_us < 0:"),
    ("freshness", "if protected and counter == self._counter:", "if protected and counter == self._counter_next:"),
    ("freshness", "if protected and counter != self._counter_next:", "if protected and counter == self._counter:"),
    ("mode", "if not row & _DRIVE:", "if not row:"),
    ("CRC", "^ _CRC[counter]", ""),
    ("CRC", "_CRC_2[b]", "_CRC_3[b]"),
    ("remembered", "self._counts = (a, b, c)", "self._counts = (a, b, b)"),
    ("remembered", "counter + 1 & 0xFF", "counter + 1 & 0x7F"),
    ("known after", "or counter == self._counter_next", "or counter != self._counter"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "old", "new"), PLANTED)
def test_each_proof_fails_for_a_planted_defect(name: str, old: str, new: str) -> None:
    with pytest.raises(DisprovedError, match=name):
        prove_property(name, old, new)


def test_every_property_has_a_planted_defect() -> None:
    assert {name for name, _, _ in PLANTED} == set(PROPERTIES)
