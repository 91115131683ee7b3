"""The truth beside the controller's record of a tick, compiled: one row complete."""

import numpy as np
from numba import njit

from sim.geometry import strokes


@njit(cache=True)
def append(memory, plant_params, plant_state, rows, index) -> None:
    """Complete the controller's row with the plant's state at the sample and copy it to ``rows[index]``.

    To be called after the cycle and before the plant moves on. ``memory`` (1,) of ``cycle.MEMORY``, ``rows`` (n,) of ``ROW``.
    """
    row, p, s = memory[0]["row"], plant_params[0], plant_state[0]
    stroke = np.empty(3)
    strokes(p, s["motion"], stroke)
    sway = s["parasitic"][0]
    for i in range(3):
        row["position_m"][i] = s["motion"][i] + p["parasitic_table"][i] * sway
        row["stroke_m"][i] = stroke[i] + p["parasitic_comb"][i] * sway
        row["comb_voltage_v"][i] = s["voltage_v"][i]
    rows[index] = row
