"""A cycle that is fed by hand, in the states in which something may happen to it."""

import numpy as np
from loop_rig import MIDDLE, Cycle, counts_at, law, stage
from numpy.typing import NDArray

from pkxyz_ctrl.core.tick import set_position
from pkxyz_ctrl.safety.modes import Event, Mode

HOMING_TICKS = 250  # 0.05 s at 5 kHz
AT_REST = counts_at(np.zeros(3))


def noisy(counts: NDArray[np.int32], tick: int) -> NDArray[np.int32]:
    """Counts with a little noise, never the same twice in a row: 0, 3, -2 ... whose mean over 250 ticks is 0."""
    return counts + np.array([(0, 3, -2, 1, -2)[(tick + 2 * i) % 5] for i in range(3)], np.int32)


def homed(autostart: bool = False, reference: NDArray[np.float64] | None = None) -> Cycle:
    """A cycle after homing at rest: IDLE, with sense offsets of zero."""
    c = Cycle(law(autostart=autostart), reference)
    for k in range(HOMING_TICKS):
        c.tick(noisy(AT_REST, k), event=Event.HOME if k == 0 and not autostart else Event.NONE)
    assert c.mode is Mode.IDLE
    return c


def enabled() -> Cycle:
    c = homed()
    c.tick(noisy(AT_REST, 0), event=Event.ENABLE)
    assert c.mode is Mode.ENABLED
    return c


def tracking(reference: NDArray[np.float64] | None = None) -> Cycle:
    c = homed(reference=reference)
    c.tick(noisy(AT_REST, 0), event=Event.ENABLE)
    c.tick(noisy(AT_REST, 1), event=Event.TRACK)
    assert c.mode is Mode.TRACKING
    return c


def in_the_middle() -> Cycle:
    """Tracking a reference that stands at mid-workspace, as if the stage had got there."""
    at = stage().forward_kinematics(MIDDLE)
    c = tracking(np.tile(np.r_[at, np.zeros(6)], (16, 1)))
    memory, drive = c.memory["tick"][0], c.law["tick"]["drive"][0]
    memory["count"][:] = np.round(stage().holding_voltages(at) / drive["volt_per_count"]).astype(np.int32)
    set_position(c.law["tick"][0], memory, at)
    memory["set_point_model"]["applied_n"][:] = stage().holding_forces(at)
    c.memory["monitors"]["commanded_n"][0] = stage().holding_forces(at)  # no force has changed of late
    c.tick(noisy(counts_at(MIDDLE), 0))
    assert c.mode is Mode.TRACKING
    return c
