"""Samples the path ahead of a native loop, block after block: some seconds of it, which no process stands still for."""

import numpy as np
from numpy.typing import NDArray

from hil.lanes.blocks import PREVIEW_ROWS
from hil.lanes.setup import Setup
from hil.lanes.streamed_reference import write_sampled
from pkxyz_ctrl.export.shared import AHEAD_ROWS, BLOCK_ROWS

assert AHEAD_ROWS >= PREVIEW_ROWS, "what a law looks ahead stands in the block in which it begins to look"


class PathFeeder:
    """Fills ``blocks`` (n,) of ``PATH``. The loop is in the first of them that stand there, or behind it."""

    def __init__(self, setup: Setup, blocks: NDArray[np.void]) -> None:
        self._setup, self._blocks = setup, blocks
        self._last = -(-setup.ticks // BLOCK_ROWS)
        self._next = 0
        self.feed(0)

    def feed(self, reference_tick: int) -> None:
        """Sample what there is room for, now that the loop has come to ``reference_tick``."""
        end = min(reference_tick // BLOCK_ROWS + len(self._blocks), self._last + 1)
        while self._next < end:
            block, first = self._blocks[self._next % len(self._blocks)], self._next * BLOCK_ROWS
            block["number"] = -1
            write_sampled(
                block["rows"], self._setup.trajectory, first, self._setup.bus.period_us, self._setup.excitation
            )
            block["number"] = self._next
            self._next += 1
