"""What the controller allows itself at the combs, in counts of the wire: for the law and, handed over, for the gate."""

import math

from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.stage import Stage


def slew_counts(controller: ControllerConfig, bus: BusConfig) -> int:
    """Most that a drive count may change in one tick."""
    return math.floor(controller.limits.slew_max_v_per_s * bus.period_s / bus.analog.drive_volt_per_count + 1e-9)


def count_max(stage: Stage, controller: ControllerConfig, bus: BusConfig) -> int:
    """Largest drive count that stays within the controller's and the device's voltage limit."""
    limit_v = min(controller.limits.voltage_max_v, stage.voltage_max_v)
    return min(32767, math.floor(limit_v / bus.analog.drive_volt_per_count + 1e-9))
