"""The truth at a sample, compiled: what a recording sets beside the controller's own columns."""

import numpy as np

from pkxyz_ctrl.compiled.kernel import kernel
from sim.motion.geometry import see_sliders
from sim.structure.pose import combs_seen, stand


@kernel
def observe(plant: np.void, state: np.void, out: np.void) -> None:
    """Write ``position_m``, ``stroke_m`` and ``comb_voltage_v`` (3,) of a plant's
    records to those fields of the record ``out``.

    As ``sim.plant.Plant`` defines them: the modes' part is in the position and in the strokes.
    """
    if plant["general_on"] != 0 or plant["tilt_on"] != 0:
        combs_seen(plant, state, out["stroke_m"], state["rates_m_per_s"])
        stand(plant, state, out["position_m"])
        for i in range(3):
            out["comb_voltage_v"][i] = state["voltage_v"][i]
        return
    see_sliders(plant, state, state["motion"])
    stroke_m, sway = state["slider_m"], state["parasitic"][0]
    for i in range(3):
        out["position_m"][i] = state["motion"][i] + plant["parasitic_table"][i] * sway
        out["stroke_m"][i] = stroke_m[i] + plant["parasitic_comb"][i] * sway
        out["comb_voltage_v"][i] = state["voltage_v"][i]


TRUTH_BYTES = (3 * 3 + 1) * np.dtype("f8").itemsize
"""Length of the three fields and of ``terminal_output``, which end a ``ROW``."""
