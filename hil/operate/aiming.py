"""At which positions the node's digital outputs pulse: what a command asks for, checked."""

import numpy as np

from hil.operate.loop import Loop
from hil.operate.procedures import RefusedError
from pkxyz_ctrl.config.files import ConfigError, parse
from pkxyz_ctrl.config.triggers import PositionTrigger


def aim(controller: Loop, command: np.void) -> str:
    """Do as a record of ``COMMAND`` says; returns words. Raises ``RefusedError``."""
    if command["count"] == 0:
        controller.aim(0, 0, 0.0, 0.0, 0)
        return "no position is told"
    asked = {
        "axis": "xyz"[int(command["axis"]) % 3], "direction": int(command["direction"]),
        "start_m": float(command["first_m"]), "pitch_m": float(command["pitch_m"]), "count": int(command["count"]),
    }  # fmt: skip
    try:
        wanted = parse(asked, PositionTrigger, "trigger")
    except ConfigError as error:
        raise RefusedError(str(error).replace("\n", "; ")) from None
    axis = "xyz".index(wanted.axis)
    controller.aim(axis, wanted.direction, wanted.start_m, wanted.pitch_m, wanted.count)
    told = f"{wanted.count} positions along the stage's {wanted.axis}, every {wanted.pitch_m * 1e9:g} nm"
    return told if controller.has_outputs else f"{told}; recorded only: this amplifier has no digital outputs"
