"""How control flows through a function: loops, and an order in which each block stands behind all that lead to it."""

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping

from hil.abreast.widening.ir import Block, Function, IrError


class Flow:
    """``order``: blocks that can be reached, the blocks of a loop together, its header first. ``loops``: the blocks of
    each, by header. ``around``: headers of the loops around each block, from the innermost. ``back``: edges to a header
    from within its loop. Raises ``IrError`` for a loop with two entries.
    """

    def __init__(self, function: Function) -> None:
        self.blocks, self.entry = function.blocks, next(iter(function.blocks))
        reached = _behind_what_leads_to_them(self.entry, lambda name: self.blocks[name].followers)
        self.leading: Mapping[str, list[str]] = _leading(self.blocks, reached)
        self.loops, self.back = self._found(reached)
        by_size = sorted(self.loops, key=lambda header: len(self.loops[header]))
        self.around = {name: [header for header in by_size if name in self.loops[header]] for name in reached}
        self.order = self._linear(reached, self.entry, 0)
        self.place = {name: n for n, name in enumerate(self.order)}

    def _found(self, reached: list[str]) -> tuple[dict[str, set[str]], set[tuple[str, str]]]:
        number = {name: n for n, name in enumerate(reached)}
        dominator = _dominators(reached, self.leading)
        loops: dict[str, set[str]] = defaultdict(set)
        back = set()
        for name in reached:
            for follower in self.blocks[name].followers:
                if number[follower] > number[name]:
                    continue
                above = name
                while number[above] > number[follower]:
                    above = dominator[above]
                if above != follower:
                    raise IrError(f"a loop with two entries, at {follower}")
                back.add((name, follower))
                loops[follower].add(follower)
                todo = [name]
                while todo:
                    inside = todo.pop()
                    if inside not in loops[follower]:
                        loops[follower].add(inside)
                        todo += self.leading[inside]
        return dict(loops), back

    def _linear(self, names: Collection[str], first: str, depth: int) -> list[str]:
        """Of all blocks, or of a loop that ``depth`` loops hold, itself among them: inner loops stand for themselves
        until they are put in.
        """
        within = set(names)
        stands = {}
        for name in within:
            inner = self.around[name][: len(self.around[name]) - depth]
            stands[name] = inner[-1] if inner else name
        followers: dict[str, list[str]] = defaultdict(list)
        for name in within:
            for follower in self.blocks[name].followers:
                if follower in within and stands[follower] != stands[name] and (name, follower) not in self.back:
                    followers[stands[name]].append(stands[follower])
        found: list[str] = []
        for name in _behind_what_leads_to_them(stands[first], lambda name: followers[name]):
            if name in self.loops and self.loops[name] != within:
                found += self._linear(self.loops[name], name, depth + 1)
            else:
                found.append(name)
        return found


def _behind_what_leads_to_them(first: str, followers_of: Callable[[str], Iterable[str]]) -> list[str]:
    """Reverse postorder from ``first`` on."""
    seen, done = {first}, []
    stack = [(first, iter(followers_of(first)))]
    while stack:
        name, rest = stack[-1]
        follower = next((f for f in rest if f not in seen), None)
        if follower is None:
            done.append(name)
            stack.pop()
        else:
            seen.add(follower)
            stack.append((follower, iter(followers_of(follower))))
    return done[::-1]


def _leading(blocks: Mapping[str, Block], reached: Iterable[str]) -> dict[str, list[str]]:
    leading: dict[str, list[str]] = {name: [] for name in reached}
    for name in leading:
        for follower in blocks[name].followers:
            leading[follower].append(name)
    return leading


def _dominators(reached: list[str], leading: Mapping[str, list[str]]) -> dict[str, str]:
    """Of each block the nearest that every way to it passes (Cooper, Harvey, Kennedy 2001)."""
    number = {name: n for n, name in enumerate(reached)}
    nearest = {reached[0]: reached[0]}
    changed = True
    while changed:
        changed = False
        for name in reached[1:]:
            known = [before for before in leading[name] if before in nearest]
            common = known[0]
            for other in known[1:]:
                while common != other:
                    if number[common] > number[other]:
                        common = nearest[common]
                    else:
                        other = nearest[other]
            if nearest.get(name) != common:
                nearest[name], changed = common, True
    return nearest
