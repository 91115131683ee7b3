"""A law that may do anything, as data: the shipped period with numbers by which the reference alone sets the counts.

Nothing of the loop is replaced. Elasticity, filter and gains are zero, so the demanded force is mass times the row's
acceleration, the allocation takes it back to the combs, and the voltage law makes the wanted counts of it. Its own
limits are those of the wire, so that whatever exceeds the gate's is asked for, too. The monitors of the loop are
switched off, since whether they trip is a choice of the explorer (a trip from outside, in any tick); those of frames
and node keep their shipped rules with small counts. What ``loop.outputs`` decides of the digital outputs is replaced by
what the explorer chooses, in every mode; whether it is sent is up to the shipped code.
"""

from typing import Any

import numpy as np
from loop_rig import counts_at
from loop_rig import law as shipped_law
from numpy.typing import NDArray

from pkxyz_ctrl.can.codec import Counts
from pkxyz_ctrl.core import kinematics
from pkxyz_ctrl.core.demand import OPEN_LOOP
from pkxyz_ctrl.loop import landing
from pkxyz_ctrl.loop.reference import reference_rows

FRAME_LIMITS = {"stale_count": 2, "sequence_count": 3, "crc_count": 2, "length_count": 2, "frame_leak_ticks": 1}
NODE_LIMITS = {"overrun_count": 2, "overrun_leak_ticks": 1, "safe_cycles": 2, "range_count": 2}
LANDING_TICKS = 2
OFF = ("frozen", "innovation", "residual", "unexplained_force", "saturation", "slew", "solver")


def any_law(period_us: int, homing_ticks: int) -> NDArray[np.void]:
    """(1,) of ``cycle.LAW``: counts are what `reference_for` asks for, whatever came before."""
    law = shipped_law(autostart=False).copy()
    law.flags.writeable = True
    record: Any = law[0]
    tick = record["tick"]
    for part in ("elasticity", "estimator", "linear"):
        tick[part] = np.zeros(1, tick[part].dtype)[0]
    tick["feedback"] = np.zeros(1, tick["feedback"].dtype)[0]
    tick["feedback"]["mass_kg"], tick["feedback"]["period_s"] = 1.0, period_us * 1e-6
    tick["feedback"]["authority_force_n"] = np.inf  # the feedback, and what is held back for it, has no share
    tick["drive"]["count_max"] = tick["drive"]["count_slew_max"] = 32767
    tick["drive"]["noise_shaping"] = 0
    tick["kind"], tick["delay_periods"] = OPEN_LOOP, 1
    record["period_us"], record["homing_ticks"], record["feed_hold_ticks"] = period_us, homing_ticks, 2
    record["braking_ticks"], record["landing_ticks"] = 0, LANDING_TICKS
    for name, value in (FRAME_LIMITS | NODE_LIMITS).items():
        record["limits"][name] = value
    for name in OFF:
        record["limits"][f"{name}_count"] = -1
    law.flags.writeable = False
    return law


def reference_for(law: NDArray[np.void], counts: Counts) -> NDArray[np.void]:
    """The reference (1,) for which the law asks for these counts."""
    record: Any = law[0]["tick"]
    pulls = np.empty((3, 3))
    kinematics.pulls(record["geometry"], np.zeros(3), pulls)
    volts = record["drive"]["volt_per_count"] * np.array(counts)
    force_n = record["drive"]["force_gain_n_per_v2"] * volts**2
    row = np.zeros((1, 9))
    row[0, 6:] = pulls.T @ force_n
    return reference_rows(row)


def sense_counts_at_rest() -> Counts:
    """What the converters show of the stage at rest."""
    a, b, c = counts_at(np.zeros(3))
    return int(a), int(b), int(c)


def bend(age: int) -> float:
    """What is left of the acceleration with which a way down began, at a tick of it; its law asks for that alone."""
    begin, row = np.zeros(9), np.empty(9)
    begin[6] = 1.0
    landing.sample(begin, min(age, LANDING_TICKS - 1), 0, LANDING_TICKS, 1_000_000 // LANDING_TICKS, row)
    return float(row[6])
