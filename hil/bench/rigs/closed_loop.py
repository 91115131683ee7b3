"""A stretch of the default scan as it went in closed loop, to be replayed: what stood before it, and what happened."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from hil.lanes.blocks import PREVIEW_ROWS
from hil.lanes.fast import run_block
from hil.lanes.setup import Setup
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.loop.cycle import new_memory
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Mode
from sim.plant import Plant

SCAN_S = 0.1
"""Length of the stretch."""


@dataclass(frozen=True)
class ClosedLoop:
    """The first ``SCAN_S`` of the default scenario's scan, sampled every period exactly."""

    setup: Setup
    reference: NDArray[np.void]
    """rows (n, 9) of the whole trajectory"""
    memory: NDArray[np.void]
    """(1,) of ``cycle.MEMORY`` before the first tick; a copy of it is what a replay works on"""
    plant_state: NDArray[np.void]
    """(1,) of the plant's state when the first sample has been taken"""
    rows: NDArray[np.void]
    """(ticks,) of ``ROW``"""

    def plant(self) -> Plant:
        """A plant as it stood at the first sample."""
        plant = self.setup.new_plant()
        plant.state[:] = self.plant_state
        return plant


@cache
def scan() -> ClosedLoop:
    """Run the default scenario in one compiled loop up to its scan, and through ``SCAN_S`` of it."""
    setup = load_scenario("raster").setup()
    period_us = setup.bus.period_us
    begins_us = min(s.scan_us[0] for s in setup.trajectory.segments if s.scan_us)
    count = round(SCAN_S * 1e6 / period_us)
    reference = reference_rows(setup.trajectory.sample(0, setup.ticks + PREVIEW_ROWS, period_us))
    law, plant, memory = setup.law, setup.new_plant(), new_memory(Mode.IDLE)
    rows = np.zeros(1, ROW)

    def run(ticks: int) -> None:
        # the next sample is due when the plant is where it is, the following ones a period apart
        sample_us = plant.t_us + period_us * np.arange(1, ticks + 1, dtype=np.int64)
        run_block(law, memory, reference, plant.params, plant.state, sample_us, rows, ticks)

    for _ in range(setup.ticks):
        if rows["reference_tick"][0] * period_us >= begins_us:
            break
        run(1)
    else:
        raise RuntimeError("the default scenario never came to its scan")
    before, state = memory.copy(), plant.state.copy()
    rows = np.zeros(count, ROW)
    run(count)
    return ClosedLoop(setup, reference, before, state, rows)
