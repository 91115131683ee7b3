"""EMCY producer of the amplifier node: error register, error history, inhibit time (CiA 301, 7.2.7)."""

import struct
from collections import deque
from collections.abc import Callable
from enum import IntEnum

from hil.node.alarm import Alarm, Scheduler
from hil.node.object_dictionary import ObjectDictionary

HISTORY_LENGTH = 8
HOLD_US = 100_000
"""So long an error seen in single frames lasts after the last bad one."""
_WAITING_MAX = 16  # a queue that a flood of errors cannot grow: raise and clear of every code in use here

# CiA 301, table 26 (classes of error codes) and 7.5.2.2 (bits of the error register; bit 0 is set with any error)
_REGISTER_BITS = {
    0x20: 0x02,
    0x30: 0x04,
    0x40: 0x08,
    0x80: 0x10,
    0xF0: 0x80,
}


class ErrorCode(IntEnum):
    """EMCY codes that the node raises of itself; those of the amplifier come through ``amplifier_fault``."""

    HEARTBEAT_LOST = 0x8130
    DRIVE_SHORT = 0x8210
    DRIVE_LONG = 0x8220
    SYNC_DATA = 0x8240  # length, counter out of range or out of step
    DRIVE_MISSING = 0x8250
    DRIVE_CRC = 0xFF10
    DRIVE_COUNTER = 0xFF11
    DRIVE_VALUE = 0xFF12
    DRIVE_LATE = 0xFF13
    DRIVE_STEP = 0xFF14


class EmergencyProducer:
    """Sends one EMCY when an error begins and one (code 0) when it ends, however often it shows in between.

    Objects: 0x1001 register, 0x1003 history (newest first), 0x1014 COB-ID, 0x1015 inhibit time in 100 us.
    """

    def __init__(self, od: ObjectDictionary, clock: Scheduler, send: Callable[[int, bytes], None]) -> None:
        self._od = od
        self._clock = clock
        self._send = send
        self._alarm = Alarm(clock, self._after_inhibit)
        self._active: dict[int, bytes] = {}
        self._waiting: deque[bytes] = deque(maxlen=_WAITING_MAX)
        self._open_us = 0  # from this time on, the next one may be sent
        self._permitted = False

    @property
    def active(self) -> tuple[int, ...]:
        """Codes of the errors that are present, in the order in which they began."""
        return tuple(self._active)

    @property
    def is_waiting(self) -> bool:
        """Whether there is something to be sent still."""
        return bool(self._waiting)

    @property
    def register(self) -> int:
        bits = 0
        for code in self._active:
            bits |= 0x01 | _REGISTER_BITS.get(code >> 8 & 0xF0, 0)
        return bits

    def begin(self, code: int, info: bytes = b"") -> bool:
        """Error ``code`` is there, with up to 5 bytes of ``info``. False if it was there already."""
        if code in self._active:
            return False
        info = info[:5].ljust(5, b"\0")
        self._active[code] = info
        self._od[0x1001, 0] = self.register
        self._remember(code | struct.unpack_from("<H", info)[0] << 16)
        self._queue(code, info)
        return True

    def end(self, code: int) -> None:
        """Error ``code`` is gone. If others remain, the frame names the last one of them after the register."""
        if self._active.pop(code, None) is None:
            return
        self._od[0x1001, 0] = self.register
        remaining = next(reversed(self._active), 0)
        self._queue(0, struct.pack("<H3x", remaining))

    def permit(self, permitted: bool) -> None:
        """Whether the NMT state lets EMCY frames out; what happens meanwhile waits."""
        self._permitted = permitted
        if permitted:
            self._after_inhibit(self._clock.now_us)

    def reset(self) -> None:
        """Forget everything, as after a reset of the communication."""
        self._active.clear()
        self._waiting.clear()
        self._alarm.cancel()
        self._open_us = 0
        self._od[0x1001, 0] = 0
        self.clear_history()

    def clear_history(self) -> None:
        for subindex in range(HISTORY_LENGTH + 1):
            self._od[0x1003, subindex] = 0

    def _remember(self, field: int) -> None:
        od = self._od
        count = min(od[0x1003, 0] + 1, HISTORY_LENGTH)
        for subindex in range(count, 1, -1):
            od[0x1003, subindex] = od[0x1003, subindex - 1]
        od[0x1003, 1] = field
        od[0x1003, 0] = count

    def _queue(self, code: int, info: bytes) -> None:
        self._waiting.append(struct.pack("<HB", code, self.register) + info)
        self._after_inhibit(self._clock.now_us)

    def _after_inhibit(self, now_us: int) -> None:
        while self._waiting and self._permitted and now_us >= self._open_us:
            cob_id = self._od[0x1014, 0]
            frame = self._waiting.popleft()
            if cob_id & 1 << 31:
                continue  # not in use: register and history tell it all the same
            self._open_us = now_us + 100 * self._od[0x1015, 0]
            self._send(cob_id & 0x7FF, frame)
        if self._waiting and self._permitted:
            self._alarm.set(self._open_us)


class FrameErrors:
    """Errors seen in single frames. Each begins one EMCY, and ends when nothing but good frames came for a while.

    Without it a frame that is wrong every other cycle would put two EMCY frames into each cycle, ahead of the PDOs.
    """

    __slots__ = ("_emergency", "_hold_us", "_present", "present", "quiet_from_us")

    def __init__(self, emergency: EmergencyProducer, hold_us: int = HOLD_US) -> None:
        self._emergency = emergency
        self._hold_us = hold_us
        self._present: set[int] = set()
        self.quiet_from_us = 0
        self.present = False  # read in every cycle: calls `good` only if there is something to end

    def bad(self, code: int, t_us: int, info: bytes = b"") -> None:
        self.quiet_from_us = t_us + self._hold_us
        self._present.add(code)
        self.present = True
        self._emergency.begin(code, info)

    def good(self, t_us: int) -> None:
        if t_us >= self.quiet_from_us:
            for code in sorted(self._present):
                self._emergency.end(code)
            self.forget()

    def forget(self) -> None:
        self._present.clear()
        self.present = False
