"""The gate's rules, compiled: a frame, the mode and the time in, the number of a reason out, 0 if it may be sent.

A frame is its identifier, flags, length and ``word``, its first eight bytes as an integer, the first one lowest; what
stands above its length is not looked at. The words for the reasons are in ``gate``.
"""

from enum import IntEnum, IntFlag
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.can.frame import FD, FD_FAST, UNUSUAL
from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.sdo_rules import WRITES, is_read, write_refusal

Records = NDArray[np.void]


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
    OUTPUTS = 1 << 10


# Whatever else is wrong, these keep the instrument informed and take it to 0 V. All that passes after a blocked frame.
ALWAYS: Final = (
    FrameKind.SYNC | FrameKind.HEARTBEAT | FrameKind.DRIVE_ZERO | FrameKind.NMT_STOP | FrameKind.NMT_PRE_OPERATIONAL
)
_CONFIGURE: Final = FrameKind.SDO_READ | FrameKind.SDO_WRITE | FrameKind.NMT_START | FrameKind.NMT_RESET
_AT_WORK: Final = FrameKind.SDO_READ | FrameKind.DRIVE | FrameKind.OUTPUTS

# Under voltage the node is not reset: its combs would drop to 0 V behind the back of the mode table.
PERMITTED: Final[dict[Mode, FrameKind]] = {
    Mode.BOOT: ALWAYS | _CONFIGURE,
    Mode.PRE_OPERATIONAL: ALWAYS | _CONFIGURE,
    Mode.IDLE: ALWAYS | FrameKind.SDO_READ | FrameKind.NMT_RESET | FrameKind.OUTPUTS,
    Mode.HOMING: ALWAYS | FrameKind.SDO_READ | FrameKind.OUTPUTS,
    Mode.ENABLED: ALWAYS | _AT_WORK,
    Mode.TRACKING: ALWAYS | _AT_WORK,
    Mode.FAULT: ALWAYS | FrameKind.SDO_READ | FrameKind.NMT_RESET,
    Mode.LANDING: ALWAYS | _AT_WORK,
}


class Reason(IntEnum):
    """Why a frame must not be sent. Above ``NOT_NOW``: a kind that the mode, or the latch, does not permit."""

    NONE = 0
    UNUSUAL = 1
    FORMAT = 2
    SYNC = 3
    HEARTBEAT = 4
    IDENTIFIER = 5
    NMT = 6
    NMT_NODE = 7
    DRIVE_LENGTH = 8
    DRIVE_REPEATED = 9
    DRIVE_TOO_SOON = 10
    DRIVE_RANGE = 11
    DRIVE_UNKNOWN = 12
    DRIVE_SECOND = 13
    DRIVE_STEP = 14
    DRIVE_COUNTER = 15
    DRIVE_CRC = 16
    LATCHED = 17
    SDO_LENGTH = 18
    SDO_WRITE = 19
    OUTPUT_LENGTH = 20
    OUTPUT_BITS = 21
    OUTPUT_SECOND = 22
    NOT_NOW = 1 << 16


GATE = np.dtype(
    [
        ("period_us", "i8"),
        ("spacing_us", "i8"),
        ("count_max", "i4"),
        ("count_slew_max", "i4"),
        ("drive_id", "i4"),
        ("drive_length", "i4"),
        ("output_id", "i4"),  # of the digital outputs' PDO; -1: there is none
        ("sdo_id", "i4"),
        ("heartbeat_id", "i4"),
        ("node_id", "i4"),
        ("fd", "i4"),  # 1: the bus carries FD frames
        ("crc_start", "i4"),  # what the identifier makes of seven bytes of 0, with the final xor
        ("writes", WRITES),
    ],
    align=True,
)

GATE_MEMORY = np.dtype(
    [
        ("time_us", "i8"),  # of the last drive frame that passed ...
        ("count", "i4", (3,)),  # ... and what it held
        ("counter", "i4"),  # its alive counter; -1: none
        ("counter_next", "i4"),
        ("syncs", "i4"),  # that passed since; two are as good as more
        ("known", "i4"),  # 1: the combs hold it
        ("output_due", "i4"),  # 1: a SYNC has passed since the last frame with digital outputs
        ("latched", "i4"),  # reason of the first frame that was blocked since the last clear; 0: none
        ("blocked_frames", "i4"),
    ],
    align=True,
)

