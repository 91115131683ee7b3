"""What the node's digital outputs are to be when the voltages of this tick act, bit by bit. PURE and compiled.

A path's rows say their own bits; positions are passed, and the stage is in position, by the estimate. Where the stage
will be: the set-point of that instant, and how far the estimate has been from its own of late; its noise from tick to
tick, averaged out, is not known beforehand. A position is told in the tick nearest to its passage, so as often early as
late, and by how much is said.
"""

import math

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.config.triggers import IN_POSITION, POSITION, TriggersConfig
from pkxyz_ctrl.loop import in_position
from pkxyz_ctrl.safety.modes import LOOP_CLOSED, Mode

Array = NDArray[np.float64]
Records = NDArray[np.void]

MEMORY_TICKS = 32
"""Time constant of the mean of what the estimate is off."""

POSITION_TRIGGER = np.dtype(
    [
        ("axis", "i4"),
        ("direction", "i4"),  # 1 or -1: towards larger or smaller coordinates; 0: both
        ("start_m", "f8"),
        ("pitch_m", "f8"),  # more than the way of two periods, or two passages become one pulse
        ("count", "i8"),  # start, start + pitch, ...: how many positions; 0: none
        ("off_m", "f8"),  # estimate less set-point, of late
        ("begun", "i4"),  # 0: not asked yet
        ("passed", "i8"),  # positions below where the stage was
        ("late_s", "f8"),  # how long before the instant of action the position was passed; negative: after it
        ("at_m", "f8"),  # which position that was
    ],
    align=True,
)

OUTPUTS = np.dtype(
    [
        ("trigger", POSITION_TRIGGER),
        ("position", in_position.IN_POSITION),
        ("window_m", "f8"),  # within which the stage is in position; 0: never
        ("sigmas", "f8"),  # standard deviations of the estimate that count as off
        ("dwell_ticks", "i4"),
        ("bits", "i4"),  # of this tick
    ],
    align=True,
)

_TRACKING = int(Mode.TRACKING)
_FAR = 1e15


def set_up(outputs: Records, triggers: TriggersConfig | None, period_s: float) -> None:
    """Let ``outputs`` (1,) of ``OUTPUTS`` go by what a run wants."""
    if triggers is None:
        return
    settle(outputs, triggers.window_m or 0.0, triggers.sigmas, triggers.dwell_s, period_s)
    if (wanted := triggers.position) is not None:
        aim(outputs, "xyz".index(wanted.axis), wanted.direction, wanted.start_m, wanted.pitch_m, wanted.count)


def settle(outputs: Records, window_m: float, sigmas: float, dwell_s: float, period_s: float) -> None:
    """When the stage is in position: see ``TriggersConfig``."""
    outputs["window_m"], outputs["sigmas"] = window_m, sigmas
    outputs["dwell_ticks"] = max(1, math.ceil(dwell_s / period_s - 1e-9))


def aim(outputs: Records, axis: int, direction: int, start_m: float, pitch_m: float, count: int) -> None:
    """Which positions are told, from now on: see ``PositionTrigger``; a ``count`` of 0 ends it."""
    trigger = outputs["trigger"]
    trigger["begun"] = 0
    trigger["axis"], trigger["direction"], trigger["count"] = axis, direction, count
    trigger["start_m"], trigger["pitch_m"] = start_m, pitch_m


@kernel
def decide(law_array: Records, memory_array: Records, outputs_array: Records, reference: Records) -> None:
    """After the cycle of this tick: its outputs, into ``outputs_array`` (1,) of ``OUTPUTS`` and into the row."""
    law, memory, outputs = law_array[0], memory_array[0], outputs_array[0]
    row = memory["row"]
    row["output"] = row["output_late_ns"] = 0
    _look(law, memory, outputs)
    position, trigger = outputs["position"], outputs["trigger"]
    if 0 < outputs["dwell_ticks"] <= position["ticks"]:
        row["output"] = IN_POSITION
    if memory["mode"] == _TRACKING:
        row["output"] |= _of_path(law, memory, reference)
        if trigger["count"] > 0:
            period_s = law["period_us"] * 1e-6
            if position_bit(trigger, memory["here"], memory["now"], row["estimate_m"], period_s):
                row["output"] |= POSITION
                row["output_late_ns"] = np.int64(min(max(trigger["late_s"], -1.0), 1.0) * 1e9)
    else:
        trigger["begun"] = 0
    outputs["bits"] = row["output"]


@kernel
def _look(law: np.void, memory: np.void, outputs: np.void) -> None:
    """For how long the stage has been in position: within the window of a set-point that stands."""
    row, position = memory["row"], outputs["position"]
    if LOOP_CLOSED[memory["mode"]] == 0 or outputs["window_m"] == 0.0:
        position["ticks"] = position["seen"] = 0
        return
    in_position.look(
        position, law["tick"]["estimator"]["gain"], row["reference_m"], row["estimate_m"], row["innovation_m"],
        outputs["window_m"], outputs["sigmas"],
    )  # fmt: skip
    for i in range(3):
        if memory["here"][3 + i] != 0.0 or memory["here"][i] != memory["later"][i]:
            position["ticks"] = 0


@kernel
def _of_path(law: np.void, memory: np.void, reference: Records) -> int:
    """The bits of the row that is nearest to where the path will be when they act."""
    at = memory["row"]["reference_tick"] + law["tick"]["delay_periods"] + (1 if memory["phase"] >= 0.5 else 0)
    index = at - reference[0]["tick"]
    return int(reference[min(max(index, 0), len(reference) - 1)]["output"])


@kernel
def position_bit(trigger: np.void, now_m: Array, then: Array, estimate_m: Array, period_s: float) -> int:
    """``POSITION`` if the stage passes a position of ``trigger`` within half a period of the instant of action, else 0.

    Set-point (3,) and estimate (3,) of now, and the row (9,) of the reference at that instant. Of several within one
    period the last counts: the pitch has to be more than the way of a period.
    """
    i = trigger["axis"]
    speed = then[3 + i]
    if trigger["begun"] == 0:
        trigger["off_m"] = estimate_m[i] - now_m[i]
    trigger["off_m"] += (estimate_m[i] - now_m[i] - trigger["off_m"]) / MEMORY_TICKS
    at = then[i] + trigger["off_m"]
    ahead = (at + 0.5 * period_s * speed - trigger["start_m"]) / trigger["pitch_m"]
    if not -_FAR < ahead < _FAR:  # nor a number
        return 0
    below = min(max(math.floor(ahead) + 1, 0), trigger["count"])
    was, trigger["passed"] = trigger["passed"], below
    if trigger["begun"] == 0:
        trigger["begun"] = 1
        return 0
    if below == was or speed == 0.0 or trigger["direction"] * (below - was) < 0 or (below > was) != (speed > 0.0):
        return 0
    trigger["at_m"] = trigger["start_m"] + trigger["pitch_m"] * (below - 1 if below > was else below)
    late_s = (at - trigger["at_m"]) / speed
    trigger["late_s"] = (at - trigger["at_m"] + 0.5 * then[6 + i] * late_s * late_s) / speed
    return POSITION
