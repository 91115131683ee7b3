"""A stage that holds for long: what decays in the law's memory must not fall below the normal numbers, with which a PC
takes several times as long for a tick (7 us in place of 2, as was found).
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hil.bench.rigs.motions import GENTLE, MIDDLE_M, setup_of
from hil.lanes.fast import run_block
from pkxyz_ctrl.loop.cycle import new_memory
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.trajectory import Hold, Move

LAWS = sorted(path.stem for path in (Path(__file__).parents[2] / "configs" / "controllers").glob("*.toml"))
TICKS = 30_000  # 6 s
LEAST = np.finfo(np.float64).tiny


def numbers(records: NDArray[np.void], name: str = "") -> Iterator[tuple[str, NDArray[np.float64]]]:
    """All doubles of a record, by the names of their fields."""
    for field in records.dtype.names or ():
        held, inner = records[field], f"{name}.{field}"
        if held.dtype.names:
            yield from numbers(held, inner)
        elif held.dtype == np.float64:
            yield inner, held


def too_small(records: NDArray[np.void]) -> list[str]:
    return [name for name, held in numbers(records) if ((held != 0) & (np.abs(held) < LEAST)).any()]


@pytest.mark.parametrize("law", [law for law in LAWS if law not in ("mpc", "robust_20k")])
def test_six_seconds_behind_a_move_nothing_is_below_the_normal_numbers(law: str) -> None:
    move = Move(kind="move", to_m=(5e-6, -3e-6, MIDDLE_M), **GENTLE)
    segments = [Hold(kind="hold", duration_s=0.05), move, Hold(kind="hold", duration_s=0.2)]
    setup, _ = setup_of(segments, law, "nominal", MIDDLE_M)
    memory, plant = new_memory(Mode.IDLE), setup.new_plant()
    rows, sample_us = np.zeros(TICKS, ROW), np.arange(TICKS, dtype=np.int64) * setup.bus.period_us
    reference = reference_rows(setup.trajectory.sample(0, setup.ticks + 30, setup.bus.period_us))
    run_block(setup.law, memory, reference, plant.params, plant.state, sample_us, rows, TICKS)
    assert rows["mode"][-1] == Mode.TRACKING
    assert too_small(memory) == []


def test_what_is_too_small_is_found() -> None:
    memory = new_memory(Mode.IDLE)
    assert len(list(numbers(memory))) > 20
    assert too_small(memory) == []
    memory["tick"]["adaptation"]["sensitivity"][0, 2, 1, 13] = 5e-324
    assert too_small(memory) == [".tick.adaptation.sensitivity"]
