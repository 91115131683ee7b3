"""Shipped functions run with unknowns in place of numbers: every path through them, and what holds on each.

`paths` calls a function again and again. Where it asks whether an unknown is true, one answer that is possible is
taken, and the other the next time; so it ends with every path, each with the condition under which it is taken. The
formulas that z3 gets are those that the function's own text makes, with nothing written a second time.

Python's integers have no width, z3's bit vectors have 64 bits here: each sum, difference and product adds the claim
that it does not overflow to the claims of its path, and the proofs show these, too.
"""

import inspect
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from types import FunctionType
from typing import Any

import z3

WIDTH = 64
SECONDS = 600  # by the clock, and machines are busy; the longest takes half a minute of an idle core


@dataclass
class _Run:
    """One way through: the answers given so far, and what they are conditions of."""

    solver: z3.Solver
    answers: list[bool]
    asked: int = 0
    open: list[bool] = field(default_factory=list)  # whether the other answer was possible, too
    claims: list[Any] = field(default_factory=list)


_run: list[_Run] = []


def _ask(condition: Any) -> bool:
    run = _run[-1]
    condition = z3.simplify(condition)
    if z3.is_true(condition) or z3.is_false(condition):
        return bool(z3.is_true(condition))
    if run.asked < len(run.answers):
        answer = run.answers[run.asked]
    else:
        can_be = run.solver.check(condition) == z3.sat
        can_fail = run.solver.check(z3.Not(condition)) == z3.sat
        answer = can_be
        run.answers.append(answer)
        run.open.append(can_be and can_fail)
    run.asked += 1
    run.solver.add(condition if answer else z3.Not(condition))
    return answer


class Truth:
    """An unknown truth value."""

    def __init__(self, expression: Any) -> None:
        self.z = expression

    def __bool__(self) -> bool:
        return _ask(self.z)

    def __format__(self, spec: str) -> str:
        return "?"


class Number:
    """An unknown integer."""

    __hash__ = None  # type: ignore[assignment]

    def __init__(self, expression: Any) -> None:
        self.z = expression

    def __bool__(self) -> bool:
        return _ask(self.z != 0)

    def __format__(self, spec: str) -> str:
        return "?"

    def __add__(self, other: Any) -> "Number":
        b = of(other)
        _claim(z3.BVAddNoOverflow(self.z, b, True), z3.BVAddNoUnderflow(self.z, b))
        return Number(self.z + b)

    __radd__ = __add__

    def __sub__(self, other: Any) -> "Number":
        b = of(other)
        _claim(z3.BVSubNoOverflow(self.z, b), z3.BVSubNoUnderflow(self.z, b, True))
        return Number(self.z - b)

    def __rsub__(self, other: Any) -> "Number":
        return Number(of(other)) - self

    def __neg__(self) -> "Number":
        return Number(of(0)) - self

    def __abs__(self) -> "Number":
        return Number(z3.If(self.z < 0, -self.z, self.z))

    def __and__(self, other: Any) -> "Number":
        return Number(self.z & of(other))

    __rand__ = __and__

    def __or__(self, other: Any) -> "Number":
        return Number(self.z | of(other))

    __ror__ = __or__

    def __xor__(self, other: Any) -> "Number":
        return Number(self.z ^ of(other))

    __rxor__ = __xor__

    def __rshift__(self, other: int) -> "Number":
        return Number(self.z >> other)

    def __lt__(self, other: Any) -> Truth:
        return Truth(self.z < of(other))

    def __le__(self, other: Any) -> Truth:
        return Truth(self.z <= of(other))

    def __gt__(self, other: Any) -> Truth:
        return Truth(self.z > of(other))

    def __ge__(self, other: Any) -> Truth:
        return Truth(self.z >= of(other))

    def __eq__(self, other: object) -> Truth:  # type: ignore[override]
        return Truth(self.z == of(other))

    def __ne__(self, other: object) -> Truth:  # type: ignore[override]
        return Truth(self.z != of(other))


def of(value: Any) -> Any:
    """The z3 term of a number, known or not."""
    if isinstance(value, Number):
        return value.z
    if isinstance(value, Truth):
        return z3.If(value.z, z3.BitVecVal(1, WIDTH), z3.BitVecVal(0, WIDTH))
    return z3.BitVecVal(int(value), WIDTH)


def truth(value: Any) -> Any:
    """The z3 term of what a function leaves as a truth value."""
    return value.z if isinstance(value, Truth) else z3.BoolVal(bool(value))


def unknown(name: str, low: int, high: int) -> tuple[Number, Any]:
    """An integer in low..high, and the condition that says so."""
    term = z3.BitVec(name, WIDTH)
    return Number(term), z3.And(term >= low, term <= high)


def _claim(*claims: Any) -> None:
    if _run:
        _run[-1].claims += [z3.simplify(claim) for claim in claims]


