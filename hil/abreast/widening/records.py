"""Records of ``LANES`` devices as the widened kernels see them: each number of theirs side by side."""

from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.abreast.widening.text import LANES

Bytes = NDArray[np.uint8]


class Run(NamedTuple):
    """Numbers of the same size in a record, one behind the other: where the first is, in numbers of that size."""

    size: int
    first: int
    many: int


def side_by_side(records: NDArray[np.void]) -> Bytes:
    """(n,) records, n a multiple of ``LANES``, as (n / LANES, bytes): a group in each row, which begins on a cache line
    if the bytes of a record are a multiple of eight.
    """
    size, groups = records.dtype.itemsize, len(records) // LANES
    raw = np.ascontiguousarray(records).view(np.uint8).reshape(groups, LANES, size)
    found = _on_a_line(groups * size * LANES).reshape(groups, size * LANES)
    for run in _runs(records.dtype):
        _of_groups(found, run)[:] = _of_lanes(raw, run).swapaxes(1, 2)
    return found


def one_by_one(groups: Bytes, dtype: np.dtype[Any]) -> NDArray[np.void]:
    """The way back: (n,) records, what lies between their fields 0."""
    raw = np.zeros((len(groups), LANES, dtype.itemsize), np.uint8)
    for run in _runs(dtype):
        _of_lanes(raw, run)[:] = _of_groups(groups, run).swapaxes(1, 2)
    return raw.reshape(-1).view(dtype)


def _of_lanes(raw: Bytes, run: Run) -> NDArray[Any]:
    """(groups, LANES, many) of a run's numbers, in records one by one."""
    return raw.view(f"u{run.size}")[:, :, run.first : run.first + run.many]


def _of_groups(groups: Bytes, run: Run) -> NDArray[Any]:
    """(groups, many, LANES) of the same, side by side."""
    numbers = groups.view(f"u{run.size}").reshape(len(groups), -1, LANES)
    return numbers[:, run.first : run.first + run.many]


@cache
def _runs(dtype: np.dtype[Any]) -> tuple[Run, ...]:
    """Of a record whose fields are aligned to their sizes."""
    found: list[Run] = []
    for offset, size in _numbers(dtype, 0):
        last = found[-1] if found else Run(0, 0, 0)
        if offset % size or dtype.itemsize % size:
            raise ValueError(f"a number of {size} bytes at {offset}: fields have to be aligned")
        if last.size == size and last.first + last.many == offset // size:
            found[-1] = last._replace(many=last.many + 1)
        else:
            found.append(Run(size, offset // size, 1))
    return tuple(found)


def _numbers(dtype: np.dtype[Any], base: int) -> Iterator[tuple[int, int]]:
    """Offset and bytes of each number in a record."""
    if dtype.subdtype is not None:
        each, shape = dtype.subdtype
        for n in range(int(np.prod(shape))):
            yield from _numbers(each, base + n * each.itemsize)
    elif dtype.fields is not None:
        for kind, offset, *_ in sorted(dtype.fields.values(), key=lambda field: field[1]):
            yield from _numbers(kind, base + offset)
    else:
        yield base, dtype.itemsize


def _on_a_line(size: int) -> Bytes:
    """Zeros that begin on a cache line of 64 bytes."""
    room = np.zeros(size + 64, np.uint8)
    begin = -room.ctypes.data % 64
    return room[begin : begin + size]
