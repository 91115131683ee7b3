"""A function for many lanes: its regions one after another, each twice.

Each region has a mask of lanes that are to pass it. Where all are, they go on together by real branches, to the next
region where all are, and masks stay out of it. Where some are, its edges add them to the masks of the regions to which
they lead, and the next in order looks at its own: as each region stands behind all that lead to it, lanes meet there.
A loop is gone through until none comes back to its header.
"""

import re
from collections import defaultdict
from collections.abc import Iterable

from hil.abreast.widening import operations
from hil.abreast.widening.block import BlockText
from hil.abreast.widening.ir import Function, Instruction, functions
from hil.abreast.widening.shape import ZERO, Shape
from hil.abreast.widening.text import ALL, LANES, LIKELY, MASK, METADATA, MOSTLY, Text, quoted, vector

_ATTRIBUTES = 'attributes #0 = { nounwind "prefer-vector-width"="512" "min-legal-vector-width"="512" }\n'
TOGETHER, APART = "all ", "some "


def widened(module: str, shared: Iterable[str]) -> tuple[str, int]:
    """A module's text with each of its functions for ``LANES`` records side by side, and how many bytes its frame
    takes, which each is handed last. ``shared``: names of the arguments that are one for all. Raises ``IrError``.
    """
    declared = {f"declare i32 @llvm.vector.reduce.or.v{LANES}i32({vector('i32')})"}
    written, frame = [], 0
    for function in functions(module):
        wide = Widened(function, frozenset(shared), declared)
        written.append(wide.written())
        frame = max(frame, wide.shape.frame.size)
    tables = [re.sub(r", !.*$", "", line) for line in module.splitlines() if line.startswith("@")]
    return "\n".join([*tables, *written, *sorted(declared), METADATA, _ATTRIBUTES]), frame


class Widened:
    """One function."""

    def __init__(self, function: Function, shared: frozenset[str], declared: set[str]) -> None:
        self.shape = Shape(function, shared)
        self.text = Text(declared)

    def written(self) -> str:
        """Its text."""
        function, regions = self.shape.function, self.shape.regions
        self._places()
        self.text.jump(quoted("look ", regions.heads[0]))
        for head in regions.heads:
            self._region(head)
        self.text.label("%done")
        found = self.text.make(f"load {vector('i32')}, ptr %status")
        self.text.put(
            f"ret i32 {self.text.call('i32', f'llvm.vector.reduce.or.v{LANES}i32', [vector('i32')], [found])}"
        )
        handed = [f"ptr noalias {name}" if kind == "ptr" else f"{kind} {name}" for kind, name in function.arguments]
        head = f"define i32 @{function.name}({', '.join([*handed, 'ptr noalias %frame'])}) #0 {{\nstart:\n"
        return head + "\n".join(self.text.lines) + "\n}\n"

    def _places(self) -> None:
        text, shape = self.text, self.shape
        for name, kind in {**shape.local, "status": vector("i32")}.items():
            prefix, _, value = name.rpartition(" ")
            place = quoted(f"{prefix} ", value) if prefix else f"%{name}"
            text.put(f"{place} = alloca {kind}, align 64")
            text.put(f"store {kind} {ZERO.get(kind, 'zeroinitializer' if kind[0] == '<' else '0')}, ptr {place}")
        for name, offset in shape.frame.offset.items():
            prefix, _, value = name.rpartition(" ")
            place = quoted("mask " if prefix == "mask" else f"far {prefix} ", value)
            text.put(f"{place} = getelementptr i8, ptr %frame, i64 {offset}")
        text.declare("void", "llvm.memset.p0.i64", ("ptr", "i8", "i64", "i1"))
        text.put(f"call void @llvm.memset.p0.i64(ptr align 64 %frame, i8 0, i64 {shape.frame.masks}, i1 false)")
        text.put(f"store {MASK} {ALL}, ptr {quoted('mask ', shape.flow.entry)}, align 1")

    def _region(self, head: str) -> None:
        text, regions = self.text, self.shape.regions
        behind = quoted("behind ", head)
        is_loop = head in regions.spans
        text.label(quoted("look ", head))
        mask = text.make(f"load {MASK}, ptr {quoted('mask ', head)}, align 1")
        bits, some = text.bits(mask), text.new()
        text.fork(
            text.make(f"icmp ne i{LANES} {bits}, 0"), some, quoted("out of ", head) if is_loop else behind, MOSTLY
        )
        text.label(some)
        text.put(f"store {MASK} zeroinitializer, ptr {quoted('mask ', head)}, align 1")
        together, apart = quoted(TOGETHER, head), quoted(APART, head)
        text.fork(text.make(f"icmp eq i{LANES} {bits}, -1"), together, apart, LIKELY)
        for variant, on in ((TOGETHER, ALL), (APART, mask)):
            for name in regions.members[head]:
                text.label(quoted(variant, name))
                Ways(BlockText(text, self.shape, name, on), variant, behind).write()
        text.label(behind)
        for header in regions.ends[head]:
            again = text.any(text.make(f"load {MASK}, ptr {quoted('mask ', header)}, align 1"))
            text.fork(again, quoted("look ", header), quoted("out of ", header))
            text.label(quoted("out of ", header))
        following = regions.number[head] + 1
        text.jump(quoted("look ", regions.heads[following]) if following < len(regions.heads) else "%done")


