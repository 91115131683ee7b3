"""Which SDO requests may go to the amplifier: reads, and writes of a short list of objects with harmless values.

The gate's own reading of CiA 301 (7.2.4) and CiA 401, on purpose not shared with the driver that makes the requests.
A request is its eight bytes as an integer, the first one lowest: command, index (two bytes), sub-index, value (four).
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel

_UPLOAD: Final = 0x40
_UPLOAD_SEGMENT, _UPLOAD_SEGMENT_TOGGLED = 0x60, 0x70
_ABORT: Final = 0x80
_COB_ID_OFF: Final = 1 << 31
_COB_ID_MASK: Final = 0x3FFFFFFF  # without "off" (bit 31) and "no remote frame" (bit 30)
_PDO_STEP: Final = 0x100
_FIRST_TPDO_ID, _LAST_TPDO_ID = 0x180, 0x480
_OUTPUT_INDEX, _OUTPUT_MAPPING, _OUTPUT_FIELD = 0x1400, 0x1600, 0x6200_0108

WRITES = np.dtype(
    [
        ("drive_index", "i4"),  # communication parameter of the drive PDO
        ("drive_id", "i4"),
        ("output_id", "i4"),  # of RPDO 1 with the digital outputs; -1: there is none
        ("drive_channel", "i4", (3,)),  # sub-indices of 0x6411
        ("node_id", "i4"),
        ("controller_node_id", "i4"),
        ("timeout_max_ms", "i4"),
        ("count_slew_max", "i4"),
    ],
    align=True,
)
"""What the values are compared with."""


class Value(IntEnum):
    """What an object may hold. The first two compare with ``low`` and ``high`` of the rule."""

    BETWEEN = 0
    EITHER = 1
    OUR_HEARTBEAT = 2
    IN_TIME = 3
    STEP = 4
    DRIVE_OR_OFF = 5
    EVERY_SYNC = 6
    DRIVE_FIELD = 7
    OWN_OR_OFF = 8
    OF_A_COMB = 9  # and ``low``, in one of the three channels


class WriteReason(IntEnum):
    """Why a write is not permitted."""

    NONE = 0
    COMMAND = 1
    BEHIND = 2
    UNLISTED = 3
    SIZE = 4
    VALUE = 5


@dataclass(frozen=True, slots=True)
class WriteRule:
    """Objects first..last, sub-indices sub_first..sub_last: exactly ``size`` bytes, a ``value`` of this kind."""

    first: int
    last: int
    sub_first: int
    sub_last: int
    size: int
    what: str
    permitted: str
    value: Value
    low: int = 0
    high: int = 0xFFFFFFFF


_ANY, _EITHER, _COMB, _HEARTBEAT = Value.BETWEEN, Value.EITHER, Value.OF_A_COMB, Value.OUR_HEARTBEAT
WRITE_RULES: Final = (
    WriteRule(0x1005, 0x1005, 0, 0, 4, "identifier of SYNC", "0x080, the node not its producer", _EITHER, 0x80, 0x80),
    WriteRule(
        0x1016, 0x1016, 1, 1, 4, "consumer of our heartbeat", "our node id, 1 ms to the limit", Value.OUR_HEARTBEAT
    ),
    WriteRule(0x1017, 0x1017, 0, 0, 2, "the node's heartbeat", "1 ms or more, never off", Value.BETWEEN, 1),
    WriteRule(0x1019, 0x1019, 0, 0, 1, "overflow of the SYNC counter", "240", _EITHER, 240, 240),
    WriteRule(0x1029, 0x1029, 1, 1, 1, "behaviour on communication error", "0 or 2, never 'carry on'", _EITHER, 0, 2),
    WriteRule(0x1400, 0x15FF, 1, 1, 4, "identifier of a receive PDO", "of ours: its own; or off", Value.DRIVE_OR_OFF),
    WriteRule(0x1400, 0x15FF, 2, 2, 1, "receive PDO: transmission type", "1, every SYNC, of ours", Value.EVERY_SYNC),
    WriteRule(0x1600, 0x17FF, 0, 0, 1, "receive mapping: number of entries", "0 to 5", Value.BETWEEN, 0, 5),
    WriteRule(0x1600, 0x17FF, 1, 64, 4, "receive mapping: entry", "our own fields, or none", Value.DRIVE_FIELD),
    WriteRule(0x1800, 0x19FF, 1, 1, 4, "identifier of a transmit PDO", "the node's own four; or off", Value.OWN_OR_OFF),
    WriteRule(0x1800, 0x19FF, 2, 2, 1, "transmit PDO: transmission type", "any", _ANY),
    WriteRule(0x1800, 0x19FF, 3, 3, 2, "transmit PDO: inhibit time", "any", _ANY),
    WriteRule(0x1800, 0x19FF, 5, 5, 2, "transmit PDO: event timer", "any", _ANY),
    WriteRule(0x1A00, 0x1BFF, 0, 0, 1, "transmit mapping: number of entries", "any", _ANY),
    WriteRule(0x1A00, 0x1BFF, 1, 64, 4, "transmit mapping: entry", "any", _ANY),
    WriteRule(0x2010, 0x2010, 0, 0, 1, "SYNCs without a drive PDO until 0 V", "1 or more, never off", Value.BETWEEN, 1),
    WriteRule(0x2011, 0x2011, 0, 0, 2, "largest step of a drive count", "1 to our own slew limit", Value.STEP),
    WriteRule(0x2012, 0x2012, 0, 0, 2, "time without an applied drive PDO", "1 ms to the limit", Value.IN_TIME),
    WriteRule(0x6443, 0x6443, 1, 254, 1, "error mode of a comb", "1, use the error value", _COMB, 1),
    WriteRule(0x6444, 0x6444, 1, 254, 4, "error value of a comb", "0, that is 0 V", _COMB, 0),
)


def _table() -> NDArray[np.void]:
    numbers = [(r.first, r.last, r.sub_first, r.sub_last, r.size, r.value, r.low, r.high) for r in WRITE_RULES]
    fields = [("first", "u2"), ("last", "u2"), ("sub_first", "u1"), ("sub_last", "u1"), ("size", "u1"), ("value", "u1")]
    table = np.array(numbers, np.dtype([*fields, ("low", "u4"), ("high", "u4")], align=True))
    table.setflags(write=False)
    return table


_RULES: Final = _table()
_BETWEEN, _OUR_HEARTBEAT, _IN_TIME, _STEP, _DRIVE_OR_OFF, _EVERY_SYNC, _DRIVE_FIELD, _OWN_OR_OFF = (
    int(Value[name])
    for name in (
        "BETWEEN", "OUR_HEARTBEAT", "IN_TIME", "STEP", "DRIVE_OR_OFF", "EVERY_SYNC", "DRIVE_FIELD", "OWN_OR_OFF",
    )
)  # fmt: skip
_EITHER_OF: Final = int(Value.EITHER)
_COMMAND, _BEHIND, _UNLISTED, _SIZE, _VALUE = (
    int(WriteReason[name]) for name in ("COMMAND", "BEHIND", "UNLISTED", "SIZE", "VALUE")
)


@kernel
def is_read(word: int) -> bool:
    """Whether eight bytes are an upload request, the request of a further segment, or an abort; padding must be 0."""
    command = word & 0xFF
    if command == _UPLOAD:
        return word >> 32 & 0xFFFFFFFF == 0
    if command in (_UPLOAD_SEGMENT, _UPLOAD_SEGMENT_TOGGLED):
        return word >> 8 == 0
    return command == _ABORT


@kernel
def size_of(word: int) -> int:
    """Bytes of an expedited download that says its size; 0 for any other request: nothing else is let through."""
    command = word & 0xFF
    return 4 - (command >> 2 & 3) if command & 0xF3 == 0x23 else 0


@kernel
def rule_of(word: int) -> int:
    """Place in ``WRITE_RULES`` of the rule for the object that a request names; -1: there is none."""
    index, subindex = word >> 8 & 0xFFFF, word >> 24 & 0xFF
    for place in range(len(_RULES)):
        rule = _RULES[place]
        if rule["first"] <= index <= rule["last"] and rule["sub_first"] <= subindex <= rule["sub_last"]:
            return place
    return -1


@kernel
def write_refusal(limits: np.void, word: int) -> int:
    """Why the eight bytes are not a permitted write, a ``WriteReason``; 0 if they are. ``limits`` of ``WRITES``."""
    size, value = size_of(word), word >> 32 & 0xFFFFFFFF
    if size == 0:
        return _COMMAND
    if value >> 8 * size != 0:
        return _BEHIND
    place = rule_of(word)
    if place < 0:
        return _UNLISTED
    rule = _RULES[place]
    if size != rule["size"]:
        return _SIZE
    return 0 if _accepts(limits, rule, word >> 8 & 0xFFFF, word >> 24 & 0xFF, value) else _VALUE


@kernel
def _accepts(limits: np.void, rule: np.void, index: int, subindex: int, value: int) -> bool:
    kind = rule["value"]
    if kind == _BETWEEN:
        return rule["low"] <= value <= rule["high"]
    if kind == _EITHER_OF:
        return value == rule["low"] or value == rule["high"]
    if kind == _OUR_HEARTBEAT:
        is_ours = value >> 16 == limits["controller_node_id"]
        return is_ours and 1 <= value & 0xFFFF <= limits["timeout_max_ms"]
    if kind == _IN_TIME:
        return 1 <= value <= limits["timeout_max_ms"]
    if kind == _STEP:
        return 1 <= value <= limits["count_slew_max"]
    is_drive, is_output = index == limits["drive_index"], limits["output_id"] >= 0 and index == _OUTPUT_INDEX
    if kind == _DRIVE_OR_OFF:
        own = limits["output_id"] if is_output else limits["drive_id"]
        return value & _COB_ID_OFF != 0 or ((is_drive or is_output) and value & _COB_ID_MASK == own)
    if kind == _EVERY_SYNC:
        return (is_drive or is_output) and value == 1
    if kind == _OWN_OR_OFF:
        return value & _COB_ID_OFF != 0 or _is_own(value & _COB_ID_MASK, limits["node_id"])
    if kind == _DRIVE_FIELD:
        if limits["output_id"] >= 0 and index == _OUTPUT_MAPPING:  # whose frames may never carry a voltage
            return value == 0 or value == _OUTPUT_FIELD
        return _is_drive_field(limits, value)
    return value == rule["low"] and _is_channel(limits, subindex)


@kernel
def _is_own(cob_id: int, node_id: int) -> bool:
    """Of the node's four TPDOs."""
    base = cob_id - node_id
    return _FIRST_TPDO_ID <= base <= _LAST_TPDO_ID and (base - _FIRST_TPDO_ID) % _PDO_STEP == 0