SYNC_ID: Final = 0x080
NMT_ID: Final = 0x000
OUTPUT_BITS: Final = 0x1F
"""That a frame with digital outputs may set: line, pixel, frame, position, in position."""
_LONG_AGO_US: Final = -(1 << 62)
_MODES: Final = len(Mode)
_OPERATIONAL: Final = 0x05
_PROTECTED_LENGTH: Final = 8
_SYNC, _HEARTBEAT, _DRIVE, _DRIVE_ZERO, _READ, _WRITE, _START, _STOP, _PRE_OPERATIONAL, _RESET, _OUTPUTS = (
    int(FrameKind[name])
    for name in (
        "SYNC", "HEARTBEAT", "DRIVE", "DRIVE_ZERO", "SDO_READ", "SDO_WRITE", "NMT_START", "NMT_STOP",
        "NMT_PRE_OPERATIONAL", "NMT_RESET", "OUTPUTS",
    )
)  # fmt: skip
_ALWAYS: Final = int(ALWAYS)
_NOT_NOW: Final = int(Reason.NOT_NOW)
_BAD_UNUSUAL, _BAD_FORMAT, _BAD_SYNC, _BAD_HEARTBEAT, _BAD_IDENTIFIER, _BAD_NMT, _BAD_NMT_NODE = (
    int(Reason[name]) for name in ("UNUSUAL", "FORMAT", "SYNC", "HEARTBEAT", "IDENTIFIER", "NMT", "NMT_NODE")
)
_LENGTH, _REPEATED, _TOO_SOON, _RANGE, _UNKNOWN, _SECOND, _STEP, _COUNTER, _BAD_CRC = (
    int(Reason[f"DRIVE_{name}"])
    for name in ("LENGTH", "REPEATED", "TOO_SOON", "RANGE", "UNKNOWN", "SECOND", "STEP", "COUNTER", "CRC")
)
_LATCHED, _SDO_LENGTH, _SDO_WRITE = int(Reason.LATCHED), int(Reason.SDO_LENGTH), int(Reason.SDO_WRITE)
_OUTPUT_LENGTH, _OUTPUT_BITS, _OUTPUT_SECOND = (int(Reason[f"OUTPUT_{name}"]) for name in ("LENGTH", "BITS", "SECOND"))


def _permitted_by_mode() -> NDArray[np.int32]:
    rows = np.array([int(PERMITTED[mode]) for mode in Mode], np.int32)
    rows.setflags(write=False)
    return rows


def _crc_table() -> NDArray[np.uint8]:
    """AUTOSAR CRC8H2F: polynomial 0x2F, not reflected (Specification of CRC Routines, 7.2.1.2)."""
    table = bytearray()
    for crc in range(256):
        for _ in range(8):
            crc = (crc << 1 ^ 0x2F) & 0xFF if crc & 0x80 else crc << 1
        table.append(crc)
    return np.frombuffer(bytes(table), np.uint8)


_ROWS: Final = _permitted_by_mode()
_CRC: Final = _crc_table()


def crc_start(can_id: int) -> int:
    """Initial value 0xFF and the data id (the identifier, low byte first), seen through seven bytes; final xor 0xFF."""
    crc = 0xFF
    for byte in (can_id & 0xFF, can_id >> 8, *bytes(7)):
        crc = int(_CRC[crc ^ byte])
    return crc ^ 0xFF


def new_gate_memory() -> NDArray[np.void]:
    """(1,) of ``GATE_MEMORY`` of a gate that has let nothing pass."""
    memory = np.zeros(1, GATE_MEMORY)
    forget(memory)
    return memory


@kernel
def forget(memory_array: Records) -> None:
    """Nothing has passed, and nothing was blocked: what the combs hold is unknown."""
    memory = memory_array[0]
    memory["time_us"] = _LONG_AGO_US
    for i in range(3):
        memory["count"][i] = 0
    memory["counter"] = -1
    memory["counter_next"] = memory["syncs"] = memory["known"] = memory["latched"] = memory["blocked_frames"] = 0
    memory["output_due"] = 0


@kernel
def check(
    config_array: Records, memory_array: Records,
    can_id: int, flags: int, length: int, word: int, mode: int, t_us: int,
) -> int:  # fmt: skip
    """0: send it. Otherwise the reason why it must not be sent; the first one latches the gate.

    ``config_array`` (1,) of ``GATE``, ``memory_array`` (1,) of ``GATE_MEMORY``.
    """
    config, memory = config_array[0], memory_array[0]
    reason = _judge(config, memory, can_id, flags, length, word, mode, t_us)
    if reason != 0:
        memory["blocked_frames"] += 1
        if memory["latched"] == 0:
            memory["latched"] = reason
    return reason


@kernel
def _judge(
    config: np.void, memory: np.void, can_id: int, flags: int, length: int, word: int, mode: int, t_us: int
) -> int:
    permitted = _ROWS[mode] if 0 <= mode < _MODES else 0
    if memory["latched"] != 0:
        permitted &= _ALWAYS
    if flags & UNUSUAL:
        return _BAD_UNUSUAL
    if flags != 0 and (config["fd"] == 0 or (flags != FD and flags != FD_FAST)):
        return _BAD_FORMAT
    if can_id == config["drive_id"]:
        return judge_drive(config, memory, length, word, permitted, t_us)
    if can_id == SYNC_ID:
        if permitted & _SYNC == 0:
            return _NOT_NOW | _SYNC
        if not (length == 0 or (length == 1 and 1 <= word & 0xFF <= 240)):
            return _BAD_SYNC
        memory["syncs"] = 1 if memory["syncs"] == 0 else 2
        memory["output_due"] = 1
        return 0
    if can_id == config["output_id"]:
        return judge_outputs(memory, length, word, permitted)
    if can_id == config["heartbeat_id"]:
        if length != 1 or word & 0xFF != _OPERATIONAL:
            return _BAD_HEARTBEAT
        return 0 if permitted & _HEARTBEAT else _NOT_NOW | _HEARTBEAT
    if can_id == NMT_ID:
        return _judge_nmt(config, memory, length, word, permitted)
    if can_id == config["sdo_id"]:
        return _judge_sdo(config, length, word, permitted)
    return _BAD_IDENTIFIER


