"""Every state of the composition that can be reached, breadth first, to a fixed point: ``make prove``."""

import argparse
import json
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

_TESTS = Path(__file__).parents[1]
sys.path[:0] = [str(_TESTS.parent), str(_TESTS / "rigs"), str(Path(__file__).parent / "composition")]

import numpy as np  # noqa: E402
from configurations import CONFIGURATIONS, Configuration  # noqa: E402
from fates import Option, ViolationError  # noqa: E402
from product import FULL, IN_FLIGHT, MISSING, OPTIONS_MOST, VIOLATED, WORLD  # noqa: E402
from search import (  # noqa: E402
    FLIGHTS,
    NUMBER,
    STATES,
    TRANSITIONS,
    Store,
    add,
    expand,
    fill,
    first_start_without_end,
    first_without_a_way_back,
)
from story import as_text, from_text, tell  # noqa: E402
from world import Composition, World, option_of, violation_of  # noqa: E402

from pkxyz_ctrl.can.codec import Counts  # noqa: E402
from pkxyz_ctrl.can.driver_rules import DriverState  # noqa: E402
from pkxyz_ctrl.compiled.direct_call import direct  # noqa: E402
from pkxyz_ctrl.safety.modes import Mode  # noqa: E402

EXPLORED = Path(__file__).with_name("explored.json")
IN_CI = tuple(
    name
    for name, found in json.loads(EXPLORED.read_text("utf-8")).items()
    if found["complete"] and not CONFIGURATIONS[name].by_hand
)
"""What was explored to the fixed point once, and left its figures: ``--figures tests/proof/explored.json``. Others take
longer than a change should have to wait: ``explore.py "outputs, two"`` by hand.
"""


@dataclass
class Explored:
    """What there is."""

    states: int = 0
    transitions: int = 0
    seconds: float = 0.0
    is_complete: bool = False
    longest: int = 0
    violation: str = ""
    story: list[Option] = field(default_factory=list)
    longest_apart: int = 0
    longest_high: int = 0
    longest_unsigned: int = 0
    has_put_out: bool = False  # digital outputs were high
    has_signed: bool = False  # a signature came in time
    asked: int = 0  # so often was a side asked what it does in a state
    of_sides: tuple[int, int] = (0, 0)  # states of controller and node, each by itself
    met: set[tuple[Mode, DriverState, Counts]] = field(default_factory=set)


