"""What makes devices differ in a closed loop: Sobol's total indices of Ms, rejection, error and verdict under each law.

Devices of two sets and, for each cause, those of the first set with this cause from the second, all in the loop: parts
of a table, which is kept and goes on as that of other devices. What is random in a run is the first set's, so noise is
no cause.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.studies.wafer.causes import Indices, causes_of, independent, indices, mixed
from hil.studies.wafer.closed_loop import PART_DEVICES, ClosedLoops
from hil.studies.wafer.table import Table
from pkxyz_ctrl.config import files as config

Array = NDArray[np.float64]

_SECOND = 1 << 30
"""Wafers from here on, of those that no table has, are the second set's."""


@dataclass(frozen=True)
class LoopCauses:
    """Blocks of ``PART_DEVICES`` devices; of each a part for every set."""

    loops: ClosedLoops

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Causes."""
        return causes_of(self.loops.wafers)

    @property
    def figures(self) -> tuple[str, ...]:
        """Figures of each law, and whether it meets all that is asked of it."""
        return (*self.loops.columns, *(f"ok.{law}" for law in self.loops.laws))

    @property
    def together(self) -> int:
        """Parts that a worker is handed at most."""
        return self.loops.together

    def digest(self) -> str:
        """Of all that decides about a part."""
        return config.digest({"causes of": self.loops.digest()})

    def parts_for(self, devices: int) -> int:
        """How many parts hold the sets of so many devices, in whole blocks."""
        return -(-devices // PART_DEVICES) * self._sets

    @property
    def _sets(self) -> int:
        return len(self.names) + 2

    def part(self, number: int) -> dict[str, NDArray[Any]]:
        """Figures of a set's devices in a block: the first set, the second, then one for each cause."""
        block, of = divmod(number, self._sets)
        first, second = (
            independent(self.loops.wafers, begin + block * PART_DEVICES, PART_DEVICES) for begin in (0, _SECOND)
        )
        sampled = (first, second)[of] if of < 2 else mixed(first, second, self.names[of - 2])
        found = self.loops.judged(sampled)
        rows = number * PART_DEVICES
        return {"device": np.arange(rows, rows + PART_DEVICES)} | {name: found[name] for name in self.figures}

    def found(self, table: Table) -> Indices | None:
        """From the blocks that are whole, first to last; None where there are none. An endless figure counts as the
        largest that is not: what it says is in the verdict.
        """
        there = table.parts
        whole = next(block for block in range(len(there) + 1) if not there.issuperset(self._block(block)))
        if whole == 0:
            return None
        rows = table.read(self.figures, whole * self._sets * PART_DEVICES)
        shape = (whole, self._sets, PART_DEVICES)
        each = np.stack([_bounded(rows[name]).reshape(shape) for name in self.figures])
        sets = each.transpose(2, 0, 1, 3).reshape(self._sets, len(self.figures), -1)
        return indices(self.names, self.figures, sets[0], sets[1], sets[2:])

    def _block(self, block: int) -> range:
        return range(block * self._sets, (block + 1) * self._sets)


def _bounded(values: NDArray[Any]) -> Array:
    numbers = values.astype(np.float64)
    finite = numbers[np.isfinite(numbers)]
    return np.asarray(np.minimum(numbers, finite.max() if len(finite) else 0.0))
