"""Records of ``LANES`` devices as the widened kernels see them: each number of theirs eightfold, side by side."""

from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.abreast.text import LANES

Bytes = NDArray[np.uint8]


def side_by_side(records: NDArray[np.void]) -> Bytes:
    """(n,) records, n a multiple of ``LANES``, as (n / LANES, bytes): a group in each row, which begins on a cache line
    if the bytes of a record are a multiple of eight.
    """
    where, size = _where(records.dtype), records.dtype.itemsize
    groups = len(records) // LANES
    raw = np.frombuffer(records.tobytes(), np.uint8).reshape(groups, LANES, size)
    found = _on_a_line(groups * size * LANES).reshape(groups, size * LANES)
    for lane in range(LANES):
        told = where[lane] >= 0
        found[:, where[lane][told]] = raw[:, lane, told]
    return found


def one_by_one(groups: Bytes, dtype: np.dtype[Any]) -> NDArray[np.void]:
    """The way back: (n,) records, what lies between their fields 0."""
    where = _where(dtype)
    raw = np.zeros((len(groups), LANES, dtype.itemsize), np.uint8)
    for lane in range(LANES):
        told = where[lane] >= 0
        raw[:, lane, told] = groups[:, where[lane][told]]
    return np.frombuffer(raw.tobytes(), dtype)


@cache
def _where(dtype: np.dtype[Any]) -> NDArray[np.int64]:
    """(LANES, itemsize): where each byte of a lane's record lies in a group; -1 for what is between fields."""
    found = np.full((LANES, dtype.itemsize), -1, np.int64)
    for offset, size in _numbers(dtype, 0):
        for lane in range(LANES):
            found[lane, offset : offset + size] = offset * LANES + lane * size + np.arange(size)
    return found


def _numbers(dtype: np.dtype[Any], base: int) -> Iterator[tuple[int, int]]:
    """Offset and bytes of each number in a record."""
    if dtype.subdtype is not None:
        each, shape = dtype.subdtype
        for n in range(int(np.prod(shape))):
            yield from _numbers(each, base + n * each.itemsize)
    elif dtype.fields is not None:
        for kind, offset, *_ in dtype.fields.values():
            yield from _numbers(kind, base + offset)
    else:
        yield base, dtype.itemsize


def _on_a_line(size: int) -> Bytes:
    """Zeros that begin on a cache line of 64 bytes."""
    room = np.zeros(size + 64, np.uint8)
    begin = -room.ctypes.data % 64
    return room[begin : begin + size]