class Search:
    """The states found so far, and where the search is."""

    def __init__(self, configuration: Configuration) -> None:
        self.composition = Composition(configuration)
        self._world, self._kept = np.zeros(1, WORLD), np.zeros(WORLD.itemsize // 8, np.int64)
        self._words = self._world.view(np.int64)
        self._may, self._then = (np.zeros(OPTIONS_MOST, np.int32) for _ in range(2))
        self.cursor = np.zeros(5, np.int64)
        n = 1 << 14
        self.store = Store(
            states=np.zeros((n, 2), np.int64), slots=np.full(2 * n, -1, np.int32),
            flights=np.zeros((n, IN_FLIGHT), np.int64), flight_slots=np.full(2 * n, -1, np.int32),
            origin=np.zeros(n, np.int32), option=np.zeros(n, np.int32), marks=np.zeros(n, np.uint8),
            begins=np.zeros(n + 1, np.int64), tails=np.zeros(4 * n, np.uint32),
        )  # fmt: skip
        self._mine = self._world, self._words, self._kept, self._may, self._then
        self._expand = direct(expand, *self._mine, self.composition.rows, self.store, self.cursor)

    def begin(self) -> None:
        """The first state is found. Raises `ViolationError`."""
        world = World(self.composition)
        world.settle()
        self._words[:] = world.words
        rows = self.composition.rows
        add(self._world[0], self._words, rows, self.store, self.cursor, -1, 0, len(world.choices()))

    def go_on(self) -> int:
        """Expand states until something else is to be done: `MISSING`, `FULL`, `VIOLATED`, or 0 for the end."""
        return self._expand(*self._mine, self.composition.rows, self.store, self.cursor)

    def grow(self) -> None:
        """Room for twice as many of what there is no more room for."""
        store, count = self.store, self.cursor
        longer: dict[str, Any] = {}
        if count[STATES] == len(store.states):
            names = ("states", "origin", "option", "marks", "begins")
            longer = {name: _twice(getattr(store, name)) for name in names}
            longer["slots"] = np.full(2 * len(store.slots), -1, np.int32)
            fill(longer["states"], longer["slots"], count[STATES])
        if count[FLIGHTS] == len(store.flights):
            longer |= {
                "flights": _twice(store.flights),
                "flight_slots": np.full(2 * len(store.flight_slots), -1, np.int32),
            }
            fill(longer["flights"], longer["flight_slots"], count[FLIGHTS])
        if not longer:
            longer = {"tails": _twice(store.tails)}
        self.store = store._replace(**longer)

    def violation(self) -> tuple[str, list[Option]]:
        """What is wrong where the search stands, and the way there."""
        number, option = int(self.cursor[NUMBER]), int(self._may[self.cursor[1]])
        way = [*self.way_to(number), option_of(self.composition, option)]
        return violation_of(self.composition, self._world), way

    def way_to(self, number: int) -> list[Option]:
        """The choices of the shortest way from the beginning."""
        way: list[Option] = []
        while self.store.origin[number] >= 0:
            way.append(option_of(self.composition, int(self.store.option[number])))
            number = int(self.store.origin[number])
        return way[::-1]

    def met(self) -> set[tuple[Mode, DriverState, Counts]]:
        """Modes, states of the driver and counts of the combs that were there together."""
        rows, words = self.composition.rows, self.store.states[: self.cursor[STATES], 0]
        pairs = np.unique(words & ((1 << 42) - 1))
        of_controller, of_node = rows.controllers[pairs & 0x3FFFFF], rows.nodes[pairs >> 22]
        found = of_controller["mode"], of_controller["driver"], of_node["counts"]
        counts = self.composition.known.counts.things
        return {
            (Mode(mode), DriverState(driver), counts[combs])
            for mode, driver, combs in zip(*(column.tolist() for column in found), strict=True)
        }


def _twice(held: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return np.concatenate((held, np.zeros_like(held)))


def explore(configuration: Configuration, limit_s: float = 1e9, show: bool = False) -> Explored:
    """All states from the first on, the nearest first, until none is new, an invariant fails or the time is over."""
    found, begin_s = Explored(), time.monotonic()
    search = Search(configuration)
    told_s, told = 0.0, MISSING
    try:
        search.begin()
        while told != 0 and time.monotonic() - begin_s < limit_s:
            told = search.go_on()
            if told == MISSING:
                search.composition.resolve()
            elif told == FULL:
                search.grow()
            elif told == VIOLATED:
                found.violation, found.story = search.violation()
                break
            if show and time.monotonic() - told_s > 10:
                told_s = time.monotonic()
                print(_progress(search, told_s - begin_s), flush=True)
    except ViolationError as violation:
        found.violation = str(violation)
    composition, cursor = search.composition, search.cursor
    found.states, found.transitions = int(cursor[STATES]), int(cursor[TRANSITIONS])
    found.asked = composition.asked
    found.of_sides = composition.controller.kept.count, composition.node.kept.count
    for name in ("longest", "longest_apart", "longest_high", "longest_unsigned"):
        setattr(found, name, int(composition.rows.rules[name][0]))
    found.has_put_out = bool(composition.rows.nodes["bits"].any())
    found.has_signed = bool(composition.rows.frame_labels["is_signature"].any())
    found.is_complete = told == 0
    found.met = search.met()
    if found.is_complete:
        _look_at_the_whole(search, found)
    found.seconds = time.monotonic() - begin_s
    return found


def _progress(search: Search, seconds: float) -> str:
    composition, cursor = search.composition, search.cursor
    return (
        f"{cursor[NUMBER]} of {cursor[STATES]} states left in every way, {composition.asked} questions to "
        f"{composition.controller.kept.count} + {composition.node.kept.count} states of the sides, {seconds:.0f} s"
    )


def _look_at_the_whole(search: Search, found: Explored) -> None:
    """What is not true of a state but of all ways from it: a way back from everywhere, and no start-up for ever."""
    endless = first_start_without_end(search.store, found.states)
    lost = first_without_a_way_back(search.store, found.states)
    if endless >= 0:
        found.violation = "a start-up can go on for ever from here"
        found.story = search.way_to(endless)
    elif lost >= 0:
        found.violation = "from here no way leads back to a closed loop without power off or another fault"
        found.story = search.way_to(lost)


def report(name: str, seconds: float, show: bool = False) -> tuple[str, dict[str, Any]]:
    """Explores one configuration; returns what a person reads, and the figures."""
    configuration = CONFIGURATIONS[name]
    found = explore(configuration, seconds, show=show)
    words = (
        f"{name}: {found.states} states, {found.transitions} transitions, {found.seconds:.0f} s, "
        f"{found.asked} questions to {found.of_sides[0]} + {found.of_sides[1]} states of the sides, "
        f"{'fixed point' if found.is_complete else 'NOT COMPLETE'}, 0 V {found.longest} ticks after a decision, "
        f"gate and combs apart for {found.longest_apart}, outputs low after {found.longest_high}, "
        f"{found.longest_unsigned} ticks without a signature"
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
        most_first = sorted(arguments.name, key=lambda name: -CONFIGURATIONS[name].faults)
        waiting = {pool.submit(report, name, arguments.seconds, arguments.show): name for name in most_first}
        for done in as_completed(waiting):
            words, figures[waiting[done]] = done.result()
            print(words, flush=True)
    if arguments.figures:
        arguments.figures.write_text(json.dumps(figures, indent=2, sort_keys=True) + "\n")
    return 0 if all(figures[name]["complete"] and not figures[name]["violation"] for name in arguments.name) else 1


if __name__ == "__main__":
    sys.exit(main())
