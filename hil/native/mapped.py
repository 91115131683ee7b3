"""The file that a native loop shares with us: memory without a name, which is gone when the last of us is."""

import mmap
import os

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.export.shared import MAGIC, PATH, SHARED, size_of
from pkxyz_ctrl.export.structs import layout

Records = NDArray[np.void]

BLOCKS = 32
"""Of the path: 33 000 rows, 6.5 s at 5 kHz."""
RING_BYTES = 1 << 24
"""Rows and frames of some seconds at 5 kHz, for a writer that stands still."""


class Mapped:
    """``shared`` (1,) of ``SHARED``, ``blocks`` (n,) of ``PATH``, ``ring`` bytes; ``descriptor`` is what a process of
    ours inherits, which finds it again at ``path``.
    """

    def __init__(self, blocks: int = BLOCKS, ring_bytes: int = RING_BYTES) -> None:
        size = size_of(blocks, ring_bytes)
        self.descriptor = os.memfd_create("pkxyz-loop")
        os.truncate(self.descriptor, size)
        self._memory = mmap.mmap(self.descriptor, size)
        self.shared = np.frombuffer(self._memory, SHARED, 1)
        self.blocks = np.frombuffer(self._memory, PATH, blocks, SHARED.itemsize)
        self.ring = memoryview(self._memory)[size - ring_bytes :]
        self.blocks["number"] = -1
        settings = self.shared["settings"][0, 0]
        settings["magic"], settings["layout"] = MAGIC, layout()
        settings["blocks"], settings["ring_bytes"] = blocks, ring_bytes

    @property
    def path(self) -> str:
        """By which a process that inherits the descriptor opens it."""
        return f"/proc/self/fd/{self.descriptor}"

    @property
    def content(self) -> bytes:
        """All of it."""
        return bytes(self._memory[:])

    def close(self) -> None:
        """Nobody inherits it any more; what is mapped stays."""
        os.close(self.descriptor)


def text_of(words: NDArray[np.uint8]) -> str:
    """Words that the loop has left, up to the first zero."""
    return bytes(words).partition(b"\0")[0].decode(errors="replace")