class Ways:
    """A block and where lanes go from it, as all are there (``TOGETHER``) or some. ``behind``: where what follows the
    region in order begins.
    """

    def __init__(self, block: BlockText, variant: str, behind: str) -> None:
        self.block, self.variant, self.behind = block, variant, behind
        self.text, self.shape = block.text, block.shape
        self.are_together = variant == TOGETHER

    def write(self) -> None:
        """All of it."""
        block = self.shape.function.blocks[self.block.name]
        for phi in block.phis:
            assert phi.result is not None
            if phi.result in self.shape.varying.values:
                came = self.text.load(self.block.mask, phi.type, self._entry(phi))
            else:
                came = self.text.make(f"load {phi.type}, ptr {self._entry(phi)}")
            self.block.define(phi.result, came)
        for instruction in block.instructions:
            operations.write(self.block, instruction)
        end = block.end
        if end.operation == "ret":
            self._return(end)
        elif end.operation == "unreachable":
            self.text.jump(self.behind)
        elif len(block.followers) == 1:
            self._all(self.block, block.followers[0])
        elif not self.block.is_varying(end.operands[0]):
            self._by_value(end, self.block.one(end.operands[0]))
        elif end.operation == "br":
            self._by_lane(end)
        else:
            self._by_case(end)

    def _entry(self, phi: Instruction) -> str:
        assert phi.result is not None
        is_head = self.shape.regions.of[phi.block] == phi.block
        return quoted("far in " if is_head else "in ", phi.result)

    def _return(self, end: Instruction) -> None:
        self.text.blend(self.block.mask, "i32", self.block.wide(end.operands[0], "i32"), "%status")
        self.text.jump("%done" if self.are_together else self.behind)

    def _by_value(self, end: Instruction, value: str) -> None:
        """All lanes go the same way, which a value of all tells."""
        labels = [self.text.new() for _ in end.labels]
        if end.operation == "br":
            self.text.fork(value, *labels)
        else:
            cases = " ".join(f"{end.type} {c}, label {way}" for c, way in zip(end.cases, labels[1:], strict=True))
            self.text.put(f"switch {end.type} {value}, label {labels[0]} [{cases}]")
        for label, target in zip(labels, end.labels, strict=True):
            self.text.label(label)
            self._all(self.block.forget(), target)

    def _by_lane(self, end: Instruction) -> None:
        """Each lane by a condition of its own."""
        text, condition = self.text, self.block.wide(end.operands[0], "i1")
        if self.are_together:
            bits = text.bits(condition)
            yes, mixed, no, apart = text.new(), text.new(), text.new(), text.new()
            text.fork(text.make(f"icmp eq i{LANES} {bits}, -1"), yes, mixed)
            text.label(mixed)
            text.fork(text.make(f"icmp eq i{LANES} {bits}, 0"), no, apart, LIKELY)
            for label, target in zip((yes, no), end.labels, strict=True):
                text.label(label)
                self._all(self.block.forget(), target)
            text.label(apart)
        here, others = text.both(self.block.mask, condition), text.both(self.block.mask, text.no(condition))
        for mask, target in zip((here, others), end.labels, strict=True):
            self._some(target, mask)
        text.jump(self.behind)

    def _by_case(self, end: Instruction) -> None:
        text, kind = self.text, end.type
        value = self.block.wide(end.operands[0], kind)
        if self.are_together:
            first, same = text.agreed(self.block.mask, kind, value)
            one, apart = text.new(), text.new()
            text.fork(same, one, apart, LIKELY)
            text.label(one)
            self._by_value(end, first)
            text.label(apart)
        rest, masks = self.block.mask, defaultdict(list)
        for case, target in zip(end.cases, end.labels[1:], strict=True):
            is_it = text.make(f"icmp eq {vector(kind)} {value}, splat ({kind} {case})")
            masks[target].append(text.both(rest, is_it))
            rest = text.both(rest, text.no(is_it))
        masks[end.labels[0]].append(rest)
        for target, each in masks.items():
            mask = each[0]
            for other in each[1:]:
                mask = text.make(f"or {MASK} {mask}, {other}")
            self._some(target, mask)
        text.jump(self.behind)

    def _all(self, block: BlockText, target: str) -> None:
        """All that are here go on to a block: to it, if nobody is anywhere else, or if it is of this region."""
        regions = self.shape.regions
        if self.are_together or regions.of[target] == regions.of[block.name]:
            for phi, value in self._carried(block, target):
                assert phi.result is not None
                self.text.put(f"store {self.shape.type_of(phi.result)} {value}, ptr {self._entry(phi)}")
            self.text.jump(quoted(self.variant, target))
            return
        self._some(target, block.mask, block)
        self.text.jump(self.behind)

    def _some(self, target: str, mask: str, block: BlockText | None = None) -> None:
        """Those of a mask will go on to a region's head, once its turn comes."""
        text, place = self.text, quoted("mask ", target)
        carried = self._carried(block or self.block, target)
        waiting = text.make(f"load {MASK}, ptr {place}, align 1")
        text.put(f"store {MASK} {text.make(f'or {MASK} {waiting}, {mask}')}, ptr {place}, align 1")
        for phi, value in carried:
            assert phi.result is not None
            entry, kind = self._entry(phi), phi.type
            if phi.result in self.shape.varying.values:
                text.blend(mask, kind, value, entry)
            else:
                old = text.make(f"load {kind}, ptr {entry}")
                kept = text.make(f"select i1 {text.any(mask)}, {kind} {value}, {kind} {old}")
                text.put(f"store {kind} {kept}, ptr {entry}")

    def _carried(self, block: BlockText, target: str) -> list[tuple[Instruction, str]]:
        """Phis of a block with what they get on the way from here: all are read before any is written."""
        found = []
        for phi in self.shape.function.blocks[target].phis:
            value = phi.operands[phi.labels.index(block.name)]
            varies = phi.result in self.shape.varying.values
            found.append((phi, block.wide(value, phi.type) if varies else block.one(value)))
        return found
