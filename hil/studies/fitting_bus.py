"""Which of the buses among processes this machine keeps up with: by the same measurement as ``pkxyz latency``."""

from collections.abc import Iterable

from hil.lanes.ending import Ended
from hil.studies.latency import measure
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import ConfigError

_MEASURED_S = 1.0


def fastest_that_fits(buses: Iterable[BusConfig], overrun_count: int) -> tuple[BusConfig, str]:
    """The first of ``buses``, from fast to slow, that this machine keeps up with, and what was measured, in words.

    It keeps up where the loop alone misses in a second at most half as many ticks as are a fault when they come
    together (``overrun_count`` of the controller).

    Raises ``ConfigError`` if there is none: then a run could only end in a fault. Raises ``Ended``.
    """
    told = []
    for bus in buses:
        measured = measure(bus.period_us, _MEASURED_S)
        if measured.ended_by:
            raise Ended(measured.ended_by)
        told.append(f"{measured.missed_ticks} of {measured.ticks} ticks at {1e-3 / bus.period_s:g} kHz")
        if measured.missed_ticks <= overrun_count // 2:
            return bus, f"the loop alone misses {', '.join(told)} here"
    raise ConfigError(
        f"the loop alone misses {', '.join(told)} on this machine as it is now, so a run could only end in a fault; "
        f"{measured.real_time}. Give it real-time priority or end other programs, or take --bus to try all the same; "
        "`pkxyz sil` needs no punctual machine"
    )
