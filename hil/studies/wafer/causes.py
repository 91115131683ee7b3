"""What makes figures differ, and what most reduces the share that works.

Two answers, on devices of wafers of their own, so that they are independent of each other:

- Sobol's total indices (Jansen: Computer Physics Communications 117 (1999) 35): the part of a figure's variance that is
  left when all but one quantity are known. The quantities are those of the process file, each with all its random
  numbers, and the place on the wafer.
- The share of devices that work if a quantity had no spread at all and kept its mean: what could be gained at most.

Of devices in a closed loop there are the indices alone (``loop_causes``): a run takes a thousand times as long.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
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
class Indices:
    """By cause (rows: ``names``) and figure (columns: ``figures``)."""

    names: tuple[str, ...]
    figures: tuple[str, ...]
    total: Array
    """Sobol's total index, 0 to 1; 0 for a figure that does not differ"""
    error: Array
    """its standard error"""

    def as_json(self) -> dict[str, dict[str, list[float]]]:
        """Plain data: of each figure the index of each cause and its standard error."""
        return {
            figure: {name: [float(self.total[i, k]), float(self.error[i, k])] for i, name in enumerate(self.names)}
            for k, figure in enumerate(self.figures)
        }


@dataclass(frozen=True)
class Causes:
    """What is asked of devices without a loop."""

    indices: Indices
    """of each required figure, and last of whether all are met"""
    share: float
    """that works, of these devices"""
    share_without: dict[str, float]
    """that would work if a quantity had no spread; by quantity"""

    def as_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "share": self.share,
            "share_without": self.share_without,
            "total_index_and_error": self.indices.as_json(),
        }


def causes(study: WaferStudy, count: int, on_progress: Callable[[int, int], None] = lambda done, total: None) -> Causes:
    """From ``count`` devices, and as many again for each cause, twice."""
    names = causes_of(study)
    spread = names[1:]
    wanted = (*study.process.requirements, ALL)
    a, b = independent(study, 0, count), independent(study, count, count)
    steps = len(names) + len(spread) + 2

    def look(asked: WaferStudy, sampled: Sampled, done: int) -> Array:
        found = figures(asked.stage, asked.as_drawn, asked.made(sampled))
        on_progress(done, steps)
        works = asked.verdicts(found)["ok"]
        return np.stack([*(np.nan_to_num(found[name], posinf=_INFINITE) for name in wanted[:-1]), works])

    of_a, of_b = look(study, a, 1), look(study, b, 2)
    of_mixed = np.stack([look(study, mixed(a, b, name), 3 + k) for k, name in enumerate(names)])
    without = [look(_without(study, name), a, 3 + len(names) + k)[-1].mean() for k, name in enumerate(spread)]
    return Causes(
        indices(names, wanted, of_a, of_b, of_mixed), float(of_a[-1].mean()), dict(zip(spread, without, strict=True))
    )


def indices(names: tuple[str, ...], wanted: tuple[str, ...], of_a: Array, of_b: Array, of_mixed: Array) -> Indices:
    """From figures (figures, n) of two sets of devices, and (causes, figures, n) of the first one's with a cause from
    the second.
    """
    squares = 0.5 * (of_a - of_mixed) ** 2
    variance = np.var(np.concatenate([of_a, of_b], axis=1), axis=1)
    scale = np.where(variance > 0.0, variance, np.inf)
    error = squares.std(axis=2) / np.sqrt(of_a.shape[1]) / scale
    return Indices(names, wanted, squares.mean(axis=2) / scale, error)


def causes_of(study: WaferStudy) -> tuple[str, ...]:
    """``PLACE``, and all that a process spreads."""
    return (PLACE, *(name for name in SOURCES if _spreads(study, name)))


def _spreads(study: WaferStudy, name: str) -> bool:
    s = getattr(study.process, name)
    return any((s.wafer, s.tilt, s.bowl, s.die, s.chain))


def independent(study: WaferStudy, first: int, count: int) -> Sampled:
    """Devices of as many wafers that no table has, on each another die."""
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


def mixed(a: Sampled, b: Sampled, name: str) -> Sampled:
    """a, with one cause from b."""
    if name == PLACE:
        return replace(a, place_m=b.place_m)
    return replace(a, deviates={**a.deviates, name: b.deviates[name]})


def _without(study: WaferStudy, name: str) -> WaferStudy:
    """The study of a process in which a quantity does not differ."""
    still = Spread(mean=getattr(study.process, name).mean)
    return replace(study, process=study.process.model_copy(update={name: still}))
