"""The transmit gate: the last word on every frame that is to be sent. What is not permitted here, does not go out.

Deny by default. It trusts nobody: it reads the bytes of the frame, not what someone meant, with its own CRC and its own
reading of the standard, and it remembers what it let through.
"""

import struct
from dataclasses import dataclass
from enum import IntFlag
from typing import Final

from pkxyz_ctrl.can.frame import FD, FD_FAST, UNUSUAL, Frame
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.sdo_rules import WriteContext, is_read, write_refusal


class FrameKind(IntFlag):
    """What a well-formed frame is for. One bit each, so that the permission of a mode is one number."""

    SYNC = 1 << 0
    HEARTBEAT = 1 << 1
    DRIVE_ZERO = 1 << 2
    DRIVE = 1 << 3
    SDO_READ = 1 << 4
    SDO_WRITE = 1 << 5
    NMT_START = 1 << 6
    NMT_STOP = 1 << 7
    NMT_PRE_OPERATIONAL = 1 << 8
    NMT_RESET = 1 << 9


# Whatever else is wrong, these keep the instrument informed and take it to 0 V. All that passes after a blocked frame.
ALWAYS: Final = (
    FrameKind.SYNC | FrameKind.HEARTBEAT | FrameKind.DRIVE_ZERO | FrameKind.NMT_STOP | FrameKind.NMT_PRE_OPERATIONAL
)
_CONFIGURE: Final = FrameKind.SDO_READ | FrameKind.SDO_WRITE | FrameKind.NMT_START | FrameKind.NMT_RESET

# Under voltage the node is not reset: its combs would drop to 0 V behind the back of the mode table.
PERMITTED: Final[dict[Mode, FrameKind]] = {
    Mode.BOOT: ALWAYS | _CONFIGURE,
    Mode.PRE_OPERATIONAL: ALWAYS | _CONFIGURE,
    Mode.IDLE: ALWAYS | FrameKind.SDO_READ | FrameKind.NMT_RESET,
    Mode.HOMING: ALWAYS | FrameKind.SDO_READ,
    Mode.ENABLED: ALWAYS | FrameKind.SDO_READ | FrameKind.DRIVE,
    Mode.TRACKING: ALWAYS | FrameKind.SDO_READ | FrameKind.DRIVE,
    Mode.FAULT: ALWAYS | FrameKind.SDO_READ | FrameKind.NMT_RESET,
}

SYNC_ID: Final = 0x080
NMT_ID: Final = 0x000
_OPERATIONAL: Final = b"\x05"
_NMT_KIND: Final = {  # CiA 301, 7.2.8.2
    0x01: FrameKind.NMT_START,
    0x02: FrameKind.NMT_STOP,
    0x80: FrameKind.NMT_PRE_OPERATIONAL,
    0x81: FrameKind.NMT_RESET,
    0x82: FrameKind.NMT_RESET,
}
_SYNC: Final = int(FrameKind.SYNC)  # int: the operators of IntFlag cost a microsecond
_HEARTBEAT: Final = int(FrameKind.HEARTBEAT)
_DRIVE: Final = int(FrameKind.DRIVE)
_DRIVE_ZERO: Final = int(FrameKind.DRIVE_ZERO)
_EVERY_KIND: Final = int(sum(FrameKind))


def _crc_table() -> bytes:
    """AUTOSAR CRC8H2F: polynomial 0x2F, not reflected (Specification of CRC Routines, 7.2.1.2)."""
    table = bytearray()
    for crc in range(256):
        for _ in range(8):
            crc = (crc << 1 ^ 0x2F) & 0xFF if crc & 0x80 else crc << 1
        table.append(crc)
    return bytes(table)


def _through(crc: int, zero_bytes: int) -> int:
    """The register after ``zero_bytes`` more bytes of 0."""
    for _ in range(zero_bytes):
        crc = _CRC[crc]
    return crc


def _count_table(bytes_after: int) -> bytes:
    """What a count 0..32767, low byte first, adds to the CRC of a payload that goes on for ``bytes_after`` bytes.

    A CRC is linear: its bytes' contributions, each with zeros behind it, add up by exclusive or. Four look-ups then do
    for seven bytes, and the counts are needed as numbers anyway.
    """
    low = [_through(byte, bytes_after + 2) for byte in range(256)]
    high = [_through(byte, bytes_after + 1) for byte in range(128)]
    return bytes(of_low ^ of_high for of_high in high for of_low in low)


_CRC: Final = _crc_table()
_CRC_1: Final = _count_table(5)
_CRC_2: Final = _count_table(3)
_CRC_3: Final = _count_table(1)
_PROTECTED: Final = struct.Struct("<hhhBB").unpack
_PLAIN: Final = struct.Struct("<hhh").unpack
_PROTECTED_LENGTH: Final = 8
_LONG_AGO_US: Final = -(1 << 62)


