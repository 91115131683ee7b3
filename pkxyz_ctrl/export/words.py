"""Records as the exact words of C arrays, and the digest that a target makes of what it computed."""

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Records = NDArray[np.void]

_A_LINE = 4
FNV_OFFSET, FNV_PRIME = 0xCBF29CE484222325, 0x100000001B3
"""Of the hash FNV-1a with 64 bits (Fowler, Noll, Vo), here over words of 64 bits."""
CANONICAL_NAN = 0x7FF8000000000000
"""Which of the many a processor makes of inf - inf is its own business, so for comparison there is one."""


def words_of(records: Records) -> NDArray[np.uint64]:
    """Words (n,) of records (m,), little-endian, with zeros where nothing is stored."""
    raw = np.ascontiguousarray(records).view(np.uint8).reshape(len(records), records.dtype.itemsize).copy()
    raw[:, ~_stored(records.dtype)] = 0
    return raw.reshape(-1).view("<u8")


@cache
def double_words(dtype: np.dtype[Any]) -> NDArray[np.bool_]:
    """Which words of a record of ``dtype`` are doubles."""
    of_bytes = np.zeros(dtype.itemsize, bool)
    _mark(dtype, 0, of_bytes, doubles=True)
    return of_bytes[::8]  # a double is aligned, so its first byte stands for it


def canonical(records: Records) -> NDArray[np.uint64]:
    """``words_of`` with one NaN for all."""
    words = words_of(records)
    doubles = np.tile(double_words(records.dtype), len(records))
    words[doubles & np.isnan(words.view("<f8"))] = CANONICAL_NAN
    return words


def digest(state: int, words: NDArray[np.uint64]) -> int:
    """``state`` after these words; begin with ``FNV_OFFSET``."""
    for word in words.tolist():
        state = (state ^ word) * FNV_PRIME & 0xFFFF_FFFF_FFFF_FFFF
    return state


def c_words(words: NDArray[np.uint64]) -> str:
    """The inside of an initialiser."""
    texts = [f"0x{word:016x}" for word in words.tolist()]
    return "".join(f"    {', '.join(texts[k : k + _A_LINE])},\n" for k in range(0, len(texts), _A_LINE))


@cache
def _stored(dtype: np.dtype[Any]) -> NDArray[np.bool_]:
    of_bytes = np.zeros(dtype.itemsize, bool)
    _mark(dtype, 0, of_bytes, doubles=False)
    return of_bytes


def _mark(dtype: np.dtype[Any], at: int, of_bytes: NDArray[np.bool_], *, doubles: bool) -> None:
    base, count = dtype.base, int(np.prod(dtype.shape, dtype=int))
    for k in range(count):
        begin = at + k * base.itemsize
        if base.fields:
            for field, offset, *_ in base.fields.values():
                _mark(field, begin + offset, of_bytes, doubles=doubles)
        elif not doubles or base.kind == "f":
            of_bytes[begin : begin + base.itemsize] = True
