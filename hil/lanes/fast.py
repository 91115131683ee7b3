"""The fast lane: the same cycle and the same plant in one compiled loop, with the
delays and the quantisation of the bus.

No frames, no gate, no driver: on a fault-free scenario they change no bit, and a test holds the two lanes to that.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from hil.plant.truth import observe
from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.core.demand import PREDICTIVE
from pkxyz_ctrl.loop.cycle import cycle
from pkxyz_ctrl.loop.outputs import decide
from pkxyz_ctrl.loop.period import Period, period_of
from pkxyz_ctrl.loop.reference import standing_still
from sim import kernels

Array = NDArray[np.float64]
Records = NDArray[np.void]
RunBlock = Callable[..., None]
"""``run_block``, or another of its signature."""


def runner_of(law: Records, outputs: Records | None = None) -> RunBlock:
    """What runs blocks of ticks of ``law`` (1,): ``run_block``, or where a law plans in Python the same uncompiled;
    ``outputs`` (1,) of ``outputs.OUTPUTS`` where there are digital ones.
    """
    if law["tick"]["kind"][0] != PREDICTIVE:
        runner: RunBlock = run_block if outputs is None else partial(run_block_with_outputs, outputs)
        return runner
    period = period_of(law, standing_still())
    return partial(run_block_in_steps, period) if outputs is None else partial(run_outputs_in_steps, period, outputs)


@kernel
def meet(
    plant_params: Records, plant_state: Records, due: NDArray[np.int32], row: np.void, sense_count: NDArray[np.int32]
) -> None:
    """The plant at a sample: the truth into ``row``, drive counts ``due`` (3,) to the combs, sense counts (3,) out."""
    observe(plant_params[0], plant_state[0], row)
    kernels.drive(plant_params, plant_state, due)
    kernels.sample(plant_params, plant_state, sense_count)


@kernel
def exchange(
    plant_params: Records,
    plant_state: Records,
    sample_us: int,
    due: NDArray[np.int32],
    row: np.void,
    sense_count: NDArray[np.int32],
) -> None:
    """The plant on to the next sample, and what is exchanged with it there."""
    kernels.advance(plant_params, plant_state, sample_us - plant_state[0]["t_us"])
    meet(plant_params, plant_state, due, row, sense_count)


@kernel
def run_block(
    law: np.void,
    memory: np.void,
    reference: Records,
    plant_params: Records,
    plant_state: Records,
    sample_us: NDArray[np.int64],
    rows: Records,
    count: int,
) -> None:
    """Run ``count`` ticks and write their rows to ``rows[:count]``.

    ``sample_us`` (count,) int64: plant time of each sample. At a sample the drive counts of the last tick are
    applied, as the amplifier does on SYNC, or with two periods of delay those of the tick before it; the truth is
    taken just before them. A row is copied when the plant has moved on: what has just been written in numbers a
    processor can't read in vectors until it stands in the cache.
    """
    seen, row = memory[0]["input"], memory[0]["row"]
    due = memory[0]["tick"]["count"][law[0]["tick"]["delay_periods"] - 1]
    for i in range(count):
        kernels.advance(plant_params, plant_state, sample_us[i] - plant_state[0]["t_us"])
        if i > 0:
            rows[i - 1] = row
        meet(plant_params, plant_state, due, row, seen["sense_count"])
        cycle(law, memory, reference)
    if count > 0:
        rows[count - 1] = row


@kernel
def switch(seen: np.void, row: np.void, bits: int, late: int) -> None:
    """What was sent acts at this sample, or with an adapter that is a period ``late`` what was sent before."""
    row["terminal_output"] = bits if late == 0 else seen["output_acting"]
    seen["output_acting"] = bits


@kernel
def run_block_with_outputs(
    outputs: Records,
    law: Records,
    memory: Records,
    reference: Records,
    plant_params: Records,
    plant_state: Records,
    sample_us: NDArray[np.int64],
    rows: Records,
    count: int,
) -> None:
    """``run_block`` with the node's digital outputs, (1,) of ``outputs.OUTPUTS``, which act as the voltages do."""
    seen, row, late = memory[0]["input"], memory[0]["row"], law[0]["tick"]["delay_periods"] - 1
    for i in range(count):
        switch(seen, row, outputs[0]["bits"], late)
        run_block(law, memory, reference, plant_params, plant_state, sample_us[i : i + 1], rows[i : i + 1], 1)
        decide(law, memory, outputs, reference)
        rows[i] = row


def run_block_in_steps(
    period: Period,
    law: Records,
    memory: Records,
    reference: Records,
    plant_params: Records,
    plant_state: Records,
    sample_us: NDArray[np.int64],
    rows: Records,
    count: int,
) -> None:
    """``run_block`` with ``period`` in place of the cycle, a tick at a time."""
    seen, row = memory[0]["input"], memory[0]["row"]
    due = memory[0]["tick"]["count"][law[0]["tick"]["delay_periods"] - 1]
    for i in range(count):
        exchange(plant_params, plant_state, sample_us[i], due, row, seen["sense_count"])
        period(law, memory, reference)
        rows[i] = row


def run_outputs_in_steps(
    period: Period,
    outputs: Records,
    law: Records,
    memory: Records,
    reference: Records,
    plant_params: Records,
    plant_state: Records,
    sample_us: NDArray[np.int64],
    rows: Records,
    count: int,
) -> None:
    """``run_block_with_outputs`` with ``period`` in place of the cycle, a tick at a time."""
    late = int(law["tick"]["delay_periods"][0]) - 1
    for i in range(count):
        switch(memory[0]["input"], memory[0]["row"], outputs[0]["bits"], late)
        run_block_in_steps(
            period, law, memory, reference, plant_params, plant_state, sample_us[i : i + 1], rows[i : i + 1], 1
        )
        decide(law, memory, outputs, reference)
        rows[i] = memory[0]["row"]
