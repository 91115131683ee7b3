"""Frames without their history: what a process PDO or a SYNC counts is counted from where its sender is."""

from typing import Any, Final, NamedTuple

from configurations import DRIVE, EMCY, SENSE, SYNC
from states import Bases

from pkxyz_ctrl.can.codec import ProcessCodec
from pkxyz_ctrl.can.frame import Frame

SYNCS: Final = 240
_CODECS: Final = {DRIVE: ProcessCodec(DRIVE, True), SENSE: ProcessCodec(SENSE, True)}


class Relative(NamedTuple):
    """A frame without its history: its payload, or what a process PDO or a SYNC holds, counted from `Bases`."""

    can_id: int
    flags: int
    payload: tuple[Any, ...] | bytes


def relative(frame: Frame, bases: Bases) -> Relative:
    can_id, data, flags = frame
    if can_id in _CODECS and len(data) == 8:
        a, b, c, counter, is_right = _CODECS[can_id].decode(data)
        base = bases.drive if can_id == DRIVE else bases.sense
        return Relative(can_id, flags, (a, b, c, (counter - base) & 0xFF, is_right))
    if can_id == SYNC and len(data) == 1:
        return Relative(can_id, flags, ((data[0] - bases.sync) % SYNCS,))
    if can_id == EMCY:  # its code decides, the rest is words
        return Relative(can_id, flags, data[:2] + bytes(len(data) - 2))
    return Relative(can_id, flags, data)


def absolute(frame: Relative, bases: Bases) -> Frame:
    can_id, flags, payload = frame
    if isinstance(payload, bytes):
        return Frame._make((can_id, payload, flags))
    if can_id == SYNC:
        return Frame._make((can_id, bytes(((payload[0] + bases.sync - 1) % SYNCS + 1,)), flags))
    a, b, c, counter, is_right = payload
    base = bases.drive if can_id == DRIVE else bases.sense
    data = _CODECS[can_id].encode((a, b, c), (counter + base) & 0xFF)
    return Frame._make((can_id, data if is_right else data[:7] + bytes((data[7] ^ 1,)), flags))
