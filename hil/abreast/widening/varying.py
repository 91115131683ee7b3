"""Which values of a function may differ from lane to lane, and where lanes part and meet.

A value varies if it was read from a lane's own memory, if it was made of one that does, if it is a phi where lanes meet
that came by different ways, or if it is used outside a loop that lanes leave at different times (Karrenberg and
Hack 2011). All else is one value for all.
"""

from collections.abc import Iterable
from typing import Literal

from hil.abreast.widening.flow import Flow
from hil.abreast.widening.ir import Function, Instruction, IrError

Space = Literal["shared", "lanes"]


class Varying:
    """``values``: names of what varies; ``parting``: blocks after which lanes part; ``left_apart``: headers of loops
    that lanes leave at different times. ``shared``: names of the arguments whose memory is one for all lanes.
    """

    def __init__(self, function: Function, flow: Flow, shared: Iterable[str]) -> None:
        self.function, self.flow = function, flow
        self.made = {i.result: i for b in function.blocks.values() for i in b.each if i.result is not None}
        self.space: dict[str, Space] = {
            name: "shared" if name[1:] in set(shared) else "lanes" for kind, name in function.arguments if kind == "ptr"
        }
        self.values: set[str] = set()
        self.parting: set[str] = set()
        self.left_apart: set[str] = set()
        self._meet: set[str] = set()
        self._place_pointers()
        while self._look_once():
            pass

    def space_of(self, pointer: str) -> Space:
        """Where what is pointed to lies."""
        return "shared" if pointer.startswith(("@", "getelementptr")) else self.space[pointer]

    def is_apart(self, value: str, used_in: str) -> bool:
        """Whether lanes left a loop that made the value at different times before that block."""
        if value not in self.made:
            return False
        around = self.flow.around[self.made[value].block]
        return any(header in self.left_apart and used_in not in self.flow.loops[header] for header in around)

    def is_varying(self, value: str, used_in: str) -> bool:
        """Whether it has to be a vector in that block."""
        return value in self.values or self.is_apart(value, used_in)

    def _place_pointers(self) -> None:
        unknown = [i for i in self.made.values() if i.type == "ptr"]
        while unknown:
            left = [i for i in unknown if not self._placed(i)]
            if len(left) == len(unknown):
                raise IrError(f"where {left[0].result} points to is not known")
            unknown = left

    def _placed(self, instruction: Instruction) -> bool:
        if instruction.operation == "getelementptr":
            sources = instruction.operands[:1]
        else:
            sources = instruction.operands[1:] if instruction.operation == "select" else instruction.operands
        shared = {"shared" for s in sources if s.startswith(("@", "getelementptr"))}
        spaces = {self.space[s] for s in sources if s in self.space} | shared
        if len(spaces) > 1:
            raise IrError(f"{instruction.result} points to a lane's memory or to that of all")
        if spaces and instruction.result is not None:
            (self.space[instruction.result],) = spaces  # type: ignore[assignment]
        return bool(spaces)

    def _look_once(self) -> bool:
        """Whether anything was found that had not been known."""
        before = len(self.values) + len(self.parting)
        for name in self.flow.order:
            block = self.function.blocks[name]
            self.values.update(i.result for i in block.each if i.result is not None and self._varies(i))
            end = block.end
            if len(block.followers) > 1 and name not in self.parting and self.is_varying(end.operands[0], name):
                self.parting.add(name)
                self._part(name)
        return len(self.values) + len(self.parting) > before

    def _varies(self, instruction: Instruction) -> bool:
        here = instruction.block
        if instruction.operation == "phi":
            ways = zip(instruction.operands, instruction.labels, strict=True)
            if any(self.is_varying(value, way) or self.is_varying(value, here) for value, way in ways):
                return True
            return here in self._meet and len(set(instruction.operands)) > 1
        if instruction.operation == "load" and self.space_of(instruction.operands[0]) == "lanes":
            return True
        return any(self.is_varying(value, here) for value in instruction.operands)

    def _part(self, block: str) -> None:
        """Lanes part after a block: find where they meet again, and which loops they leave apart."""
        followers = self.function.blocks[block].followers
        again = {f: ("again", f) for f in followers if (block, f) in self.flow.back}
        self._follow({f: f for f in followers if f not in again}, again, block)

    def _follow(self, ways: dict[str, str], again: dict[str, tuple[str, str]], origin: str) -> None:
        """``ways``: blocks with the way by which lanes come to them; ``again``: headers to which some go back."""
        flow, way_to, back_by = self.flow, dict(ways), dict[str, object](again)
        for name in flow.order:
            if name not in way_to:
                continue
            for follower in self.function.blocks[name].followers:
                if (name, follower) in flow.back:
                    if back_by.setdefault(follower, way_to[name]) != way_to[name]:
                        self._meet.add(follower)
                elif way_to.setdefault(follower, way_to[name]) != way_to[name]:
                    self._meet.add(follower)
                    way_to[follower] = follower
        for header in flow.around[origin]:
            if header not in self.left_apart:
                self._leave(header, way_to, back_by, origin)

    def _leave(self, header: str, way_to: dict[str, str], back_by: dict[str, object], origin: str) -> None:
        """If some leave this loop while others stay, or by different ways, they meet behind it at different times."""
        loop = self.flow.loops[header]
        behind = {f for name in loop for f in self.function.blocks[name].followers if f not in loop}
        out = {way_to[name] for name in behind if name in way_to}
        stay = {back_by[header]} if header in back_by else set()
        if not out or len(out | stay) == 1:
            return
        self.left_apart.add(header)
        self._meet.update(name for name in behind if sum(before in loop for before in self.flow.leading[name]) > 1)
        self._follow({name: name for name in behind}, {}, origin)