@kernel
def _is_channel(limits: np.void, subindex: int) -> bool:
    channel = limits["drive_channel"]
    return subindex == channel[0] or subindex == channel[1] or subindex == channel[2]


@kernel
def _is_drive_field(limits: np.void, value: int) -> bool:
    """All that a PDO may write: three counts, alive counter, CRC. Never 0x6444, 0x2010 or 0x1016."""
    if value == 0 or value == 0x2000_0108 or value == 0x2000_0208:
        return True
    return value & 0xFFFF_00FF == 0x6411_0010 and _is_channel(limits, value >> 8 & 0xFF)


def write_words(reason: int, word: int) -> str:
    """``write_refusal``'s answer for a person."""
    if reason == WriteReason.COMMAND:
        return f"SDO command 0x{word & 0xFF:02X} is neither a read nor an expedited write with its size"
    size, value = size_of(word), word >> 32 & 0xFFFFFFFF
    name = f"SDO write of 0x{word >> 8 & 0xFFFF:04X}:{word >> 24 & 0xFF:02X}"
    if reason == WriteReason.BEHIND:
        return f"{name}: the bytes behind its {size} are not empty"
    if reason == WriteReason.UNLISTED:
        return f"{name}: not in the list of objects that may be written"
    rule = WRITE_RULES[rule_of(word)]
    if reason == WriteReason.SIZE:
        return f"{name} ({rule.what}): {size} bytes instead of {rule.size}"
    return f"{name} ({rule.what}): 0x{value:X} is not permitted; permitted: {rule.permitted}"
