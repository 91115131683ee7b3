"""The plant's equations of motion solved by scipy instead of by the plant: the oracle of its integration.

What it shares with the plant is the right-hand side, which other tests hold to the stage's energy; method, step sizes
and the way the amplifier's transient is treated are its own.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from sim.motion.mechanics import acceleration

Array = NDArray[np.float64]


def reference_motion(
    params: NDArray[np.void], state: NDArray[np.void], drive_count: NDArray[np.integer], period_us: int
) -> Array:
    """Position (n, 3) in m at the end of each period, from a plant's records (1,), which stay as they are.

    ``drive_count`` (n, 3): what the converters hold during each period. DOP853 at rtol 1e-12, started anew in each
    period, since the voltages have a kink there. For a plant whose amplifier is a first-order lag and no more, and
    whose rigid motion is all there is: raises ``ValueError`` where the slew limit would act.
    """
    p, scratch = params[0].copy(), state[0].copy()  # the kernel writes notes into its state
    motion, volt = np.array(scratch["motion"]), np.array(scratch["voltage_v"])
    tau, h = float(p["amplifier_s"]), period_us * 1e-6
    targets = drive_count * p["volt_per_count"] + p["amplifier_offset_v"]
    positions = np.empty((len(targets), 3))
    for k, target in enumerate(targets):
        lag = volt - target
        if np.abs(lag).max() > p["slew_v_per_s"] * tau:
            raise ValueError(f"a step of {np.abs(lag).max():.3g} V slews, which this reference does not follow")

        def slope(t: float, y: Array, target: Array = target, lag: Array = lag) -> list[float]:
            v = target + lag * np.exp(-t / tau)
            return [*y[3:], *acceleration(p, scratch, v * v, *y)]

        solved = solve_ivp(slope, (0.0, h), motion, method="DOP853", rtol=1e-12, atol=1e-17, first_step=2e-6)
        motion = solved.y[:, -1]
        volt = target + lag * np.exp(-h / tau)
        positions[k] = motion[:3]
    return positions
