"""Every state of the composition that can be reached, breadth first, to a fixed point: ``make prove``."""

import argparse
import json
import sys
import time
from array import array
from collections import deque
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parents[1] / "rigs"), str(Path(__file__).parent)]

import numpy as np  # noqa: E402
from configurations import CONFIGURATIONS, Configuration  # noqa: E402
from fates import Option, ViolationError  # noqa: E402
from scipy.sparse import csr_matrix  # noqa: E402
from scipy.sparse.csgraph import breadth_first_order, connected_components  # noqa: E402
from story import as_text, from_text, tell  # noqa: E402
from world import World, learnt  # noqa: E402

IN_CI = ("two", "slow drive time-out", "one", "whole dialogue", "well")
RUNNING, STARTING, ENDED = 1, 2, 4


@dataclass
class Explored:
    """What there is: ``edges`` from state to state by number, ``origin`` the first way to each."""

    states: int = 0
    transitions: int = 0
    seconds: float = 0.0
    is_complete: bool = False
    longest: int = 0
    violation: str = ""
    story: list[Option] = field(default_factory=list)
    longest_apart: int = 0
    origin: list[tuple[int, tuple[Option, ...]]] = field(default_factory=list)
    heads: "array[int]" = field(default_factory=lambda: array("I"))
    tails: "array[int]" = field(default_factory=lambda: array("I"))
    marks: bytearray = field(default_factory=bytearray)

    def way_to(self, number: int) -> list[Option]:
        """The shortest way to a state from the beginning."""
        ways: list[tuple[Option, ...]] = []
        while number >= 0:
            number, way = self.origin[number]
            ways.append(way)
        return [option for way in reversed(ways) for option in way]


def settle(world: World) -> tuple[list[Option], tuple[Option, ...]]:
    """Go on until something has to be decided; returns what may happen there, and what happened on the way."""
    way: list[Option] = []
    while True:
        options = world.options()
        if len(options) != 1 or (way and world.is_landmark()):
            return options, tuple(way)
        way.append(options[0])
        world.take(options[0])


def explore(
    configuration: Configuration,
    limit_s: float = 1e9,
    show: bool = False,
    look: Callable[[World], object] = lambda world: None,
) -> Explored:
    """All states from the first on, the nearest first, until none is new, an invariant fails or the time is over.

    ``look`` is called in each of them.
    """
    world = World(configuration, learnt(configuration))
    found = Explored()
    begin_s = time.monotonic()
    numbers: dict[bytes, int] = {}
    frontier: deque[tuple[int, tuple[Any, ...], list[Option]]] = deque()

    def add(options: list[Option], origin: int, way: tuple[Option, ...]) -> int:
        state = world.take_state()
        key = world.key(state)
        number = numbers.get(key)
        if number is None:
            number = numbers[key] = len(numbers)
            look(world)
            found.origin.append((origin, way))
            found.marks.append(RUNNING * world.is_running | STARTING * world.is_starting | ENDED * (not options))
            if options:
                frontier.append((number, state, options))
        return number

    options, way = settle(world)
    add(options, -1, way)
    while frontier:
        if time.monotonic() - begin_s > limit_s:
            break
        number, state, options = frontier.popleft()
        for option in options:
            world.put_state(state)
            try:
                world.take(option)
                onward, way = settle(world)
            except ViolationError as violation:
                found.violation = str(violation)
                found.story = [*found.way_to(number), option]
                break
            found.heads.append(number)
            found.tails.append(add(onward, number, (option, *way)))
        if show and number % 20000 == 0:
            print(
                f"{number} expanded, {len(numbers)} states, {len(frontier)} wait, {time.monotonic() - begin_s:.0f} s",
                flush=True,
            )
        if found.violation:
            break
    found.states, found.transitions = len(numbers), len(found.heads)
    found.seconds = time.monotonic() - begin_s
    found.is_complete = not frontier and not found.violation
    found.longest, found.longest_apart = world.longest, world.longest_apart
    if found.is_complete:
        _look_at_the_whole(found)
    return found


