"""What client and server say to each other: JSON texts, and blocks of telemetry as bytes.

Lengths in m, times in s unless a name says otherwise.
"""

import json
import math
import struct
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

SUBPROTOCOL = "pkxyz.1"
TOKEN_PREFIX = "token."
TEXT_MAX_BYTES = 4_000_000
"""Of one message from a client: a table of some ten thousand rows."""

Precision = Literal["f4", "f8"]

_HEAD = struct.Struct("<I")


@dataclass(frozen=True)
class Block:
    """Rows of telemetry, one a tick, without a gap but those of ``lost``."""

    first_tick: int
    columns: dict[str, NDArray[np.floating]]
    """by field: (n,) or (n, 3)"""
    lost: int = 0
    """rows left out before this block, because whoever reads was too slow"""

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def __getitem__(self, field: str) -> NDArray[np.floating]:
        """A field: (n,) or (n, 3)."""
        return self.columns[field]


def packed(block: Block, precision: Precision) -> bytes:
    """A block as bytes: the length of a JSON head, the head, then each field's values one after another."""
    fields = [[name, math.prod(values.shape[1:])] for name, values in block.columns.items()]
    head = json.dumps(
        {"first": block.first_tick, "count": len(block), "lost": block.lost, "fields": fields, "dtype": f"<{precision}"}
    ).encode()
    head += b" " * (-(len(head) + _HEAD.size) % 8)  # so that arrays begin where a browser may look at them
    data = [np.ascontiguousarray(values, f"<{precision}").tobytes() for values in block.columns.values()]
    return b"".join((_HEAD.pack(len(head)), head, *data))


def unpacked(data: bytes) -> Block:
    """What ``packed`` made. Raises ``ValueError``."""
    (length,) = _HEAD.unpack_from(data)
    at = _HEAD.size + length
    head: dict[str, Any] = json.loads(data[_HEAD.size : at])
    dtype, count = np.dtype(head["dtype"]), int(head["count"])
    columns: dict[str, NDArray[np.floating]] = {}
    for name, width in head["fields"]:
        values = np.frombuffer(data, dtype, count * width, at)
        columns[name] = values if width == 1 else values.reshape(count, width)
        at += values.nbytes
    return Block(int(head["first"]), columns, int(head["lost"]))
