"""Memory that ends where nothing may be read: a look beyond what a board holds ends the program."""

import ctypes
import mmap

import numpy as np
from numpy.typing import NDArray

_PAGE = mmap.PAGESIZE
_libc = ctypes.CDLL(None, use_errno=True)


class Guarded:
    """``bytes`` (size,) up to the end of a page, behind which there is none; ``pointer`` to the first of them."""

    def __init__(self, size: int) -> None:
        held = -(-size // _PAGE) * _PAGE
        self._pages = mmap.mmap(-1, held + _PAGE)
        whole = np.frombuffer(self._pages, np.uint8)
        begin = whole.ctypes.data
        if _libc.mprotect(ctypes.c_void_p(begin + held), ctypes.c_size_t(_PAGE), 0) != 0:
            raise OSError(ctypes.get_errno(), "mprotect")
        self.bytes: NDArray[np.uint8] = whole[held - size : held]
        self.pointer = ctypes.c_void_p(begin + held - size)

    def fill(self, records: NDArray[np.void]) -> None:
        """With as much of them as there is room for."""
        self.bytes[:] = records.view(np.uint8)[: len(self.bytes)]

    def records(self, dtype: np.dtype[np.void]) -> NDArray[np.void]:
        """(1,) of what stands there, and zeros behind it."""
        raw = np.zeros(dtype.itemsize, np.uint8)
        raw[: len(self.bytes)] = self.bytes
        return raw.view(dtype)
