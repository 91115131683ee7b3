"""What makes figures differ, and what most reduces the share that works.

Two answers, on devices of wafers of their own, so that they are independent of each other:

- Sobol's total indices (``scipy.stats.sobol_indices``, Saltelli et al. 2010): the part of a figure's variance that is
  left when all but one quantity are known. The quantities are those of the process file, each with all its random
  numbers, and the place on the wafer.
- The share of devices that work if a quantity had no spread at all and kept its mean: what could be gained at most.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.stats
from numpy.typing import NDArray

from hil.studies.wafer.study import WaferStudy, spread_die
from pkxyz_ctrl.fabrication.figures import figures
from pkxyz_ctrl.fabrication.process import SOURCES, Spread
from pkxyz_ctrl.fabrication.wafer import Deviates, Sampled, dies_per_wafer, sample_wafers

Array = NDArray[np.float64]

PLACE = "place"
"""Where on the wafer a device lies, which bowls and tilts make into a cause."""
ALL = "ok"
"""Whether a device meets every requirement: 1 or 0."""
_INFINITE = 1e6
"""What stands for a voltage that is none."""
_FRESH = 1 << 32
"""Wafers from here on belong to this question: none of them is in a study's table."""


@dataclass(frozen=True)
class Causes:
    """By cause (rows: ``names``) and required figure (columns: ``figures``, the last one whether all are met)."""

    names: tuple[str, ...]
    figures: tuple[str, ...]
    total: Array
    """Sobol's total index, 0 to 1; 0 for a figure that does not differ"""
    error: Array
    """its standard error"""
    share: float
    """that works, of these devices"""
    share_without: dict[str, float]
    """that would work if a quantity had no spread; by quantity"""

    def as_json(self) -> dict[str, Any]:
        """Plain data: of each figure the index of each cause and its standard error."""
        index = {
            figure: {name: [float(self.total[i, k]), float(self.error[i, k])] for i, name in enumerate(self.names)}
            for k, figure in enumerate(self.figures)
        }
        return {"share": self.share, "share_without": self.share_without, "total_index_and_error": index}


def causes(study: WaferStudy, count: int, on_progress: Callable[[int, int], None] = lambda done, total: None) -> Causes:
    """From ``count`` devices, and as many again for each cause, twice."""
    spread = tuple(name for name in SOURCES if _spreads(study, name))
    names = (PLACE, *spread)
    wanted = (*study.process.requirements, ALL)
    a, b = _independent(study, 0, count), _independent(study, count, count)
    steps = len(names) + len(spread) + 2

    def look(asked: WaferStudy, sampled: Sampled, done: int) -> Array:
        found = figures(asked.stage, asked.as_drawn, asked.made(sampled))
        on_progress(done, steps)
        works = asked.verdicts(found)["ok"]
        return np.stack([*(np.nan_to_num(found[name], posinf=_INFINITE) for name in wanted[:-1]), works])

    of_a, of_b = look(study, a, 1), look(study, b, 2)
    mixed = np.stack([look(study, _mixed(a, b, name), 3 + k) for k, name in enumerate(names)])
    without = [look(_without(study, name), a, 3 + len(names) + k)[-1].mean() for k, name in enumerate(spread)]
    sobol = scipy.stats.sobol_indices(func={"f_A": of_a, "f_B": of_b, "f_AB": mixed}, n=count)
    squares = 0.5 * (of_a - mixed) ** 2
    variance = np.var(np.concatenate([of_a, of_b], axis=1), axis=1)
    error = squares.std(axis=2) / np.sqrt(count) / np.where(variance > 0.0, variance, np.inf)
    return Causes(
        names, wanted, sobol.total_order.T, error, float(of_a[-1].mean()), dict(zip(spread, without, strict=True))
    )


def _spreads(study: WaferStudy, name: str) -> bool:
    s = getattr(study.process, name)
    return any((s.wafer, s.tilt, s.bowl, s.die, s.chain))


def _independent(study: WaferStudy, first: int, count: int) -> Sampled:
    """Devices of as many wafers, on each another die."""
    dies = dies_per_wafer(study.process)
    found = []
    for begin in range(0, count, 64):
        some = min(64, count - begin)
        sampled = sample_wafers(study.process, study.seed, range(_FRESH + first + begin, _FRESH + first + begin + some))
        found.append(sampled.take(np.arange(some) * dies + spread_die(first + begin + np.arange(some), dies)))
    deviates = {name: _joined([d.deviates[name] for d in found]) for name in SOURCES}
    return Sampled(np.concatenate([d.device for d in found]), np.concatenate([d.place_m for d in found]), deviates)


def _joined(parts: list[Deviates]) -> Deviates:
    return Deviates(*(np.concatenate([vars(p)[f] for p in parts]) for f in ("wafer", "tilt", "die", "chain")))


def _mixed(a: Sampled, b: Sampled, name: str) -> Sampled:
    """a, with one cause from b."""
    if name == PLACE:
        return replace(a, place_m=b.place_m)
    return replace(a, deviates={**a.deviates, name: b.deviates[name]})


def _without(study: WaferStudy, name: str) -> WaferStudy:
    """The study of a process in which a quantity does not differ."""
    still = Spread(mean=getattr(study.process, name).mean)
    return replace(study, process=study.process.model_copy(update={name: still}))
