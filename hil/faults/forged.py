"""Somebody on the bus who sends in the name of others, and knows how."""

import struct

from hil.bus.clock import Lockstep
from hil.bus.wire import Wire
from hil.node.crc import crc8h2f
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.frame import Frame

_PROCESS = struct.Struct("<hhhB")
_NMT_STOP = 2
_SYNC_LAST = 240
_HIGHER_BY = 300  # counts, 1.8 V: within the slew limit of every bus
_HIGHEST = 32767


class Forger:
    """Every so often sends what would come next of a kind, counter and CRC right: SYNC, a drive frame with some more
    voltage, a sense frame with the counts of the last, the controller's heartbeat; or with no kind NMT stop.
    """

    def __init__(
        self, name: str, kind: str, interval_us: int, driver: DriverConfig, clock: Lockstep, wire: Wire
    ) -> None:
        self._kind, self._interval_us, self._driver, self._clock = kind, interval_us, driver, clock
        can_ids = {"sync": 0x080, "sense": 0x280 + driver.node_id, "drive": 0x300 + driver.node_id}
        self._can_id = can_ids.get(kind, 0x700 + driver.controller_node_id if kind else 0x000)
        self._last: bytes | None = None
        self.endpoint = wire.attach(name, self._see)
        self._is_here = True
        self._send()

    def leave(self) -> None:
        """Unplug."""
        self._is_here = False
        self.endpoint.detach()

    def _see(self, frame: Frame, t_us: int) -> None:
        if frame.can_id == self._can_id:
            if self._last is None:
                self._clock.call_at(self._clock.now_us, self._send)
            self._last = frame.data

    def _send(self) -> None:
        data = self._next() if self._is_here else None
        if data is None:
            return
        self._last = data
        self.endpoint.send(Frame(self._can_id, data, self._driver.fd, self._driver.fd))
        self._clock.call_at(self._clock.now_us + self._interval_us, self._send)

    def _next(self) -> bytes | None:
        """None where nothing has been seen yet that it could follow."""
        if not self._kind:
            return bytes((_NMT_STOP, self._driver.node_id))
        if self._kind == "heartbeat":
            return b"\x05"
        if not self._last:
            return None
        if self._kind == "sync":
            return bytes((self._last[0] % _SYNC_LAST + 1,))
        *counts, counter = _PROCESS.unpack(self._last[: _PROCESS.size])
        if self._kind == "drive":
            counts = [min(_HIGHEST, count + _HIGHER_BY) for count in counts]
        payload = _PROCESS.pack(*counts, counter + 1 & 0xFF)
        return payload + bytes((crc8h2f(self._can_id.to_bytes(2, "little") + payload),))
