"""The fast lane: the same cycle and the same plant in one compiled loop, with the delays and the quantisation of the
bus.

No frames, no gate, no driver: on a fault-free scenario they change no bit, and a test holds the two lanes to that.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hil.truth import observe
from pkxyz_ctrl.cycle import cycle
from sim import kernels

Array = NDArray[np.float64]
Records = NDArray[np.void]


@njit(cache=True)
def run_block(
    law: np.void,
    memory: np.void,
    reference: Array,
    plant_params: Records,
    plant_state: Records,
    sample_us: NDArray[np.int64],
    rows: Records,
    count: int,
) -> None:
    """Run ``count`` ticks and write their rows to ``rows[:count]``.

    ``sample_us`` (count,) int64: plant time of each sample. At a sample the drive counts of the last tick are
    applied, as the amplifier does on SYNC, or with two periods of delay those of the tick before it; the truth is
    taken just before them.
    """
    seen, row = memory[0]["input"], memory[0]["row"]
    due = memory[0]["tick"]["count"][law[0]["tick"]["delay_periods"] - 1]
    for i in range(count):
        kernels.advance(plant_params, plant_state, sample_us[i] - plant_state[0]["t_us"])
        observe(plant_params[0], plant_state[0], row)
        kernels.drive(plant_params, plant_state, due)
        kernels.sample(plant_params, plant_state, seen["sense_count"])
        cycle(law, memory, reference)
        rows[i] = row
