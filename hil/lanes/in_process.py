"""The two lanes in which a scenario runs: over the simulated bus in lockstep, or composed in one compiled loop."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.bus.frame_time import INTERFRAME_BITS, frame_duration_ns
from hil.lanes.blocks import Blocks
from hil.lanes.fast import RunBlock, runner_of
from hil.lanes.lane import Lane
from hil.lanes.lockstep import LockstepRig
from hil.lanes.setup import Setup
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.learning import Learner
from pkxyz_ctrl.loop.cycle import new_memory
from pkxyz_ctrl.loop.reference import standing_still
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.trips import explain
from sim.plant import Plant

Instants = NDArray[np.int64]

_FAULT = int(Mode.FAULT)


@dataclass(frozen=True)
class LaneResult:
    """What a lane knows of a run besides its rows."""

    ticks: int
    missed_ticks: int
    """skipped, without a sense frame, or with a drive frame that was late on the wire"""
    bus_load: float | None
    """0..1 over the ticks; None without a bus"""
    faults: tuple[str, ...]
    realtime_factor: float
    """stage time over the machine's time"""
    learner: Learner | None = None
    """what was learnt, where the run learns"""
    protections_lacking: tuple[str, ...] = ()
    """that the amplifier does not give, and what replaces each"""
    adaptation: NDArray[np.void] | None = None
    """(1,) of ``core.adaptation.ADAPTATION_STATE`` in the end: what was learnt of the device"""


def run(
    setup: Setup,
    lane: Lane,
    *,
    on_block: Callable[[NDArray[np.void]], None],
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    frame_log: Path | None = None,
    whole_ticks: bool = True,
) -> LaneResult:
    """Run a setup in lockstep or in the fast lane.

    ``on_block`` gets the rows (n,) of ``ROW`` in order and must not keep them; ``on_progress`` the ticks done and in
    all; ``whole_ticks`` is the lockstep rig's. What was run before an exception (Ctrl-C) has been handed on. Raises
    ``ConfigError`` for a bus that the lane can't use and ``StartUpError`` where the amplifier doesn't start.
    """
    learner = setup.new_learner()
    blocks = Blocks(
        setup.trajectory, setup.bus.period_us, setup.ticks, on_block, on_progress, setup.excitation, learner
    )
    law, lost = setup.law, tuple[str, ...]()
    if lane == Lane.FAST:
        plant, memory = setup.new_plant(), new_memory(Mode.IDLE)
        run_block = runner_of(law, None if setup.triggers is None else setup.new_outputs())
        run_block(law, memory, standing_still(), plant.params, plant.state, np.zeros(0, np.int64), blocks.rows, 0)
        instants_us(setup, 0, 0)
        begin_s = time.perf_counter()
        missed, load, faults = 0, None, _run_fast(setup, run_block, memory, plant, blocks)
    elif lane == Lane.LOCKSTEP:
        rig = LockstepRig(setup, frame_log, whole_ticks=whole_ticks)
        begin_s = time.perf_counter()  # designed, wired up and loaded: what is timed from here is the run
        missed, load = rig.run(blocks)
        faults, memory, lost = rig.controller.faults, rig.controller.memory, rig.controller.driver.lost
    else:
        raise ValueError(f"the {lane} lane waits for a clock: hil.lanes.wall")
    factor = setup.ticks * setup.bus.period_s / (time.perf_counter() - begin_s)
    adaptation = memory["tick"]["adaptation"]
    return LaneResult(setup.ticks, missed, load, tuple(faults), factor, learner, lost, adaptation)


def _run_fast(setup: Setup, run_block: RunBlock, memory: NDArray[np.void], plant: Plant, blocks: Blocks) -> list[str]:
    faults: list[str] = []
    law, mode = setup.law, int(Mode.IDLE)
    while count := blocks.next_count(memory):
        reference = blocks.reference(memory)
        at_us = instants_us(setup, blocks.done, count)
        run_block(law, memory, reference, plant.params, plant.state, at_us, blocks.rows, count)
        modes = blocks.rows["mode"][:count]
        if (modes == _FAULT).any():
            is_fault = np.r_[mode, modes] == _FAULT
            entered = np.flatnonzero(is_fault[1:] & ~is_fault[:-1])
            faults += [f"at {row['t_us'] * 1e-6:.4f} s: {explain(int(row['trips']))}" for row in blocks.rows[entered]]
        mode = int(modes[-1])
        blocks.hand_on(count)
    return faults


def instants_us(setup: Setup, first: int, count: int) -> Instants:
    """Plant time of the samples: end of each tick's SYNC (its length depends on its counter), since the first one."""
    can = setup.bus.can
    if can is None:
        return np.arange(first, first + count, dtype=np.int64) * setup.bus.period_us
    nominal = can.nominal_bitrate_bit_per_s
    data = can.data_bitrate_bit_per_s or nominal
    return _sync_us(nominal, data, can.driver.fd, setup.bus.period_us, first, count)


@lru_cache(maxsize=16)
def _sync_us(nominal_bit_per_s: int, data_bit_per_s: int, fd: bool, period_us: int, first: int, count: int) -> Instants:
    """Nobody writes to them: a study runs on one bus again and again."""
    tick, end_us = np.arange(first, first + count, dtype=np.int64), _sync_end_us(nominal_bit_per_s, data_bit_per_s, fd)
    return tick * period_us + end_us[tick % len(end_us)] - end_us[0]


@cache
def _sync_end_us(nominal_bit_per_s: int, data_bit_per_s: int, fd: bool) -> NDArray[np.int64]:
    """(240,) by counter less 1, since the SYNC's start."""
    gap_ns = INTERFRAME_BITS * 1_000_000_000 // nominal_bit_per_s
    frames = (Frame(0x080, bytes((n + 1,)), fd, fd) for n in range(240))
    ends_ns = [frame_duration_ns(sync, nominal_bit_per_s, data_bit_per_s) - gap_ns for sync in frames]
    return np.array([-(-end_ns // 1000) for end_ns in ends_ns], np.int64)
