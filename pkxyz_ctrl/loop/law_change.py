"""Another law for a stage that holds: its numbers take the place of the present one's between two ticks, and its memory
begins where the force at the platform stays what it is. PURE and compiled.

Filter and model of the set-points go on. What the adaptation had added becomes disturbance in the filter where the new
law does not adapt likewise. A linear law has listened for a while before (``hil.operate.law_change``).
"""

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.core import youla
from pkxyz_ctrl.core.linear_law import ORDER_MAX
from pkxyz_ctrl.loop import cycle as cycling

Records = NDArray[np.void]

CHANGE = np.dtype(
    [
        ("x", "f8", (ORDER_MAX,)),  # memory that a linear law begins with
        ("adapts_alike", "i4"),  # 1: it adapts as the present one does, so what was learnt goes on
        ("law", cycling.LAW),
    ],
    align=True,
)


def change_to(new: Records, x: NDArray[np.float64], *, adapts_alike: bool) -> Records:
    """(1,) of ``CHANGE``, to a law (1,) of ``cycle.LAW`` that begins with ``x`` (ORDER_MAX,)."""
    change = np.zeros(1, CHANGE)
    change["law"], change["x"], change["adapts_alike"] = new, x, adapts_alike
    return change


@kernel
def take_over(law_array: Records, memory_array: Records, change_array: Records) -> None:
    """Write the numbers of the new law into ``law_array`` (1,) of ``cycle.LAW``, which the loop reads, and its memory
    (1,) of ``cycle.MEMORY`` likewise. Between two ticks, the stage at rest or its loop open.
    """
    cycling.prepare(law_array, memory_array)
    law, state, change = law_array[0]["tick"], memory_array[0]["tick"], change_array[0]
    new, held_n, adapts = change["law"]["tick"], state["held_n"], law["adaptation"]["on"] != 0
    for i in range(3):  # the filter's states are about an operating point, which may be another one
        moved_m = law["estimator"]["operating_point_m"][i] - new["estimator"]["operating_point_m"][i]
        _move(state["estimate"], i, moved_m)
        state["set_point_model"]["state"][i] += moved_m
        held_n[i] = state["adaptation"]["added_n"][i] if adapts else 0.0
    if change["adapts_alike"] == 0:
        _forget(state["adaptation"])
        for i in range(3):
            _move(state["estimate"], 6 + i, -held_n[i])
            held_n[i] = 0.0
    for i in range(3):  # not every law keeps it
        held_n[i] = state["feedforward_n"][i] + held_n[i]
    law_array[0] = change["law"]
    state["set_point_model"]["foreseen"] = 0  # by the old law
    youla.clear(state["youla"])
    state["youla"]["faded"] = 0
    for k in range(ORDER_MAX):
        state["linear"]["x"][k] = change["x"][k]


@kernel
def _move(estimate: np.void, i: int, by: float) -> None:
    estimate["predicted"][i] += by
    estimate["filtered"][i] += by
    estimate["ahead"][i] += by


@kernel
def _forget(state: np.void) -> None:
    """Nothing of what was learnt is known any more."""
    state["learnt"][:] = 0.0
    state["acting"][:] = 0.0
    state["covariance"][:] = 0.0
    state["sensitivity"][:] = 0.0
    state["shown"][:] = 0.0
    state["force_n"][:] = 0.0
    state["motion"][:] = 0.0
    state["added_n"][:] = 0.0
    state["told_n"][:] = 0.0
    state["base"][:] = 0.0
    state["answer"][:] = 0.0
    state["clue"][:] = 0.0
    state["work"][:] = state["lanes"][:] = state["spare"][:] = 0.0
    state["left_by_base"] = state["left"] = state["change"] = 0.0
    state["updates"] = state["begun"] = state["based"] = state["axis"] = state["cause"] = state["calm"] = 0
