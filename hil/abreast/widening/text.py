"""LLVM's text, written: names that are new, and vectors of a lane each."""

import re
from collections.abc import Sequence

LANES = 16
"""Doubles in two vector registers of AVX-512: what one waits for, the other computes in."""
MASK = f"<{LANES} x i1>"
ALL = "splat (i1 true)"
LIKELY, MOSTLY = "!prof !0", "!prof !1"
METADATA = '!0 = !{!"branch_weights", i32 100, i32 1}\n!1 = !{!"branch_weights", i32 8, i32 1}\n'


def vector(kind: str) -> str:
    """The type of a value of each lane."""
    return f"<{LANES} x {kind}>"


def quoted(prefix: str, name: str) -> str:
    """A name made of another."""
    bare = name.removeprefix("%").strip('"')
    return f'%"{prefix}{bare}"'


class Text:
    """Lines of a function, and what it calls: ``declared``, shared by all of a module."""

    def __init__(self, declared: set[str]) -> None:
        self.lines: list[str] = []
        self._declared = declared
        self._count = 0

    def new(self) -> str:
        """A name that nothing has."""
        self._count += 1
        return f"%v{self._count}"

    def put(self, line: str) -> None:
        """A line that makes no value."""
        self.lines.append("  " + line)

    def make(self, line: str) -> str:
        """A line that makes one; its name."""
        name = self.new()
        self.lines.append(f"  {name} = {line}")
        return name

    def label(self, name: str) -> None:
        """What follows is the block of that name, ``%`` before it."""
        self.lines.append(f"{name[1:]}:")

    def jump(self, label: str) -> None:
        """To a block."""
        self.put(f"br label {label}")

    def fork(self, condition: str, yes: str, no: str, weights: str = "") -> None:
        """To one of two."""
        self.put(f"br i1 {condition}, label {yes}, label {no}" + (f", {weights}" if weights else ""))

    def call(self, kind: str, function: str, types: Sequence[str], values: Sequence[str]) -> str:
        """The value of a function; attributes of ``types`` are no part of its declaration."""
        self.declare(kind, function, types)
        handed = ", ".join(f"{t} {v}" for t, v in zip(types, values, strict=True))
        return self.make(f"call {kind} @{function}({handed})")

    def declare(self, kind: str, function: str, types: Sequence[str]) -> None:
        """That there is such a function."""
        plain = ", ".join(re.sub(r" align \d+$", "", t) for t in types)
        self._declared.add(f"declare {kind} @{function}({plain})")

    def splat(self, kind: str, value: str) -> str:
        """A value for each lane."""
        one = self.make(f"insertelement {vector(kind)} poison, {kind} {value}, i64 0")
        return self.make(f"shufflevector {vector(kind)} {one}, {vector(kind)} poison, <{LANES} x i32> zeroinitializer")

    def bits(self, mask: str) -> str:
        """A mask as a number."""
        return self.make(f"bitcast {MASK} {mask} to i{LANES}")

    def any(self, mask: str) -> str:
        """Whether a lane is on."""
        return self.make(f"icmp ne i{LANES} {self.bits(mask)}, 0")

    def both(self, mask: str, condition: str) -> str:
        """Lanes that are on and for which a condition holds, whatever it is of those that are off."""
        return self.make(f"select {MASK} {mask}, {MASK} {condition}, {MASK} zeroinitializer")

    def no(self, condition: str) -> str:
        """The opposite."""
        return self.make(f"xor {MASK} {condition}, {ALL}")

    def load(self, mask: str, kind: str, place: str) -> str:
        """What lanes left at a place. Doubles of those that are off are 0: a place has served other values, and of a
        whole number's bits, which are a subnormal's, each operation takes a hundred cycles.
        """
        many = vector(kind)
        found = self.make(f"load {many}, ptr {place}")
        if mask == ALL or kind != "double":
            return found
        return self.make(f"select {MASK} {mask}, {many} {found}, {many} zeroinitializer")

    def blend(self, mask: str, kind: str, value: str, place: str, align: str = "") -> None:
        """Store to a place what lanes have that are on."""
        many = vector(kind)
        if mask == ALL:
            self.put(f"store {many} {value}, ptr {place}{align}")
            return
        old = self.make(f"load {many}, ptr {place}{align}")
        mixed = self.make(f"select {MASK} {mask}, {many} {value}, {many} {old}")
        self.put(f"store {many} {mixed}, ptr {place}{align}")

    def agreed(self, mask: str, kind: str, value: str) -> tuple[str, str]:
        """What the first lane has that is on, and whether all that are on have it."""
        many, first = vector(kind), "0"
        if mask != ALL:
            first = self.call(f"i{LANES}", f"llvm.cttz.i{LANES}", (f"i{LANES}", "i1"), (self.bits(mask), "true"))
        one = self.make(f"extractelement {many} {value}, i{LANES} {first}")
        differs = self.make(f"icmp ne {many} {value}, {self.splat(kind, one)}")
        return one, self.make(f"icmp eq i{LANES} {self.bits(self.both(mask, differs))}, 0")
