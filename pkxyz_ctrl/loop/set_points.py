"""Where the set-point is: along the reference, on the way to a stop on it, or on the way down to rest. Compiled."""

import math

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.core import feed_hold
from pkxyz_ctrl.loop import landing
from pkxyz_ctrl.safety.modes import Mode

Array = NDArray[np.float64]
Records = NDArray[np.void]

_ROW_LENGTH = 9
_TRACKING, _LANDING = int(Mode.TRACKING), int(Mode.LANDING)


@kernel
def reference_row(law: np.void, memory: np.void, reference: Records, ahead: int, out: Array) -> None:
    """Write the row (9,) of the set-point ``ahead`` ticks from this one to ``out``."""
    base = reference[0]["tick"]
    if memory["mode"] == _LANDING:
        age = memory["landing_age"] + ahead - law["tick"]["delay_periods"]
        braking, ticks = law["braking_ticks"], law["landing_ticks"]
        landing.sample(memory["landing_from"], age, braking, ticks, law["period_us"], out)
    elif memory["feed"] != feed_hold.STEADY:
        covered, speed, change = feed_hold.advance(memory["feed"], memory["feed_age"] + ahead, law["feed_hold_ticks"])
        at = memory["feed_phase"] - base + covered
        feed_hold.sample(reference, at, speed, change, law["period_us"] * 1e-6, out)
    elif memory["mode"] == _TRACKING and memory["phase"] != 0.0:
        at = memory["reference_tick"] - base + ahead + memory["phase"]
        feed_hold.sample(reference, at, 1.0, 0.0, law["period_us"] * 1e-6, out)
    elif memory["mode"] == _TRACKING:
        feed_hold.row(reference, memory["reference_tick"] - base + ahead, out)
    else:
        for i in range(_ROW_LENGTH):
            out[i] = memory["setpoint"][i]


@kernel
def reference_rows(law: np.void, memory: np.void, reference: Records) -> None:
    """Write the rows that count in this tick: at its sample, at both ends of the interval in which its force acts, and
    a period after that. Beside them the position asked for at the sample, for the record: without a learnt shift,
    unless the path stops or starts.
    """
    delay, here, asked = law["tick"]["delay_periods"], memory["here"], memory["asked_m"]
    if memory["mode"] == _TRACKING and memory["feed"] == feed_hold.STEADY and memory["phase"] == 0.0:  # in short
        at = memory["reference_tick"] - reference[0]["tick"]
        feed_hold.row(reference, at, here)
        feed_hold.row(reference, at + delay, memory["now"])
        feed_hold.row(reference, at + delay + 1, memory["after"])
        feed_hold.row(reference, at + delay + 2, memory["later"])
        position = reference[min(max(at, 0), len(reference) - 1)]["asked_m"]
        for i in range(3):
            asked[i] = position[i]
        return
    reference_row(law, memory, reference, 0, here)
    reference_row(law, memory, reference, delay, memory["now"])
    reference_row(law, memory, reference, delay + 1, memory["after"])
    reference_row(law, memory, reference, delay + 2, memory["later"])
    for i in range(3):
        asked[i] = here[i]


@kernel
def excite(memory: np.void, reference: Records) -> None:
    """Add the excitation of this sample to the measurement; outside the rows handed in there is none."""
    index = memory["reference_tick"] - reference[0]["tick"]
    if 0 <= index < len(reference):
        added = reference[index]["added_m"]
        for i in range(3):
            if added[i] != 0.0:
                memory["tick"]["measurement_m"][i] += added[i]


@kernel
def turn_feed(law: np.void, memory: np.void, direction: int) -> None:
    """Begin to stop on the path, or to go on along it; in the middle of the other, from the speed that there is."""
    at = memory["reference_tick"] + memory["phase"]
    age = 0
    if memory["feed"] == -direction:
        covered, _, _ = feed_hold.advance(memory["feed"], memory["feed_age"], law["feed_hold_ticks"])
        at = memory["feed_phase"] + covered
        age = max(0, law["feed_hold_ticks"] - memory["feed_age"])  # where the mirrored ramp has this speed
    covered, _, _ = feed_hold.advance(direction, age, law["feed_hold_ticks"])
    memory["feed"] = direction
    memory["feed_age"] = age
    memory["feed_phase"] = at - covered


@kernel
def scale_time(law: np.void, memory: np.void) -> None:
    """A tick of slowing down or starting has passed; at its end the path stands, or goes on at its own speed."""
    memory["feed_age"] += 1
    covered, _, _ = feed_hold.advance(memory["feed"], memory["feed_age"], law["feed_hold_ticks"])
    at = memory["feed_phase"] + covered
    if memory["feed_age"] >= law["feed_hold_ticks"]:
        if memory["feed"] == feed_hold.SLOWING:
            for i in range(_ROW_LENGTH):
                memory["setpoint"][i] = memory["now"][i]  # which is ahead of this tick, and so stands already
        memory["feed"] = feed_hold.STEADY
    memory["reference_tick"] = np.int64(math.floor(at))
    memory["phase"] = at - math.floor(at)


@kernel
def begin_landing(memory: np.void) -> None:
    """The way down begins where the set-points were led to for the next action, jumps on the way included."""
    model = memory["tick"]["set_point_model"]
    for i in range(_ROW_LENGTH):
        memory["landing_from"][i] = memory["after"][i]
    for i in range(3):
        memory["landing_from"][i] += model["short_m"][i]
        model["short_m"][i] = 0.0
    model["foreseen"] = 0
    memory["landing_age"] = -1
    memory["tick"]["landing"] = 1


@kernel
def end_landing(memory: np.void) -> None:
    """Leave nothing of the way down behind."""
    for i in range(_ROW_LENGTH):
        memory["landing_from"][i] = 0.0
    memory["landing_age"] = 0
    memory["tick"]["landing_share"] = 0.0
