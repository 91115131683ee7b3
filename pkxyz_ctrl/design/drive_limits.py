"""What the controller allows itself at the combs, in counts of the wire: for the law and, handed over, for the gate."""

import math

from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.stage import Stage

_COUNT_MAX = 32767  # INTEGER16


def slew_counts(controller: ControllerConfig, bus: BusConfig) -> int:
    """Most that a drive count may change in one tick: where a tick is long, all of what a frame can carry."""
    step_v = controller.limits.slew_max_v_per_s * bus.period_s
    return min(_COUNT_MAX, math.floor(step_v / bus.analog.drive_volt_per_count + 1e-9))


def count_max(stage: Stage, controller: ControllerConfig, bus: BusConfig) -> int:
    """Largest drive count that stays within the controller's and the device's voltage limit."""
    limit_v = min(controller.limits.voltage_max_v, stage.voltage_max_v)
    return min(_COUNT_MAX, math.floor(limit_v / bus.analog.drive_volt_per_count + 1e-9))