@kernel
def judge_drive(config: np.void, memory: np.void, length: int, word: int, permitted: int, t_us: int) -> int:
    """The reason for or against a drive frame; one that passes is remembered."""
    if length != config["drive_length"]:
        return _LENGTH
    protected = length == _PROTECTED_LENGTH
    a = (word & 0xFFFF ^ 0x8000) - 0x8000
    b = (word >> 16 & 0xFFFF ^ 0x8000) - 0x8000
    c = (word >> 32 & 0xFFFF ^ 0x8000) - 0x8000
    counter = word >> 48 & 0xFF
    was = memory["count"]
    since_us = t_us - memory["time_us"]
    if a == 0 and b == 0 and c == 0:
        # 0 V may come at any step and right behind a voltage; only a useless or a babbling one is held back.
        if permitted & _DRIVE_ZERO == 0:
            return _NOT_NOW | _DRIVE_ZERO
        if protected and counter == memory["counter"]:
            return _REPEATED
        if was[0] == 0 and was[1] == 0 and was[2] == 0 and since_us < config["spacing_us"]:
            return _TOO_SOON
        # The node may ignore a frame whose counter jumped: then its combs hold it only from the next one on.
        known = not protected or memory["counter"] < 0 or counter == memory["counter_next"]
    else:
        if permitted & _DRIVE == 0:
            return _LATCHED if memory["latched"] != 0 else _NOT_NOW | _DRIVE
        maximum, slew = config["count_max"], config["count_slew_max"]
        if not (0 <= a <= maximum and 0 <= b <= maximum and 0 <= c <= maximum):
            return _RANGE
        if memory["known"] == 0 or memory["syncs"] == 2:
            return _UNKNOWN
        if memory["syncs"] == 0:
            return _SECOND
        if not (-slew <= a - was[0] <= slew and -slew <= b - was[1] <= slew and -slew <= c - was[2] <= slew):
            return _STEP
        if since_us < config["spacing_us"]:
            return _TOO_SOON
        if protected and counter != memory["counter_next"]:
            return _COUNTER
        known = True
    if protected:
        if word >> 56 & 0xFF != crc_of(config["crc_start"], word):
            return _BAD_CRC
        memory["counter"] = counter
        memory["counter_next"] = counter + 1 & 0xFF
    was[0], was[1], was[2] = a, b, c
    memory["known"] = 1 if known else 0
    memory["time_us"] = t_us
    memory["syncs"] = 0
    return 0


@kernel
def judge_outputs(memory: np.void, length: int, word: int, permitted: int) -> int:
    """The reason for or against a frame with digital outputs: one between two SYNCs, and no bit but the known ones."""
    if length != 1:
        return _OUTPUT_LENGTH
    if permitted & _OUTPUTS == 0:
        return _LATCHED if memory["latched"] != 0 else _NOT_NOW | _OUTPUTS
    if word & 0xFF & ~OUTPUT_BITS != 0:
        return _OUTPUT_BITS
    if memory["output_due"] == 0:
        return _OUTPUT_SECOND
    memory["output_due"] = 0
    return 0


@kernel
def crc_of(start: int, word: int) -> int:
    """CRC of the first seven bytes. A CRC is linear: ``start``, which the identifier leaves, is added at the end."""
    crc = 0
    for place in range(7):
        crc = _CRC[crc ^ (word >> 8 * place & 0xFF)]
    return crc ^ start


@kernel
def _judge_nmt(config: np.void, memory: np.void, length: int, word: int, permitted: int) -> int:
    command = word & 0xFF
    if command == 0x01:  # CiA 301, 7.2.8.2
        kind = _START
    elif command == 0x02:
        kind = _STOP
    elif command == 0x80:
        kind = _PRE_OPERATIONAL
    elif command == 0x81 or command == 0x82:
        kind = _RESET
    else:
        return _BAD_NMT
    if length != 2:
        return _BAD_NMT
    if word >> 8 & 0xFF != config["node_id"]:
        return _BAD_NMT_NODE
    if permitted & kind == 0:
        return _NOT_NOW | kind
    memory["known"] = 0
    if kind == _RESET:
        memory["counter"] = -1
    return 0


@kernel
def _judge_sdo(config: np.void, length: int, word: int, permitted: int) -> int:
    if length != 8:
        return _SDO_LENGTH
    if is_read(word):
        return 0 if permitted & _READ else _NOT_NOW | _READ
    if permitted & _WRITE == 0:
        return _NOT_NOW | _WRITE
    return _SDO_WRITE if write_refusal(config["writes"], word) != 0 else 0


@kernel
def clear(memory_array: Records) -> None:
    """Let the mode's frames pass again. What was sent last stays remembered, so the slew limit holds across it."""
    memory_array[0]["latched"] = 0