@dataclass(frozen=True, slots=True)
class GateConfig:
    """What the gate holds the frames to.

    ``count_max`` and ``count_slew_max`` are drive counts (the scale of the wire, INTEGER16; 0 counts = 0 V), the latter
    per drive frame. ``spacing_min_us`` is the shortest time between two drive frames; None: half a period, so that
    jitter passes and a second frame in the same tick does not. ``fd``: the bus can carry FD frames. Time-outs that are
    written to the node may be at most ``heartbeat_timeout_max_ms``. The drive frame is that of RPDO ``drive_pdo``, and
    carries channels ``drive_channels`` of 0x6411. Raises ValueError if a value is out of range.
    """

    count_max: int
    count_slew_max: int
    period_us: int
    node_id: int = 10
    controller_node_id: int = 127
    protection: bool = True
    fd: bool = True
    spacing_min_us: int | None = None
    heartbeat_timeout_max_ms: int = 1000
    drive_pdo: int = 2
    drive_channels: tuple[int, int, int] = (1, 2, 3)

    def __post_init__(self) -> None:
        ranges = {
            "count_max": (0, 32767),
            "count_slew_max": (1, 32767),
            "period_us": (2, 1_000_000),
            "node_id": (1, 127),
            "controller_node_id": (1, 127),
            "heartbeat_timeout_max_ms": (1, 65535),
            "drive_pdo": (1, 4),
        }
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            if not isinstance(value, int) or not low <= value <= high:
                raise ValueError(f"gate: {name} = {value!r} must be an integer in {low}..{high}")
        if self.node_id == self.controller_node_id:
            raise ValueError(f"gate: node_id and controller_node_id are both {self.node_id}")
        if self.spacing_min_us is not None and not 0 <= self.spacing_min_us <= self.period_us:
            raise ValueError(f"gate: spacing_min_us = {self.spacing_min_us} must be in 0..{self.period_us} (a period)")


