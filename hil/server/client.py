"""A client of the desk: what it has asked to see, and what waits for its socket."""

import asyncio
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.server.messages import FIELDS, AskedWrongError
from pkxyz_ctrl.client.protocol import Block, Precision, packed

SAID_MOST, _BLOCKS_MOST = 400, 4


class Moment:
    """Telemetry of the same ticks for all who look on. What several see alike is packed once."""

    def __init__(self, first_tick: int, values: dict[str, NDArray[Any]]) -> None:
        """``values``: (n,) or (n, 3) by field, of every field that can be asked for."""
        self._first_tick, self._values = first_tick, values
        self._packed: dict[tuple[tuple[str, ...], Precision, int], bytes] = {}

    def __len__(self) -> int:
        return len(next(iter(self._values.values())))

    def of(self, fields: tuple[str, ...], precision: Precision, lost: int) -> bytes:
        """Some fields as bytes, for one who has ``lost`` so many rows before them."""
        key = (fields, precision, lost)
        if key not in self._packed:
            block = Block(self._first_tick, {name: np.asarray(self._values[name]) for name in fields}, lost)
            self._packed[key] = packed(block, precision)
        return self._packed[key]


class Client:
    """One that is connected. ``said`` waits for its socket; what is too much for a slow one is left out."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.said: asyncio.Queue[str | bytes | None] = asyncio.Queue(SAID_MOST)
        self._status: str | None = None  # the newest that waits; None in the queue stands for it
        self.fields: tuple[str, ...] = ()
        self.precision: Precision = "f4"
        self.tags: dict[int, Any] = {}
        self.lost = 0
        self._blocks = 0
        self.is_hopeless = False

    def subscribe(self, message: dict[str, Any]) -> None:
        """What it wants to see of telemetry. Raises ``AskedWrongError``."""
        fields, precision = message.get("fields", []), message.get("precision", "f4")
        unknown = [f for f in fields if f not in FIELDS] if isinstance(fields, list) else [fields]
        if unknown or len(fields) > len(FIELDS):
            raise AskedWrongError(f"no telemetry is called {unknown[:1]}; there are: {', '.join(sorted(FIELDS))}")
        if precision not in ("f4", "f8"):
            raise AskedWrongError("precision is f4 or f8")
        self.fields, self.precision = tuple(dict.fromkeys(fields)), precision

    def tell(self, message: dict[str, Any]) -> None:
        """Queue a message; a client that takes none of hundreds is given up."""
        self._put(json.dumps(message, allow_nan=False))

    def tell_status(self, text: str) -> None:
        """Queue where the stage is, in place of what waits of that: one who is slow is not late as well."""
        if self._status is None:
            self._put(None)
        self._status = text

    def _put(self, said: str | bytes | None) -> None:
        try:
            self.said.put_nowait(said)
        except asyncio.QueueFull:
            self.is_hopeless = True

    def show(self, moment: Moment) -> None:
        """Queue what it has asked to see of telemetry, or leave it out and count its rows."""
        if not self.has_room:
            self.lost += len(moment)
            return
        self._give(moment.of(self.fields, self.precision, self.lost))
        self.lost = 0

    @property
    def has_room(self) -> bool:
        """Whether another block may wait for its socket."""
        return self._blocks < _BLOCKS_MOST and not self.said.full()

    def show_opened(self, about: dict[str, Any], block: Block) -> None:
        """Queue a recording: what it is, and its rows. Only where it ``has_room``."""
        self.tell({"recording": about})
        self._give(packed(block, "f4"))

    def _give(self, block: bytes) -> None:
        self._put(block)
        self._blocks += 1

    async def next_said(self) -> str | bytes:
        """What comes next."""
        said = await self.said.get()
        if said is None:
            said, self._status = str(self._status), None
        elif isinstance(said, bytes):
            self._blocks -= 1
        return said
