"""In which lane a loop is excited: simulated, or on a bus that leads out of this process, at the machine's clock."""

from hil.lanes.lane import Lane
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import ConfigError


def lane_on(bus: BusConfig, lane: Lane | str | None, plant: str | None) -> Lane:
    """The lane for a bus: the one that was asked for, or by default the machine's clock on real sockets and the fast
    lane elsewhere. Raises ``ConfigError`` where bus, lane and the ``plant`` that was named do not go together.
    """
    leads_out = bus.can is not None and bus.can.interface != "pkxyz-sim"
    chosen = Lane.named(lane) if lane is not None else Lane.WALL if leads_out else Lane.FAST
    if (chosen == Lane.WALL) != leads_out:
        simulated = "--bus fd_5k, classic_2k or local_20k is simulated"
        raise ConfigError(
            f"bus {bus.name!r} leads to other processes or devices, where no lane can be chosen: leave --lane; "
            f"{simulated}" if leads_out else f"bus {bus.name!r} is simulated and ends with this process; give a --bus "
            "with another interface, such as unix_2k, to measure at the machine's clock"
        )  # fmt: skip
    if leads_out and plant is not None:
        raise ConfigError(
            f"--plant {plant}: on bus {bus.name!r} the plant is whatever answers there (`pkxyz plant --plant {plant}` "
            f"serves this one); leave it, or simulate: --bus fd_5k"
        )
    if chosen == Lane.LOCKSTEP and bus.can is None:
        raise ConfigError(f"bus {bus.name!r} has no [can] and carries no frames; use --lane fast")
    return chosen