class TransmitGate:
    """Holds every frame against :data:`PERMITTED`, the limits of its config, and the drive frames that went before.

    The first frame that it blocks latches it: until :meth:`clear`, only :data:`ALWAYS` passes. ``latched`` is that
    first reason, empty if there is none. What the combs hold counts as unknown at the beginning, after any NMT
    command, and after a SYNC that found no drive frame, since the node takes the next one for a late one; then only
    0 V passes, and after that the slew limit starts from 0. A voltage passes once for each SYNC, and there must have
    been one, so that every step that passed is a step that the combs make, if nothing is lost on the way. What is, the
    gate can't know; the node does, and holds its own steps to the same limit (0x2011).
    """

    def __init__(self, config: GateConfig) -> None:
        self.config = config
        self.latched = ""
        self.blocked_frames = 0
        self._rows = {int(mode): int(kinds) for mode, kinds in PERMITTED.items()}
        self._mask = _EVERY_KIND
        self._formats = (0, FD, FD_FAST) if config.fd else (0,)
        self._drive_id = 0x100 + 0x100 * config.drive_pdo + config.node_id  # predefined connection set
        self._sdo_id = 0x600 + config.node_id
        self._heartbeat_id = 0x700 + config.controller_node_id
        self._written = WriteContext(
            node_id=config.node_id,
            controller_node_id=config.controller_node_id,
            heartbeat_timeout_max_ms=config.heartbeat_timeout_max_ms,
            count_slew_max=config.count_slew_max,
            drive_index=0x1400 + config.drive_pdo - 1,
            drive_id=self._drive_id,
            drive_channels=config.drive_channels,
        )
        self._drive_length = _PROTECTED_LENGTH if config.protection else 6
        # Initial value 0xFF and the data id (the identifier, low byte first), seen through seven bytes; final xor 0xFF.
        data_id = _CRC[_CRC[0xFF ^ self._drive_id & 0xFF] ^ self._drive_id >> 8]
        self._crc_start = _through(data_id, 7) ^ 0xFF
        self._spacing_us = config.period_us // 2 if config.spacing_min_us is None else config.spacing_min_us
        self._count_max = config.count_max
        self._count_slew_max = config.count_slew_max
        # Of the last drive frame that passed:
        self._counts = (0, 0, 0)
        self._time_us = _LONG_AGO_US
        self._counter = -1  # none
        self._counter_next = 0
        self._syncs = 0  # that passed since; two are as good as more
        self._known = False  # whether the combs hold it

    def check(self, frame: Frame, mode: int, t_us: int) -> str | None:
        """None: send it. Otherwise the reason why it must not be sent, and the gate is latched."""
        can_id, data, flags = frame
        row = self._rows.get(mode, 0) & self._mask
        if flags not in self._formats:
            reason: str | None = _refusal(flags)
        elif can_id == self._drive_id:
            reason = self._judge_drive(data, row, t_us)
        elif can_id == SYNC_ID:
            if row & _SYNC and (len(data) == 0 or (len(data) == 1 and 1 <= data[0] <= 240)):
                self._syncs = 1 if self._syncs == 0 else 2
                return None
            reason = "SYNC must be empty, or one byte, 1..240" if row & _SYNC else _not_now(FrameKind.SYNC)
        else:
            reason = self._judge_service(can_id, data, row)
        return None if reason is None else self._block(frame, mode, reason)

    def clear(self) -> None:
        """Let the mode's frames pass again. What was sent last stays remembered, so the slew limit holds across it."""
        self.latched = ""
        self._mask = _EVERY_KIND

    def _block(self, frame: Frame, mode: int, reason: str) -> str:
        known_mode = Mode(mode).name if mode in self._rows else f"unknown mode {mode}"
        reason = f"frame 0x{frame.can_id:03X} [{bytes(frame.data).hex(' ')}] blocked in {known_mode}: {reason}"
        self.blocked_frames += 1
        if not self.latched:
            self.latched = reason
            self._mask = int(ALWAYS)
        return reason

    def _judge_drive(self, data: bytes, row: int, t_us: int) -> str | None:
        # One straight line, since it runs every tick: 0.3 us less than split into its questions.
        if len(data) != self._drive_length:
            return f"drive PDO has {len(data)} bytes instead of {self._drive_length}"
        protected = self._drive_length == _PROTECTED_LENGTH
        if protected:
            a, b, c, counter, crc = _PROTECTED(data)
        else:
            a, b, c = _PLAIN(data)
        was_a, was_b, was_c = self._counts
        if a == b == c == 0:
            # 0 V may come at any step and right behind a voltage; only a useless or a babbling one is held back.
            if not row & _DRIVE_ZERO:
                return _not_now(FrameKind.DRIVE_ZERO)
            if protected and counter == self._counter:
                return f"drive PDO repeats alive counter {counter}: the node would ignore it"
            if was_a == was_b == was_c == 0 and t_us - self._time_us < self._spacing_us:
                return self._too_soon(t_us)
            # The node may ignore a frame whose counter jumped: then its combs hold it only from the next one on.
            known = not protected or self._counter < 0 or counter == self._counter_next
        else:
            if not row & _DRIVE:
                return "the gate is latched" if self.latched else _not_now(FrameKind.DRIVE)
            maximum = self._count_max
            if not (0 <= a <= maximum and 0 <= b <= maximum and 0 <= c <= maximum):
                return f"drive counts {a}, {b}, {c} are not all in 0..{maximum}"
            if not self._known or self._syncs == 2:
                return "what the combs hold is unknown (start, NMT command or pause): a frame with 0 V must come first"
            if self._syncs == 0:
                return "a second drive PDO in one tick: no SYNC went out since the one before"
            slew = self._count_slew_max
            if not (-slew <= a - was_a <= slew and -slew <= b - was_b <= slew and -slew <= c - was_c <= slew):
                return f"drive counts {a}, {b}, {c} after {was_a}, {was_b}, {was_c}: a step beyond {slew}"
            if t_us - self._time_us < self._spacing_us:
                return self._too_soon(t_us)
            if protected and counter != self._counter_next:
                return f"drive PDO has alive counter {counter} instead of {self._counter_next}"
            known = True
        if protected:
            if crc != _CRC_1[a] ^ _CRC_2[b] ^ _CRC_3[c] ^ _CRC[counter] ^ self._crc_start:
                return f"drive PDO has a wrong CRC, 0x{crc:02X}"
            self._counter = counter
            self._counter_next = counter + 1 & 0xFF
        self._counts = (a, b, c)
        self._known = known
        self._time_us = t_us
        self._syncs = 0
        return None

    def _too_soon(self, t_us: int) -> str:
        return f"drive PDO {t_us - self._time_us} us after the one before, at least {self._spacing_us} us apart"

    def _judge_service(self, can_id: int, data: bytes, row: int) -> str | None:
        if can_id == self._heartbeat_id:
            if data != _OPERATIONAL:
                return "our heartbeat must be the one byte 0x05"
            return None if row & _HEARTBEAT else _not_now(FrameKind.HEARTBEAT)
        if can_id == NMT_ID:
            return self._judge_nmt(data, row)
        if can_id == self._sdo_id:
            return self._judge_sdo(data, row)
        return "identifier is not in the list of those that we may send"

    def _judge_nmt(self, data: bytes, row: int) -> str | None:
        if len(data) != 2 or data[0] not in _NMT_KIND:
            return "not an NMT command"
        if data[1] != self.config.node_id:
            return f"NMT command to node {data[1]}; only node {self.config.node_id} is ours, never all"
        kind = _NMT_KIND[data[0]]
        if not row & kind:
            return _not_now(kind)
        self._known = False
        if kind is FrameKind.NMT_RESET:
            self._counter = -1
        return None

    def _judge_sdo(self, data: bytes, row: int) -> str | None:
        if len(data) != 8:
            return f"SDO request has {len(data)} bytes instead of 8"
        if is_read(data):
            return None if row & FrameKind.SDO_READ else _not_now(FrameKind.SDO_READ)
        if not row & FrameKind.SDO_WRITE:
            return _not_now(FrameKind.SDO_WRITE)
        return write_refusal(data, self._written)


def _refusal(flags: int) -> str:
    if flags & UNUSUAL:
        return "not a plain data frame with an 11-bit identifier"
    return "frame format that this bus does not carry"


def _not_now(kind: FrameKind) -> str:
    return f"{kind.name} is not permitted now"
