"""Regions: blocks of a function that a group of lanes passes together, with one entry and real branches inside. And the
frame: where what goes from region to region waits.
"""

from collections import defaultdict
from dataclasses import dataclass, field

from hil.abreast.widening.flow import Flow
from hil.abreast.widening.ir import Function
from hil.abreast.widening.varying import Varying


class Regions:
    """``heads``: their first blocks, in order; ``members``: blocks of each; ``of``: the head of each block's region.
    ``whole``: loops in which no lanes part, each within a region; ``ends``: headers of the others, from the innermost,
    that are over behind a region.
    """

    def __init__(self, function: Function, flow: Flow, varying: Varying) -> None:
        self.flow = flow
        self.whole = {header for header, loop in flow.loops.items() if not loop & varying.parting}
        self.of: dict[str, str] = {}
        self.members: dict[str, list[str]] = defaultdict(list)
        for name in flow.order:
            head = self._head(name, varying)
            self.of[name] = head
            self.members[head].append(name)
        self.heads = list(self.members)
        self.number = {head: n for n, head in enumerate(self.heads)}
        self.spans = {header: self._span(header) for header in flow.loops if header not in self.whole}
        self.ends: dict[str, list[str]] = defaultdict(list)
        for header in sorted(self.spans, key=lambda header: len(flow.loops[header])):
            self.ends[self.heads[self.spans[header][1]]].append(header)

    def of_block(self, name: str) -> int:
        """The number of its region."""
        return self.number[self.of[name]]

    def around(self, name: str) -> list[str]:
        """Headers of the loops around a block that are not whole, from the innermost."""
        return [header for header in self.flow.around[name] if header not in self.whole]

    def _head(self, name: str, varying: Varying) -> str:
        """That of the region from which alone, and together, lanes come here; else it is a head itself."""
        flow = self.flow
        if name == flow.entry or (name in flow.loops and name not in self.whole):
            return name
        before = [p for p in flow.leading[name] if (p, name) not in flow.back]
        heads = {self.of[p] for p in before}
        together = len(heads) == 1 and not varying.parting.intersection(before)
        return heads.pop() if together and all(self.around(p)[:1] == self.around(name)[:1] for p in before) else name

    def _span(self, header: str) -> tuple[int, int]:
        """First and last region of a loop."""
        numbers = [self.number[head] for head in self.heads if head in self.flow.loops[header]]
        return min(numbers), max(numbers)


@dataclass
class Frame:
    """Places, each for one value at a time. ``offset`` by name, in bytes; before them ``masks`` bytes, of regions."""

    regions: Regions
    lanes: int
    offset: dict[str, int] = field(default_factory=dict)
    masks: int = 0
    size: int = 0
    _wanted: list[tuple[int, int, str]] = field(default_factory=list)

    def want(self, name: str, blocks: set[str], *, again: str | None = None) -> None:
        """A place from the first to the last of the regions of ``blocks``, in which a value is made and used; over the
        whole of a loop where one of them lies in it and another does not, and of that with the header ``again``.
        """
        numbers = [self.regions.of_block(block) for block in blocks]
        low, high = min(numbers), max(numbers)
        for header, (first, last) in self.regions.spans.items():
            inside = blocks & self.regions.flow.loops[header]
            if header == again or (inside and inside != blocks):
                low, high = min(low, first), max(high, last)
        self._wanted.append((low, high, name))

    def lay_out(self) -> None:
        """Give a place to each: one whose value is of no use any more, or a new one."""
        each = self.lanes // 8
        self.masks = -(-each * len(self.regions.heads) // 64) * 64
        for head, n in self.regions.number.items():
            self.offset["mask " + head] = each * n
        free: list[int] = []
        busy: list[tuple[int, int]] = []
        count = 0
        for low, high, name in sorted(self._wanted):
            free += [place for until, place in busy if until < low]
            busy = [(until, place) for until, place in busy if until >= low]
            free.sort()
            if free:
                place = free.pop(0)
            else:
                place, count = count, count + 1
            busy.append((high, place))
            self.offset[name] = self.masks + 8 * self.lanes * place
        self.size = self.masks + 8 * self.lanes * count
