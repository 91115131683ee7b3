"""What a native loop goes by, filled in from a setup; and what it does not take."""

import numpy as np
from numpy.typing import NDArray

from hil.bus.unix_folder import folder_of
from hil.lanes.setup import Setup
from hil.lanes.wall import GUARDS_PER_PERIOD, NO_END, SILENT_US
from pkxyz_ctrl.can import cob_id
from pkxyz_ctrl.config.bus import CanConfig
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.export.shared import SETTINGS, Interface
from pkxyz_ctrl.io.clocks import SPIN_US
from pkxyz_ctrl.io.realtime import FIFO_PRIORITY
from pkxyz_ctrl.safety.modes import LOOP_CLOSED

BLIND_S = 2.0
"""For so long a session may stand still while the stage holds: meanwhile nobody could stop it."""
_INTERFACES = {"pkxyz-unix": Interface.UNIX, "socketcan": Interface.SOCKETCAN}
_OPTIONS = {"receive_own_messages": False}
"""What an option may say: it is so anyway."""
_LEAVE = "leave --native"


def require_native(setup: Setup, can: CanConfig) -> None:
    """Raise ``ConfigError`` for what the native loop does not take."""
    if setup.learning is not None:
        raise ConfigError(
            f"learning writes the path while the loop runs, which the native loop does not wait for: {_LEAVE}"
        )
    if can.interface not in _INTERFACES:
        raise ConfigError(
            f"bus {setup.bus.name!r}: the native loop knows {' and '.join(_INTERFACES)}, not {can.interface!r}: "
            f"{_LEAVE}, or give another --bus"
        )
    for name, value in (can.options or {}).items():
        if (name, value) not in _OPTIONS.items():
            raise ConfigError(f"bus {setup.bus.name!r}: the native loop does not know can.options.{name}: {_LEAVE}")
    channel = _channel(can)
    if len(channel) >= SETTINGS["channel"].shape[0]:
        raise ConfigError(f"bus {setup.bus.name!r}: can.channel {can.channel!r} is too long; give a shorter one")


def fill(
    settings: NDArray[np.void], setup: Setup, can: CanConfig, company_s: float, *, is_operated: bool = False
) -> None:
    """Write (1,) of ``SETTINGS``; what is said of the file itself stands there already. A stage that is operated has no
    last tick.
    """
    to, period_us, channel = settings[0], setup.bus.period_us, _channel(can)
    to["is_operated"], to["ticks"] = is_operated, NO_END if is_operated else setup.ticks
    to["period_us"], to["landing_ticks"] = period_us, setup.law["landing_ticks"][0]
    to["blind_ticks"] = round(BLIND_S * 1e6 / period_us)
    to["sense_deadline_us"], to["heartbeat_deadline_us"] = can.sense_deadline_us, can.heartbeat_deadline_us
    to["guard_us"], to["latest_start_us"] = period_us // GUARDS_PER_PERIOD, can.sense_deadline_us // 2
    to["standstill_us"] = can.standstill_max_us
    to["spin_us"], to["company_us"], to["silent_us"] = SPIN_US, round(company_s * 1e6), SILENT_US
    to["priority"] = FIFO_PRIORITY
    to["node_heartbeat_id"] = cob_id.HEARTBEAT_BASE + can.driver.node_id
    to["sense_id"] = cob_id.sense(can.driver.node_id, can.driver.sense_pdo)
    to["drive_id"] = cob_id.drive(can.driver.node_id, can.driver.drive_pdo)
    to["loop_closed"] = sum(1 << mode for mode, closed in enumerate(LOOP_CLOSED) if closed)
    to["interface"], to["fd"] = _INTERFACES[can.interface], can.driver.fd
    to["is_named"] = "/" not in can.channel
    to["channel"][: len(channel)] = np.frombuffer(channel, np.uint8)


def _channel(can: CanConfig) -> bytes:
    if can.interface != "pkxyz-unix":
        return can.channel.encode()
    return str(folder_of(can.channel).absolute()).encode()
