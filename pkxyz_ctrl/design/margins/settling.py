"""How long a loop takes to forget: what a disturbance leaves of itself, by the linear model."""

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.design.margins.sensitivity import closed_loop
from pkxyz_ctrl.design.model.discrete_law import DiscreteLaw, LawError
from pkxyz_ctrl.design.model.loop_plant import LoopPlant

Array = NDArray[np.float64]


def settling_ticks(plant: LoopPlant, law: DiscreteLaw, left: float = 1e-4, most: int = 100_000) -> int:
    """Ticks after which a pulse of what is measured has moved the position for the last time by more than ``left`` of
    the farthest that it did, whichever the axis; at most ``most``. Raises ``LawError`` for an unstable loop.
    """
    loop, shown = closed_loop(plant, law), np.hstack([plant.c, np.zeros((3, law.order))])
    if not np.abs(np.linalg.eigvals(loop)).max() < 1.0:
        raise LawError("the loop is not stable: it never settles")
    state, moved = np.vstack([-plant.b @ law.d, law.b]), np.zeros(0)
    while len(moved) < most and (not len(moved) or moved[-_LOOK:].max() > 0.5 * left * moved.max()):
        part = np.empty(_LOOK)
        for n in range(_LOOK):
            part[n] = np.abs(shown @ state).max()
            state = loop @ state
        moved = np.concatenate([moved, part])
    return min(int(np.flatnonzero(moved > left * moved.max())[-1]) + 1, most)


_LOOK = 256
"""Ticks at once, longer than the slowest mode of a stage swings to and fro."""