def _look_at_the_whole(found: Explored) -> None:
    """What is not true of a state but of all ways from it: a way back from everywhere, and no start-up for ever."""
    marks = np.frombuffer(found.marks, np.uint8)
    heads, tails = (np.frombuffer(ends, np.uint32).astype(np.int64) for ends in (found.heads, found.tails))
    size = found.states
    starting = marks & STARTING > 0
    inside = starting[heads] & starting[tails]
    graph = csr_matrix((np.ones(inside.sum(), np.int8), (heads[inside], tails[inside])), shape=(size, size))
    _, part = connected_components(graph, connection="strong")
    again = np.flatnonzero((np.bincount(part)[part] > 1) & starting)
    stays = heads[inside & (heads == tails)]
    endless = np.r_[again, stays]
    if len(endless):
        found.violation = "a start-up can go on for ever from here"
        found.story = found.way_to(int(endless[0]))
        return
    good = np.flatnonzero(marks & (RUNNING | ENDED))
    backwards = csr_matrix(
        (np.ones(len(heads) + len(good), np.int8), (np.r_[tails, np.full(len(good), size)], np.r_[heads, good])),
        shape=(size + 1, size + 1),
    )
    reached = breadth_first_order(backwards, size, return_predecessors=False)
    lost = np.setdiff1d(np.arange(size), reached)
    if len(lost):
        found.violation = "from here no way leads back to a closed loop without power off"
        found.story = found.way_to(int(lost[0]))


def report(name: str, seconds: float, show: bool = False) -> tuple[str, dict[str, Any]]:
    """Explores one configuration; returns what a person reads, and the figures."""
    configuration = CONFIGURATIONS[name]
    found = explore(configuration, seconds, show=show)
    words = (
        f"{name}: {found.states} states, {found.transitions} transitions, {found.seconds:.0f} s, "
        f"{'fixed point' if found.is_complete else 'NOT COMPLETE'}, 0 V {found.longest} ticks after a decision, "
        f"gate and combs apart for {found.longest_apart}"
    )
    if found.violation:
        story = tell(configuration, found.story)
        words += f"\n{found.violation}\n{story}\n"
        file = Path("runs") / f"counter-example-{name.replace(' ', '-')}.json"
        file.parent.mkdir(exist_ok=True)
        file.write_text(as_text(configuration, found.story))
        words += f"the same once more: {sys.executable} tests/proof/explore.py --replay {file}"
    figures = {
        "states": found.states,
        "transitions": found.transitions,
        "complete": found.is_complete,
        "ticks_to_0_v": found.longest,
        "ticks_apart": found.longest_apart,
        "violation": found.violation,
    }
    return words, figures


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", nargs="*", default=list(IN_CI), help=f"of: {', '.join(CONFIGURATIONS)}")
    parser.add_argument("--seconds", type=float, default=1e6, help="give up on one after so long")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--show", action="store_true")
    parser.add_argument("--figures", type=Path, help="leave the figures in this file")
    parser.add_argument("--replay", type=Path, help="tell the way of a counter-example once more")
    arguments = parser.parse_args()
    if arguments.replay:
        name, way = from_text(arguments.replay.read_text())
        print(tell(CONFIGURATIONS[name], way))
        return 0
    figures: dict[str, Any] = (
        json.loads(arguments.figures.read_text()) if arguments.figures and arguments.figures.exists() else {}
    )
    with ProcessPoolExecutor(arguments.workers) as pool:
        waiting = {pool.submit(report, name, arguments.seconds, arguments.show): name for name in arguments.name}
        for done in as_completed(waiting):
            words, figures[waiting[done]] = done.result()
            print(words, flush=True)
    if arguments.figures:
        arguments.figures.write_text(json.dumps(figures, indent=2, sort_keys=True) + "\n")
    return 0 if all(figures[name]["complete"] and not figures[name]["violation"] for name in arguments.name) else 1


if __name__ == "__main__":
    sys.exit(main())
