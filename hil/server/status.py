"""Where a stage in operation stands, for a person: one record of the loop in words and numbers."""

import math
from typing import Any

import numpy as np

from hil.operate.commands import ACTIVITY_WORDS, Activity
from hil.operate.sample_axes import turn_of
from pkxyz_ctrl.config.triggers import BITS
from pkxyz_ctrl.safety.modes import LOOP_CLOSED, MODE_FACTS, Mode

_LOAD_OVER_US = 500_000
_RESTLESS = frozenset({
    "t_s", "tick", "position_m", "error_m", "uncertainty_m", "voltage_v", "headroom_v", "frames", "bus_load",
})  # fmt: skip
"""What changes by itself while nothing happens."""


class BusLoad:
    """Share of the time in which frames are on the wire, over half a second or more."""

    def __init__(self) -> None:
        self._from_us = self._from_wire_ns = 0
        self._share = 0.0

    def at(self, tick: np.void) -> float:
        """0 to 1, at a record of ``TICK``."""
        t_us, wire_ns = int(tick["row"]["t_us"]), int(tick["session"]["wire_ns"])
        passed_us = t_us - self._from_us
        if passed_us >= _LOAD_OVER_US or passed_us < 0:
            self._share = (wire_ns - self._from_wire_ns) * 1e-3 / passed_us if passed_us > 0 else 0.0
            self._from_us, self._from_wire_ns = t_us, wire_ns
        return self._share


class Due:
    """Of two words on a stage at which nothing happens one is left out: numbers that can be read change five times a
    second, and every message costs.
    """

    def __init__(self) -> None:
        self._last: dict[str, Any] = {}
        self._is_left_out = False

    def is_due(self, status: dict[str, Any]) -> bool:
        """Whether it is told; a change of anything but what changes by itself always is."""
        lasting = {name: value for name, value in status.items() if name not in _RESTLESS}
        self._is_left_out = lasting == self._last and not self._is_left_out
        self._last = lasting
        return not self._is_left_out


def status_of(tick: np.void, description: dict[str, Any], bus_load: float) -> dict[str, Any]:
    """Plain data of a record of ``TICK``; lengths in m, in the sample's coordinates; voltages in V."""
    row, session = tick["row"], tick["session"]
    turn = turn_of(session["matrix"])
    setpoint, position, target = (
        turn.to_sample(place) for place in (row["reference_m"], row["estimate_m"], session["target_m"])
    )
    activity, mode = Activity(int(session["activity"])), Mode(int(row["mode"]))
    most_v = float(description.get("voltage_max_v", math.inf))
    voltage = [float(v) for v in row["voltage_v"]]
    return {
        "t_s": int(row["t_us"]) * 1e-6, "tick": int(row["tick"]),
        "mode": mode.name, "mode_words": MODE_FACTS[mode].meaning,
        "activity": activity.name.lower(), "words": ACTIVITY_WORDS[activity],
        "homed": bool(session["homed"]), "driven": bool(LOOP_CLOSED[mode]),
        "in_position": bool(session["in_position"]), "running_id": int(session["running_id"]),
        "setpoint_m": _finite(setpoint), "position_m": _finite(position), "error_m": _finite(position - setpoint),
        "target_m": _finite(target), "uncertainty_m": _finite(session["uncertainty_m"]),
        "law": session["law"].decode(errors="replace"), "quiet": bool(row["quiet"]),
        "in_sample_axes": not turn.is_plain,
        "voltage_v": voltage, "headroom_v": most_v - max(voltage), "saturated": bool(row["saturated"]),
        "outputs": [name for name, bit in BITS.items() if int(row["output_acting"]) & bit],
        "progress": float(session["progress"]), "missed_ticks": int(session["missed"]),
        "stood_still_s": int(session["stood_us"]) * 1e-6,
        "frames": int(session["frames"]), "bus_load": round(bus_load, 4),
    }  # fmt: skip


def _finite(values: np.ndarray) -> list[float | None]:
    return [float(v) if math.isfinite(v) else None for v in values]
