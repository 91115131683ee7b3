"""RPDO 1 at the gate, proven for all payloads, modes and histories; no such frame touches what voltages rest on.

``gate_rules.judge_outputs`` runs with unknowns, as ``test_smt_gate`` has ``judge_drive``.
"""

from typing import Any

import pytest
import z3
from symbolic import DisprovedError, Number, of, paths, prove, rebuilt, unknown

from pkxyz_ctrl.safety import gate_rules
from pkxyz_ctrl.safety.gate_rules import ALWAYS, OUTPUT_BITS, FrameKind

VOLTAGES = ("count", "counter", "counter_next", "known", "syncs", "time_us")


def judged(old: str = "", new: str = "") -> list[tuple[Any, Any, dict[str, Any], dict[str, Any]]]:
    """For each path its condition, the answer, the memory afterwards, and the unknowns."""
    names = {"row": (0, 2047), "due": (0, 1), "latched": (0, 1 << 17), "length": (0, 64)}
    made = {name: unknown(name, low, high) for name, (low, high) in names.items()}
    n = {name: number for name, (number, _) in made.items()} | {"word": Number(z3.BitVec("word", 64))}
    function = rebuilt(gate_rules.judge_outputs, {}, old, new)

    def call() -> tuple[Any, Any]:
        untouched = {name: f"before: {name}" for name in VOLTAGES}
        memory = {"output_due": n["due"], "latched": n["latched"], **untouched}
        return function(memory, n["length"], n["word"], n["row"]), memory

    assume = [c for _, c in made.values()]
    return [(path.condition, *path.result, n) for path in paths(call, assume)]


# What follows for a frame that passes.
PROPERTIES = {
    "length": lambda n, after: n["length"].z == 1,
    "bits": lambda n, after: n["word"].z & 0xFF & ~OUTPUT_BITS == 0,
    "mode": lambda n, after: n["row"].z & int(FrameKind.OUTPUTS) != 0,
    "one a SYNC": lambda n, after: z3.And(n["due"].z == 1, of(after["output_due"]) == 0),
}


def prove_property(name: str, old: str = "", new: str = "") -> int:
    passed = 0
    for condition, answer, after, n in judged(old, new):
        if answer == 0:
            passed += 1
            prove(condition, PROPERTIES[name](n, after), name)
        assert all(after[field] == f"before: {field}" for field in VOLTAGES), "nothing that voltages rest on"
    return passed


@pytest.mark.parametrize("name", PROPERTIES)
def test_whatever_passes(name: str) -> None:
    assert prove_property(name) > 0


def test_a_frame_that_is_held_back_leaves_no_trace() -> None:
    held_back = [(c, after, n) for c, answer, after, n in judged() if answer != 0]
    assert len(held_back) >= 4
    for condition, after, n in held_back:
        prove(condition, of(after["output_due"]) == n["due"].z, "no trace")


def test_it_is_none_of_those_that_always_pass() -> None:
    assert not ALWAYS & FrameKind.OUTPUTS


PLANTED = [
    ("length", "length != 1", "length > 1"),
    ("bits", "word & 0xFF & ~OUTPUT_BITS != 0", "word & 0xFF > 0x3F"),
    ("mode", "permitted & _OUTPUTS == 0", "permitted == 0"),
    ("one a SYNC", 'memory["output_due"] = 0', 'memory["output_due"] = 1'),
    ("one a SYNC", 'if memory["output_due"] == 0', 'if memory["output_due"] < 0'),
]


@pytest.mark.parametrize(("name", "old", "new"), PLANTED)
def test_each_proof_fails_for_a_planted_defect(name: str, old: str, new: str) -> None:
    with pytest.raises(DisprovedError, match=name):
        prove_property(name, old, new)
