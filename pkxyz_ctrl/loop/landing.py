"""How a stage is led down to rest: a path of a given length from where it moves now, compiled.

With u = t / T from 0 to 1 the path is the polynomial of 7th order that begins with position x, velocity v and
acceleration a, and ends at rest at 0; its jerk is 0 at both ends. With braking ticks it comes to rest where it began
first, on the same polynomial about that position, and goes down from there. From rest it is x s(u), s = 1 - 35 u^4
+ 84 u^5 - 70 u^6 + 20 u^7, and a force that is let go by s over three periods of a mode leaves less than 1 % of its
swing, whatever the mode's damping.
"""

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel

Array = NDArray[np.float64]


@kernel
def share(u: float) -> float:
    """s(u), from 1 to 0; before the beginning 1, past the end 0."""
    if u <= 0.0:
        return 1.0
    if u >= 1.0:
        return 0.0
    return 1.0 - u**4 * (35.0 - u * (84.0 - u * (70.0 - 20.0 * u)))


@kernel
def sample(begin: Array, age: int, braking_ticks: int, landing_ticks: int, period_us: int, out: Array) -> None:
    """Row (9,) of the path, ``age`` ticks from the row ``begin`` (9,): position m, velocity m/s, acceleration m/s^2.
    Past the end it is 0; a little before the beginning the path goes on backwards.
    """
    is_braking = max(age, 0) < braking_ticks
    ticks = braking_ticks if is_braking else landing_ticks - braking_ticks
    moves = is_braking or braking_ticks == 0
    duration_s = ticks * period_us * 1e-6
    u = (age if is_braking else age - braking_ticks) / ticks
    rate = 1.0 / duration_s
    for i in range(3):
        if u >= 1.0:
            out[i], out[3 + i], out[6 + i] = 0.0, 0.0, 0.0
            continue
        held = begin[i] if is_braking else 0.0
        x, v, a = begin[i] - held, 0.0, 0.0
        if moves:
            v, a = duration_s * begin[3 + i], duration_s * duration_s * begin[6 + i]
        c4 = -35.0 * x - 20.0 * v - 5.0 * a
        c5 = 84.0 * x + 45.0 * v + 10.0 * a
        c6 = -70.0 * x - 36.0 * v - 7.5 * a
        c7 = 20.0 * x + 10.0 * v + 2.0 * a
        u2 = u * u
        out[i] = held + x + u * (v + u * (0.5 * a + u2 * (c4 + u * (c5 + u * (c6 + u * c7)))))
        out[3 + i] = (v + u * (a + u2 * (4.0 * c4 + u * (5.0 * c5 + u * (6.0 * c6 + u * 7.0 * c7))))) * rate
        out[6 + i] = (a + u2 * (12.0 * c4 + u * (20.0 * c5 + u * (30.0 * c6 + u * 42.0 * c7)))) * (rate * rate)
