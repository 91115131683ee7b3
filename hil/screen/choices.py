"""What several commands let one choose."""

from enum import StrEnum
from typing import TYPE_CHECKING

from hil.lanes.lane import Lane

if TYPE_CHECKING:
    from pkxyz_ctrl.config.bus import BusConfig


class InProcessLane(StrEnum):
    """Those that one process closes by itself, as a choice at the terminal."""

    LOCKSTEP = Lane.LOCKSTEP.value
    FAST = Lane.FAST.value


class Tones(StrEnum):
    """What is added to the measurement: all tones at once, or one after another."""

    MULTISINE = "multisine"
    STEPPED = "stepped"


def require_simulated(bus: "BusConfig", command: str) -> None:
    """Raise ``ConfigError`` for a bus with real sockets or adapters: ``command`` would simulate it without a word."""
    from pkxyz_ctrl.config.files import ConfigError

    if bus.can is not None and bus.can.interface != "pkxyz-sim":
        raise ConfigError(
            f"bus {bus.name!r} leads to other processes or devices (can.interface = {bus.can.interface!r}), and "
            f"`pkxyz {command}` simulates: run on it with `pkxyz run --bus {bus.name}`, or simulate with --bus fd_5k, "
            "classic_2k or local_20k"
        )
