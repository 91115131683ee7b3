"""A loop that is excited about a point, in any lane, and what was seen at each tick of its trajectory.

At the machine's clock a tick may be missed: the excitation stands still meanwhile, so its period is spoilt, and so is
one that begins before the loop has settled again. They are left out.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hil.lanes import in_process
from hil.lanes.at_rate import run_at_rate
from hil.lanes.excitation import Excitation
from hil.lanes.lane import Lane
from hil.lanes.setup import Setup
from pkxyz_ctrl.design.law_about import law_about
from pkxyz_ctrl.design.margins.settling import settling_ticks
from pkxyz_ctrl.design.model.discrete_law import LawError
from pkxyz_ctrl.design.model.loop_plant import NOMINAL, Perturbation, loop_plant
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.monitors import UNUSABLE
from pkxyz_ctrl.stage import Stage
from pkxyz_ctrl.trajectory import Hold, Move, Trajectory

Array = NDArray[np.float64]

REACH_S = 0.5
"""Time to get to the point and come to rest there."""

PERIODS_LEAST = 3
"""Undisturbed ones of each passage: their spread says how well their mean is known."""

Tones = Literal["multisine", "stepped"]
"""All at once, or one after another."""

HARDLY_DAMPED = 200.0
"""Quality factor of a device in coarse vacuum, whose transients last longest."""

_AT_RATE = 4
"""Parts into which a second is divided where ticks may be missed: a shorter period is sooner undisturbed."""


class MeasurementError(RuntimeError):
    """The loop did not stay closed while it was measured; the message says what happened."""


@dataclass(frozen=True)
class Excited:
    """What came of an excitation."""

    excitation: Excitation
    seen: dict[str, Array]
    """(ticks, 3) of each field that was asked for, by tick of the trajectory"""
    periods: tuple[NDArray[np.int64], ...]
    """of each passage, as many undisturbed ones as of each other passage"""
    homing_count: NDArray[np.int32]
    """(n, 3) sense counts while the stage was at rest"""
    last: np.void
    """row of the last tick that was tracked"""
    missed_ticks: int
    """skipped or without a sense frame, while it was excited"""


def periods_of(kind: Tones, lane: Lane, periods: int) -> tuple[float, int]:
    """How long a period is, in s, and how many are to be measured where ``periods`` were asked for. A tone alone needs
    no resolution.
    """
    if kind == "stepped":
        return 0.1, periods
    return (1.0 / _AT_RATE, _AT_RATE * periods) if lane == Lane.WALL else (1.0, periods)


def at_point(setup: Setup, strokes_m: Array, excitation: Excitation) -> Setup:
    """The setup that goes to the position of ``strokes_m`` (3,), and is excited there; its own trajectory is dropped.
    ``excitation.first_tick`` is put to when it has come to rest.
    """
    position = Stage(setup.stage).forward_kinematics(strokes_m)
    to = (float(position[0]), float(position[1]), float(position[2]))
    first = round(REACH_S / setup.bus.period_s)
    placed = replace(excitation, first_tick=first)
    there = Move(kind="move", to_m=to, velocity_max_m_per_s=1e-3, acceleration_max_m_per_s2=1.0, jerk_max_m_per_s3=1e3)
    rest = Hold(kind="hold", duration_s=(placed.ticks + 1) * setup.bus.period_s)
    started_s = setup.controller.homing_s + 0.1  # the amplifier, homing, and some ticks to enable and track
    return replace(
        setup,
        trajectory=Trajectory([there, rest]),
        duration_s=started_s + (placed.ticks + 1) * setup.bus.period_s,
        excitation=placed,
    )


def excite(
    setup: Setup,
    lane: Lane,
    fields: tuple[str, ...],
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    say: Callable[[str], object] = lambda words: None,
) -> Excited:
    """Run a setup of ``at_point`` in a lane, and keep some ``fields`` of ``ROW``.

    At the machine's clock ``say`` is told what a person should know; ``on_progress`` is called each tick there, and has
    to be quick. Raises ``MeasurementError`` where the loop did not stay closed to the end, or too few periods went
    undisturbed.
    """
    excitation = setup.excitation
    if excitation is None:
        raise ValueError("there is nothing to measure without an excitation")
    seen = {name: np.full((excitation.ticks, 3), np.nan) for name in fields}
    spoilt = np.zeros(excitation.ticks, np.bool_)
    homing: list[NDArray[np.int32]] = []
    last: list[np.void] = []

    def on_block(block: NDArray[np.void]) -> None:
        tick = block["reference_tick"]
        tracked = (tick >= 0) & (tick < excitation.ticks)
        for name, values in seen.items():
            values[tick[tracked]] = block[name][tracked]
        spoilt[tick[tracked]] |= ((block["overrun"] > 0) | (block["sense_status"] & int(UNUSABLE) != 0))[tracked]
        homing.append(block["sense_count"][block["mode"] == Mode.HOMING].copy())
        if tracked.any():
            last[:] = [block[tracked][-1].copy()]

    faults: tuple[str, ...]
    if lane == Lane.WALL:
        rows, faults = run_at_rate(setup, say, on_progress)
        on_block(rows)
    else:
        faults = in_process.run(setup, lane, on_block=on_block, on_progress=on_progress).faults
    if faults:
        raise MeasurementError(f"the loop opened while it was measured: {faults[0]}")
    closed = np.isfinite(next(iter(seen.values()))[:, 0])
    if not closed.all():
        raise MeasurementError(f"the loop was closed for {closed.sum()} of {len(closed)} ticks only")
    missed = int(spoilt[excitation.first_tick :].sum())
    settling = _settling_ticks(setup, last[0]["reference_m"], excitation.period_ticks) if missed else 0
    periods = _periods(excitation, spoilt, settling, missed)
    return Excited(excitation, seen, periods, np.concatenate(homing), last[0], missed)


def _settling_ticks(setup: Setup, position_m: Array, else_ticks: int) -> int:
    """Until nothing is left of what a missed tick stirred up: of the loop as drawn, or of the same hardly damped. Where
    one of these would not be stable, ``else_ticks``: the stage is another, since its loop was closed.
    """
    stage = Stage(setup.stage)
    strokes = stage.inverse_kinematics(position_m)
    law = law_about(stage, setup.law, strokes)
    try:
        return max(
            settling_ticks(loop_plant(stage, setup.bus, strokes, change), law)
            for change in (NOMINAL, Perturbation(quality_factor=HARDLY_DAMPED))
        )
    except LawError:
        return else_ticks


def _periods(
    excitation: Excitation, spoilt: NDArray[np.bool_], settling: int, missed: int
) -> tuple[NDArray[np.int64], ...]:
    each = [excitation.undisturbed(n, spoilt, settling) for n in range(len(excitation.passages))]
    count = min(len(periods) for periods in each)
    if count < PERIODS_LEAST:
        raise MeasurementError(
            f"{missed} ticks were missed, which leaves {count} undisturbed periods of an axis, and {PERIODS_LEAST} are "
            "needed: raise --periods, end other programs, or take a slower --bus"
        )
    return tuple(periods[:count] for periods in each)
