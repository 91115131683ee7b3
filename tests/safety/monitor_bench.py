"""A bench for monitors: limits, a memory, and healthy ticks in which a test changes single fields."""

from typing import Any

import numpy as np
from loop_rig import monitor_limits
from numpy.typing import NDArray

from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.monitors import LIMITS, MONITOR_MEMORY, OBSERVATION, check
from pkxyz_ctrl.safety.trips import Trip

Changes = dict[str, Any]
COUNTS = [name for name in LIMITS.names or () if name.endswith("_count")]
UNMOVED = np.zeros(1, MONITOR_MEMORY)[0]


class Bench:
    """A memory, its limits, and healthy ticks in which a test changes single fields."""

    def __init__(self, mode: Mode = Mode.TRACKING, limits: NDArray[np.void] | None = None) -> None:
        self.limits = monitor_limits() if limits is None else limits
        self.memory = np.zeros(1, MONITOR_MEMORY)
        self.mode = mode
        self.tick_index = 0

    def tick(self, changes: Changes | None = None) -> Trip:
        obs = np.zeros(1, OBSERVATION)
        self.tick_index += 1
        noise = self.tick_index % 2
        healthy = {
            "mode": self.mode,
            "sense_count": [100 + noise, 200 + noise, 300 + noise],
            "stroke_m": 10e-6,
            "solver_ok": 1,
            "finite": 1,
        }
        for name, value in {**healthy, **(changes or {})}.items():
            obs[name] = value
        return Trip(check(self.limits[0], self.memory[0], obs[0]))


def only(count_name: str, count: int) -> NDArray[np.void]:
    """Limits with one monitor on."""
    limits = monitor_limits()
    for name in COUNTS:
        limits[name] = -1
    limits[count_name] = count
    return limits


def beyond(axis: int, value: float) -> list[float]:
    return [value if i == axis else 0.0 for i in range(3)]
