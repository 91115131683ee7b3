"""What is known of a function before it is written: which values vary, regions, and where each value is kept."""

from collections import defaultdict

from hil.abreast.widening.flow import Flow
from hil.abreast.widening.ir import Function
from hil.abreast.widening.regions import Frame, Regions
from hil.abreast.widening.text import LANES, vector
from hil.abreast.widening.varying import Varying

ZERO = {"double": "0.0", "ptr": "null"}


class Shape:
    """``kind``: the scalar type of each value; ``used``: blocks that use a value of another one. What only its own
    region uses is ``local``, an alloca that LLVM makes a register of; the rest has places in the frame. Of a pointer
    that varies two more are kept: that of the first lane, and whether it is the same for all.
    """

    def __init__(self, function: Function, shared: frozenset[str]) -> None:
        self.function = function
        self.flow = Flow(function)
        self.varying = Varying(function, self.flow, shared)
        self.regions = Regions(function, self.flow, self.varying)
        self.frame = Frame(self.regions, LANES)
        self.kind = {name: kind for kind, name in function.arguments}
        for made in self.varying.made.values():
            assert made.result is not None
            self.kind[made.result] = "i1" if made.operation in ("icmp", "fcmp") else made.type
        self.used = self._used()
        self.local: dict[str, str] = {}
        for name in self.varying.made:
            self._place(name)
        self.frame.lay_out()

    def type_of(self, value: str) -> str:
        """As it is made."""
        return vector(self.kind[value]) if value in self.varying.values else self.kind[value]

    def is_near(self, value: str, block: str) -> bool:
        """Whether the block's region makes that value."""
        return self.regions.of[self.varying.made[value].block] == self.regions.of[block]

    def uses(self, value: str, *, near: bool) -> set[str]:
        """Blocks that use it in the region that makes it, or in others."""
        return {block for block in self.used[value] if self.is_near(value, block) == near}

    def has_shade(self, value: str) -> bool:
        """Whether it is a pointer of which the first lane's is kept besides."""
        made = self.varying.made.get(value)
        return made is not None and made.operation == "getelementptr" and value in self.varying.values

    def is_left_apart(self, value: str) -> bool:
        """Whether a value that is one for all in its loop is one of each lane behind it."""
        outside = any(self.varying.is_apart(value, block) for block in self.used[value])
        return value not in self.varying.values and outside

    def _used(self) -> dict[str, set[str]]:
        used: dict[str, set[str]] = defaultdict(set)
        for name in self.flow.order:
            block = self.function.blocks[name]
            for phi in block.phis:
                for value, way in zip(phi.operands, phi.labels, strict=True):
                    self._note(used, value, way)
            for each in (*block.instructions, block.end):
                for value in each.operands:
                    self._note(used, value, name)
        return used

    def _note(self, used: dict[str, set[str]], value: str, block: str) -> None:
        if value in self.varying.made and self.varying.made[value].block != block:
            used[value].add(block)

    def _place(self, value: str) -> None:
        made, kind = self.varying.made[value], self.type_of(value)
        block = made.block
        if made.operation == "phi":
            if self.regions.of[block] == block:
                self.frame.want("in " + value, {block, *made.labels}, again=block)
            else:
                self.local["in " + value] = kind
        if self.uses(value, near=True):
            self.local["of " + value] = kind
            if self.has_shade(value):
                self.local["first " + value], self.local["same " + value] = "ptr", "i1"
        if away := self.uses(value, near=False):
            self.frame.want("of " + value, {block, *away})
            if self.has_shade(value):
                self.frame.want("first " + value, {block, *away})
                self.frame.want("same " + value, {block, *away})
            if self.is_left_apart(value):
                self.frame.want("apart " + value, {block, *away})
