"""One measured figure, and the stopwatch behind it."""

import gc
import statistics
import time
import timeit
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

Direction = Literal["at most", "at least"]


@dataclass(frozen=True)
class Figure:
    """A figure with what it is held to. ``median`` is None where there is but one measurement."""

    name: str
    """group.what, such as ``tick.call``"""
    value: float
    """best of the repeats: on a machine with other work, noise only ever adds"""
    unit: str
    target: float | None = None
    """None: measured for context only"""
    direction: Direction | None = None
    median: float | None = None
    detail: str = ""

    @property
    def met(self) -> bool | None:
        """Whether the value keeps the target; None without one."""
        if self.target is None:
            return None
        return self.value <= self.target if self.direction == "at most" else self.value >= self.target

    def as_json(self) -> dict[str, Any]:
        """Plain data, for JSON."""
        return {
            "name": self.name,
            "value": self.value,
            "unit": self.unit,
            "target": self.target,
            "direction": self.direction,
            "met": self.met,
            "median": self.median,
            "detail": self.detail,
        }


class Times(NamedTuple):
    """Processor time of one thing over several repeats, in s."""

    best_s: float
    median_s: float

    def per(self, count: int) -> tuple[float, float]:
        """Best and median in us for each of ``count`` things done."""
        return self.best_s / count * 1e6, self.median_s / count * 1e6


def times_of(seconds: list[float]) -> Times:
    """Best and median of ``seconds``."""
    return Times(min(seconds), statistics.median(seconds))


def once(run: Callable[[], object]) -> float:
    """Processor time of ``run()`` in s, all threads of this process, garbage collected beforehand and not during."""
    gc.collect()
    enabled = gc.isenabled()
    gc.disable()
    try:
        begin = time.process_time()
        run()
        return time.process_time() - begin
    finally:
        if enabled:
            gc.enable()


def repeated(runs: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, Times]:
    """Processor times of several things, taken in turn, so that all of them see the same machine.

    What was there before is no garbage and is not looked through between them: that would empty the processor's caches,
    which no study does between two runs.
    """
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    gc.collect()
    gc.freeze()
    try:
        for _ in range(repeats):
            for name, run in runs.items():
                seconds[name].append(once(run))
    finally:
        gc.unfreeze()
    return {name: times_of(taken) for name, taken in seconds.items()}


def calls(statements: Mapping[str, str], names: dict[str, Any], number: int, repeats: int) -> dict[str, Times]:
    """Processor time in s of ONE execution of each statement, which sees ``names``; less that of an empty loop."""
    timers = {what: timeit.Timer(text, globals=names, timer=time.process_time) for what, text in statements.items()}
    empty = timeit.Timer("pass", timer=time.process_time)
    loop_s = min(empty.repeat(5, number)) / number
    seconds: dict[str, list[float]] = {what: [] for what in statements}
    for timer in timers.values():
        timer.timeit(max(1, number // 10))  # compiled, in the caches, branches learnt
    for _ in range(repeats):
        for what, timer in timers.items():
            seconds[what].append(timer.timeit(number) / number - loop_s)
    return {what: times_of(taken) for what, taken in seconds.items()}