class LinearTable:
    """A table over GF(2), looked up with an unknown index: the exclusive or of the entries of its bits.

    That the table is linear (but for a constant, its entry 0) is looked at for every entry when it is made. A negative
    index means the two's complement, as Python's does for a table of 65536 entries.
    """

    def __init__(self, table: bytes) -> None:
        self.table, self.size = table, len(table)
        self.bits = (self.size - 1).bit_length()
        constant = table[0]
        for index in range(1, self.size):
            low = index & -index
            assert table[index] == table[index ^ low] ^ table[low] ^ constant, "this table is not linear"

    def __len__(self) -> int:
        return self.size

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, Bits):
            return index.through(self)
        if not isinstance(index, Number):
            return self.table[index]
        _claim(z3.And(index.z >= -self.size, index.z < self.size))
        found = z3.BitVecVal(self.table[0], WIDTH)
        for bit in range(self.bits):
            entry = z3.BitVecVal(self.table[1 << bit] ^ self.table[0], WIDTH)
            found = found ^ z3.If(z3.Extract(bit, bit, index.z) == 1, entry, z3.BitVecVal(0, WIDTH))
        return Number(found)


class Bits:
    """An integer whose bits are sums over GF(2) of unknown bits: bit k is the parity of the unknowns in ``of[k]``, of
    which bit 64 is the constant 1. What is computed by shifts, masks, exclusive or and linear tables is known exactly.
    """

    ONE = 1 << 64

    def __init__(self, of: tuple[int, ...]) -> None:
        self.of = of

    @classmethod
    def unknown(cls, width: int = 64, first: int = 0) -> "Bits":
        return cls(tuple(1 << first + k for k in range(width)))

    @classmethod
    def known(cls, value: int) -> "Bits":
        value = int(value)
        return cls(tuple(cls.ONE if value >> k & 1 else 0 for k in range(value.bit_length())))

    def __rshift__(self, by: int) -> "Bits":
        return Bits(self.of[by:])

    def __lshift__(self, by: int) -> "Bits":
        return Bits((0,) * by + self.of)

    def __or__(self, other: "Bits") -> "Bits":
        """Of what has no place in common: it would be no sum."""
        assert not any(a and b for a, b in zip(self.of, other.of, strict=False))
        return self ^ other

    def __and__(self, mask: int) -> "Bits":
        return Bits(tuple(bit if mask >> k & 1 else 0 for k, bit in enumerate(self.of[: mask.bit_length()])))

    def __xor__(self, other: "Bits | int") -> "Bits":
        one, two = self.of, (other if isinstance(other, Bits) else Bits.known(other)).of
        width = max(len(one), len(two))
        one, two = one + (0,) * (width - len(one)), two + (0,) * (width - len(two))
        return Bits(tuple(a ^ b for a, b in zip(one, two, strict=True)))

    __rxor__ = __xor__

    def through(self, table: LinearTable) -> "Bits":
        """The entry of a table at this index."""
        found = Bits.known(table.table[0])
        for k, bit in enumerate(self.of):
            added = table.table[1 << k] ^ table.table[0]
            found ^= Bits(tuple(bit if added >> place & 1 else 0 for place in range(8)))
        return found

    def of_width(self, width: int) -> tuple[int, ...]:
        """Its bits, the lowest first."""
        assert not any(self.of[width:])
        return (self.of + (0,) * width)[:width]


@dataclass(frozen=True)
class Path:
    """``condition`` under which ``result`` comes about; ``claims`` that must hold on the way."""

    condition: Any
    result: Any
    claims: tuple[Any, ...]


def paths(call: Callable[[], Any], assume: list[Any]) -> Iterator[Path]:
    """Every way through ``call`` that the assumptions leave open. ``call`` makes its own objects each time."""
    answers: list[bool] = []
    opened: list[bool] = []
    while True:
        solver = z3.SolverFor("QF_BV")
        solver.add(*assume)
        run = _Run(solver, answers, open=opened)
        _run.append(run)
        try:
            result = call()
        finally:
            _run.pop()
        yield Path(z3.And(*solver.assertions()), result, tuple(run.claims))
        while answers and not opened[-1]:
            answers.pop()
            opened.pop()
        if not answers:
            return
        answers[-1], opened[-1] = not answers[-1], False


class DisprovedError(AssertionError):
    """A claim that does not hold, with numbers for which it fails."""


def prove(assumption: Any, claim: Any, what: str) -> None:
    """Raises `DisprovedError` unless the claim follows."""
    solver = z3.SolverFor("QF_BV")
    solver.set("timeout", 1000 * SECONDS)
    solver.add(assumption, z3.Not(claim))
    answer = solver.check()
    if answer == z3.sat:
        model = solver.model()
        numbers = ", ".join(f"{d.name()} = {model[d]}" for d in sorted(model.decls(), key=lambda d: d.name()))
        raise DisprovedError(f"{what} does not hold: {numbers}")
    assert answer == z3.unsat, f"{what}: no answer within {SECONDS} s"


def rebuilt(function: Any, replaced: dict[str, Any], old: str = "", new: str = "") -> FunctionType:
    """The function from its own text, with other globals; ``old`` -> ``new`` plants a defect where ``old`` stands."""
    function = inspect.unwrap(getattr(function, "py_func", function))
    source = textwrap.dedent(inspect.getsource(function))
    source = source[source.index("def ") :]
    assert not old or source.count(old) == 1, f"{old!r} stands {source.count(old)} times in {function.__name__}"
    space = dict(function.__globals__) | replaced
    exec(compile(source.replace(old, new) if old else source, f"<{function.__name__}>", "exec"), space)
    made: FunctionType = space[function.__name__]
    return made
