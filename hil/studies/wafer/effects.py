"""What one standard deviation of each source makes of a device: a drawing's weak points, and what it bears."""

import math
from collections.abc import Callable
from dataclasses import replace

from hil.studies.wafer.closed_loop import ClosedLoops
from pkxyz_ctrl.fabrication.process import SOURCES, Spread

MEAN = "mean"
"""Name of the device with nothing off."""


def standard_deviation(spread: Spread) -> float:
    """Of all dies of all wafers, chains taken as one: wafers, a slope and a bowl over an even area, dies."""
    parts = (spread.wafer, spread.tilt / math.sqrt(2.0), spread.bowl / math.sqrt(12.0), spread.die)
    return math.hypot(*parts, spread.chain / math.sqrt(3.0))


def effects(
    asked: ClosedLoops, on_progress: Callable[[int, int], None] = lambda done, total: None
) -> dict[str, dict[str, float]]:
    """By source, ``MEAN`` first: figures of a device that is one standard deviation off in it, whichever way is worse
    for the error under the law for the device, and as the process means it in all else. Sources without spread are
    left out.
    """
    still = {name: Spread(mean=getattr(asked.wafers.process, name).mean) for name in SOURCES}
    off = {name: standard_deviation(getattr(asked.wafers.process, name)) for name in SOURCES}
    moved = [name for name in SOURCES if off[name] > 0.0]

    def device(changes: dict[str, Spread]) -> dict[str, float]:
        process = asked.wafers.process.model_copy(update=still | changes)
        there = replace(asked, wafers=replace(asked.wafers, process=process))
        own = there.wafers.alone(0)
        return {k: float(own[k]) for k in process.requirements} | {k: v for k, v in there.device(0).items() if "." in k}

    found = {MEAN: device({})}
    for n, name in enumerate(moved, start=1):
        ways = (device({name: Spread(mean=still[name].mean + sign * off[name])}) for sign in (-1.0, 1.0))
        found[name] = max(ways, key=lambda figures: figures["known.error_about_mean_nm"])
        on_progress(n, len(moved))
    return found
