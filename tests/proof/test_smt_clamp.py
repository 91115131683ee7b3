"""The allocation's last clamp and the node's own, proven: whatever was computed, a count keeps to its limits."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import z3
from symbolic import DisprovedError, Number, Truth, of, paths, prove, rebuilt, truth, unknown

from hil.node.amplifier import AmplifierNode
from pkxyz_ctrl.core import voltage


class Anything:
    """A voltage of which nothing is known: any number, infinite or not a number. Comparisons go either way."""

    seen = 0

    def _new(self, *_: Any) -> "Anything":
        return self

    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = __truediv__ = __rtruediv__ = __neg__ = _new

    def _either(self, other: Any) -> Truth:
        Anything.seen += 1
        return Truth(z3.Bool(f"either_{Anything.seen}"))

    __lt__ = __le__ = __gt__ = __ge__ = _either

    def __eq__(self, other: object) -> Truth:  # type: ignore[override]
        return self._either(other)

    def __ne__(self, other: object) -> Truth:  # type: ignore[override]
        return self._either(other)

    __hash__ = None  # type: ignore[assignment]


def smallest(first: Any, second: Any) -> Any:
    """``min`` of unknowns, as Python words it: the first unless a later one is less."""
    return second if second < first else first


def largest(first: Any, second: Any) -> Any:
    return second if second > first else first


def prove_clamp(old: str = "", new: str = "") -> int:
    """``counts_for_forces``: force, gain, scale and carry may be anything at all, the last count is a permitted one."""
    (last, is_last), (slew, is_slew), (most, is_most) = (
        unknown(name, low, 32767) for name, low in (("last", 0), ("slew", 1), ("most", 0))
    )
    assume = [is_last, is_slew, is_most, last.z <= most.z]
    wholes = [0]

    def whole(value: Any) -> Number:
        wholes[0] += 1
        return Number(z3.BitVec(f"whole_{wholes[0]}", 64))  # any integer: what is left of what is not known

    replaced = {
        "math": SimpleNamespace(sqrt=lambda x: Anything()), "np": SimpleNamespace(int32=whole, void=np.void),
        "min": smallest, "max": largest, "range": lambda n: [0],
    }  # fmt: skip
    function = rebuilt(voltage.counts_for_forces, replaced, old, new)
    proven = 0

    def call() -> list[Any]:
        wholes[0] = Anything.seen = 0
        drive = {
            "count_slew_max": slew,
            "count_max": most,
            "volt_per_count": Anything(),
            "force_gain_n_per_v2": [Anything()],
            "noise_shaping": Number(z3.BitVec("shaping", 64)),
        }
        count: list[Any] = [None]
        function(drive, [Anything()], [last], [Anything()], count)
        return count

    for path in paths(call, assume):
        count = of(path.result[0])
        claim = z3.And(count >= 0, count <= most.z, count - last.z <= slew.z, last.z - count <= slew.z)
        prove(path.condition, z3.And(claim, *path.claims), "the clamp")
        proven += 1
    return proven


@pytest.mark.slow
def test_whatever_the_forces_are_a_count_keeps_to_voltage_and_slew() -> None:
    assert prove_clamp() > 4


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("min(max(nearest, low), high)", "max(nearest, low)"),
        ("min(max(nearest, low), high)", "min(nearest, high)"),
        ("min(most, count_last[i] + slew)", "count_last[i] + slew"),
        ("max(0, count_last[i] - slew)", "count_last[i] - slew"),
        ("max(0, count_last[i] - slew)", "0"),
    ],
)
def test_the_clamp_s_proof_fails_for_a_planted_defect(old: str, new: str) -> None:
    with pytest.raises(DisprovedError, match="the clamp"):
        prove_clamp(old, new)


def test_a_number_that_is_none_stays_within_the_limits_too() -> None:
    """What the proof takes a conversion for is an integer: a voltage that is not a number never gets as far."""
    drive = np.zeros(1, voltage.DRIVE)
    drive["force_gain_n_per_v2"], drive["volt_per_count"] = 1e-8, 200 / 32767
    drive["count_max"], drive["count_slew_max"], drive["noise_shaping"] = 30000, 1000, 1
    for force in (math.nan, math.inf, -math.inf, 0.0, 1e300, -1.0, 5e-324):
        count = np.zeros(3, np.int32)
        last = np.array([0, 500, 30000], np.int32)
        voltage.counts_for_forces(drive[0], np.full(3, force), last, np.zeros(3), count)
        assert (count >= 0).all()
        assert (count <= 30000).all()
        assert (abs(count - last) <= 1000).all()


# -- the node's own limit of a step --------------------------------------------------------------------------


def prove_step(claim: str, old: str = "", new: str = "") -> int:
    """``AmplifierNode._apply`` with unknown counts, outputs and limit: a step beyond it goes to 0 V instead."""
    names = ("a", "b", "c", "was_a", "was_b", "was_c", "step")
    made = {name: unknown(name, 0, 32767) for name in names}
    n = {name: number for name, (number, _) in made.items()}
    apply = rebuilt(AmplifierNode._apply, {}, old, new)
    paths_seen = 0

    def call() -> Any:
        node = SimpleNamespace(
            outputs=(n["was_a"], n["was_b"], n["was_c"]), _step_max=n["step"], _silent_syncs=0, driven=None
        )
        node._drive_errors = SimpleNamespace(bad=lambda *a: None)
        node._drive = SimpleNamespace(pending=())
        node._drive_deadline = SimpleNamespace(set=lambda t: setattr(node, "watched", True), cancel=lambda: None)
        node._drive_timeout_us, node.watched = 0, False
        node._release_combs = lambda *a: setattr(node, "driven", (0, 0, 0))
        node._outputs_to_error_value = lambda *a: setattr(node, "driven", (0, 0, 0))
        taken = apply(node, (n["a"], n["b"], n["c"]), 0)
        node.driven = node.driven if taken is None else taken
        return node

    for path in paths(call, [condition for _, condition in made.values()]):
        node = path.result
        driven = [of(x) for x in node.driven]
        was = [n[name].z for name in ("was_a", "was_b", "was_c")]
        step = n["step"].z
        near = z3.And(*(z3.And(x - y <= step, y - x <= step) for x, y in zip(driven, was, strict=True)))
        energised = z3.Or(*(x != 0 for x in driven))
        holds = {
            "step": z3.Implies(energised, near),
            "obeys": z3.Implies(
                z3.And(*(z3.And(n[x].z - y <= step, y - n[x].z <= step) for x, y in zip("abc", was, strict=True))),
                z3.And(*(x == n[name].z for x, name in zip(driven, "abc", strict=True))),
            ),
            "watched": z3.Implies(energised, truth(node.watched)),
        }
        prove(path.condition, z3.And(holds[claim], *path.claims), claim)
        paths_seen += 1
    return paths_seen


@pytest.mark.parametrize("claim", ["step", "obeys", "watched"])
def test_the_node_makes_no_step_beyond_its_limit_but_to_0_v(claim: str) -> None:
    assert prove_step(claim) > 4


@pytest.mark.parametrize(
    ("claim", "old", "new"),
    [
        ("step", "-step <= c - was_c <= step", "c - was_c <= step"),
        ("step", "if a or b or c:", "if a or b:"),
        ("obeys", "-step <= a - was_a <= step", "-step < a - was_a < step"),
        ("watched", "self._drive_deadline.set(t_us + self._drive_timeout_us)", "pass"),
    ],
)
def test_the_step_s_proof_fails_for_a_planted_defect(claim: str, old: str, new: str) -> None:
    with pytest.raises(DisprovedError, match=claim):
        prove_step(claim, old, new)
