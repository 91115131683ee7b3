"""Which SDO requests may go to the amplifier: reads, and writes of a short list of objects with harmless values.

The gate's own reading of CiA 301 (7.2.4) and CiA 401, on purpose not shared with the driver that makes the requests.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

_REQUEST: Final = struct.Struct("<BHBI")
_DOWNLOAD_SIZE: Final = {0x2F: 1, 0x2B: 2, 0x27: 3, 0x23: 4}  # expedited with size said; nothing else is let through
_UPLOAD: Final = 0x40
_UPLOAD_SEGMENT: Final = (0x60, 0x70)
_ABORT: Final = 0x80
_COB_ID_OFF: Final = 1 << 31
_COB_ID_MASK: Final = 0x3FFFFFFF  # without "off" (bit 31) and "no remote frame" (bit 30)


class WriteContext(NamedTuple):
    """What the values are compared with. ``object_index``, ``subindex``: what is being written; ``drive_index``: the
    communication parameter of the drive PDO, ``drive_id`` its identifier, ``drive_channels`` the sub-indices of 0x6411.
    """

    node_id: int
    controller_node_id: int
    heartbeat_timeout_max_ms: int
    count_slew_max: int
    drive_index: int
    drive_id: int
    drive_channels: tuple[int, int, int]
    object_index: int = 0
    subindex: int = 0


@dataclass(frozen=True, slots=True)
class WriteRule:
    """Objects first..last, sub-indices sub_first..sub_last: exactly ``size`` bytes, a value that ``accepts`` takes."""

    first: int
    last: int
    sub_first: int
    sub_last: int
    size: int
    what: str
    permitted: str
    accepts: Callable[[int, WriteContext], bool]

    def covers(self, index: int, subindex: int) -> bool:
        return self.first <= index <= self.last and self.sub_first <= subindex <= self.sub_last


def _anything(value: int, context: WriteContext) -> bool:
    return True


def _is(*values: int) -> Callable[[int, WriteContext], bool]:
    return lambda value, context: value in values


def _not_zero(value: int, context: WriteContext) -> bool:
    return value > 0


def _our_heartbeat(value: int, context: WriteContext) -> bool:
    timeout_ms = value & 0xFFFF
    return value >> 16 == context.controller_node_id and 1 <= timeout_ms <= context.heartbeat_timeout_max_ms


def _in_time(value: int, context: WriteContext) -> bool:
    return 1 <= value <= context.heartbeat_timeout_max_ms


def _step(value: int, context: WriteContext) -> bool:
    return 1 <= value <= context.count_slew_max


def _drive_or_off(value: int, context: WriteContext) -> bool:
    if context.object_index == context.drive_index and value & _COB_ID_MASK == context.drive_id:
        return True
    return bool(value & _COB_ID_OFF)


def _of_a_comb(only: int) -> Callable[[int, WriteContext], bool]:
    return lambda value, context: value == only and context.subindex in context.drive_channels


def _every_sync(value: int, context: WriteContext) -> bool:
    return context.object_index == context.drive_index and value == 1


def _drive_field(value: int, context: WriteContext) -> bool:
    """All that a PDO may write: three counts, alive counter, CRC. Never 0x6444, 0x2010 or 0x1016."""
    counts = (0x6411_0010 | channel << 8 for channel in context.drive_channels)
    return value in (0, *counts, 0x2000_0108, 0x2000_0208)


def _own_or_off(value: int, context: WriteContext) -> bool:
    own = [base + context.node_id for base in (0x180, 0x280, 0x380, 0x480)]
    return bool(value & _COB_ID_OFF) or value & _COB_ID_MASK in own


WRITE_RULES: Final = (
    WriteRule(0x1005, 0x1005, 0, 0, 4, "identifier of SYNC", "0x080, the node not its producer", _is(0x80)),
    WriteRule(0x1016, 0x1016, 1, 1, 4, "consumer of our heartbeat", "our node id, 1 ms to the limit", _our_heartbeat),
    WriteRule(0x1017, 0x1017, 0, 0, 2, "the node's heartbeat", "1 ms or more, never off", _not_zero),
    WriteRule(0x1019, 0x1019, 0, 0, 1, "overflow of the SYNC counter", "240", _is(240)),
    WriteRule(0x1029, 0x1029, 1, 1, 1, "behaviour on communication error", "0 or 2, never 'carry on'", _is(0, 2)),
    WriteRule(0x1400, 0x15FF, 1, 1, 4, "identifier of a receive PDO", "drive PDO: its own; or off", _drive_or_off),
    WriteRule(0x1400, 0x15FF, 2, 2, 1, "receive PDO: transmission type", "drive PDO: 1, every SYNC", _every_sync),
    WriteRule(0x1600, 0x17FF, 0, 0, 1, "receive mapping: number of entries", "0 to 5", _is(*range(6))),
    WriteRule(0x1600, 0x17FF, 1, 64, 4, "receive mapping: entry", "0x6411 of a comb, 0x2000, none", _drive_field),
    WriteRule(0x1800, 0x19FF, 1, 1, 4, "identifier of a transmit PDO", "the node's own four; or off", _own_or_off),
    WriteRule(0x1800, 0x19FF, 2, 2, 1, "transmit PDO: transmission type", "any", _anything),
    WriteRule(0x1800, 0x19FF, 3, 3, 2, "transmit PDO: inhibit time", "any", _anything),
    WriteRule(0x1800, 0x19FF, 5, 5, 2, "transmit PDO: event timer", "any", _anything),
    WriteRule(0x1A00, 0x1BFF, 0, 0, 1, "transmit mapping: number of entries", "any", _anything),
    WriteRule(0x1A00, 0x1BFF, 1, 64, 4, "transmit mapping: entry", "any", _anything),
    WriteRule(0x2010, 0x2010, 0, 0, 1, "SYNCs without a drive PDO until 0 V", "1 or more, never off", _not_zero),
    WriteRule(0x2011, 0x2011, 0, 0, 2, "largest step of a drive count", "1 to our own slew limit", _step),
    WriteRule(0x2012, 0x2012, 0, 0, 2, "time without an applied drive PDO", "1 ms to the limit", _in_time),
    WriteRule(0x6443, 0x6443, 1, 254, 1, "error mode of a comb", "1, use the error value", _of_a_comb(1)),
    WriteRule(0x6444, 0x6444, 1, 254, 4, "error value of a comb", "0, that is 0 V", _of_a_comb(0)),
)


def _fields(data: bytes) -> tuple[int, int, int, int]:
    command, index, subindex, value = _REQUEST.unpack(data)
    return command, index, subindex, value


def is_read(data: bytes) -> bool:
    """Whether eight bytes are an upload request, the request of a further segment, or an abort; padding must be 0."""
    command, index, subindex, rest = _fields(data)
    if command == _UPLOAD:
        return rest == 0
    if command in _UPLOAD_SEGMENT:
        return index == 0 and subindex == 0 and rest == 0
    return command == _ABORT


def write_refusal(data: bytes, limits: WriteContext) -> str | None:
    """Why the eight bytes are not a permitted write; None if they are."""
    command, index, subindex, value = _fields(data)
    size = _DOWNLOAD_SIZE.get(command)
    if size is None:
        return f"SDO command 0x{command:02X} is neither a read nor an expedited write with its size"
    name = f"0x{index:04X}:{subindex:02X}"
    if value >> 8 * size:
        return f"SDO write of {name}: the bytes behind its {size} are not empty"
    context = limits._replace(object_index=index, subindex=subindex)
    for rule in WRITE_RULES:
        if rule.covers(index, subindex):
            if size != rule.size:
                return f"SDO write of {name} ({rule.what}): {size} bytes instead of {rule.size}"
            if not rule.accepts(value, context):
                return f"SDO write of {name} ({rule.what}): 0x{value:X} is not permitted; permitted: {rule.permitted}"
            return None
    return f"SDO write of {name}: not in the list of objects that may be written"
