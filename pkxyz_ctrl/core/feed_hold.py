"""How a path is stopped and taken up again without being left: the speed along it changes, not the path.

Over n ticks the path speed s goes from 1 to 0, s = 1 - 3 u^2 + 2 u^3 with u = k / n, or back by the mirrored way. The
path then advances n/2 ticks of its own time, and its row at the phase p becomes

    x(p),   s x'(p),   s^2 x''(p) + s' x'(p)

so position, velocity and acceleration stay steady where those of the path are.
"""

import math

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel

Array = NDArray[np.float64]
Records = NDArray[np.void]

SLOWING, STEADY, STARTING = -1, 0, 1
"""What the path speed does: it falls to 0, stays, rises to 1."""


@kernel
def advance(direction: int, age: int, ramp_ticks: int) -> tuple[float, float, float]:
    """Ticks of the path since a change of speed began ``age`` ticks ago, the speed now, and its change per tick.

    ``direction`` SLOWING or STARTING. Past the end of the ramp: stopped, or at full speed.
    """
    n = float(ramp_ticks)
    k = float(age)
    if k >= n:
        return (0.5 * n, 0.0, 0.0) if direction == SLOWING else (k - 0.5 * n, 1.0, 0.0)
    u = k / n
    slope = 6.0 * u * (1.0 - u) / n
    if direction == SLOWING:
        return k - n * u**3 * (1.0 - 0.5 * u), 1.0 - u * u * (3.0 - 2.0 * u), -slope
    return n * u**3 * (1.0 - 0.5 * u), u * u * (3.0 - 2.0 * u), slope


@kernel
def row(rows: Records, index: int, out: Array) -> None:
    """Row (9,) of a path at full speed at one of its rows; before the first and past the last these."""
    motion = rows[min(max(index, 0), len(rows) - 1)]["motion"]
    for i in range(9):
        out[i] = motion[i]


@kernel
def sample(rows: Records, phase: float, speed: float, change_per_tick: float, period_s: float, out: Array) -> None:
    """Row (9,) of a path at a phase between two of its rows, constant jerk between them, at a path speed.
    ``rows`` (n,) of a record with ``motion`` (9,).

    Phases before the first and past the last row are taken as these.
    """
    bounded = min(max(phase, 0.0), float(len(rows) - 1))
    index = math.floor(bounded)
    following = min(index + 1, len(rows) - 1)
    h = (bounded - index) * period_s
    here, there = rows[index]["motion"], rows[following]["motion"]
    for i in range(3):
        x, v, a = here[i], here[3 + i], here[6 + i]
        jerk = (there[6 + i] - a) / period_s
        velocity = v + h * (a + 0.5 * h * jerk)
        out[i] = x + h * (v + h * (0.5 * a + h * jerk / 6.0))
        out[3 + i] = speed * velocity
        out[6 + i] = speed * speed * (a + h * jerk) + change_per_tick / period_s * velocity
