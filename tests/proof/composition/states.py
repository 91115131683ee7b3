"""The two sides' states: taken, put back, and named by a key; each by itself.

What a side is asked next, and what it answers, follows from its key alone (`snapshot` says why), with counters and
times relative to `Bases`: an alive counter to that of its sender, an instant to now.
"""

import hashlib
import marshal
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from snapshot import LONG_US, Snapshot, attributes_of

from hil.bus.clock import Lockstep
from hil.node.amplifier import AmplifierNode
from pkxyz_ctrl.can.driver_rules import DriverState
from pkxyz_ctrl.can.start_plan import VALUE
from pkxyz_ctrl.loop.controller import Controller

Key = bytes

DICTIONARY_UNREAD = {0x1001, 0x1003, 0x2000, 0x2001, 0x6401, 0x6411}
_ASKED = ("blocked", "event", "clearing", "restart_due", "is_restarting")
_IN_DIALOGUE = (DriverState.IDENTIFYING, DriverState.CONFIGURING)

# Of the controller's record, what the law computes with and writes down is left out: any law is explored.
_MONITORS_UNREAD = (
    "unexplained_trend_n", "commanded_trend_n", "commanded_n", "moved_n", "frozen", "frozen_sense_count",
)  # fmt: skip

# Of the start-up's record, what decides in every state; the others are read in the dialogue, or before the trial ends.
_START_ALWAYS = ("tried_identity", "has_tried", "repeats_left", "is_tried", "times_left", "never_booted")
_START_IN_DIALOGUE = ("known", "steps", "position", "tries", "is_planned")
_BEFORE_TRIAL = (DriverState.RESETTING, DriverState.STARTING, DriverState.TRYING)


class Bases(NamedTuple):
    """What times and counters are relative to."""

    now_us: int = 0
    drive: int = 0  # alive counter of the next drive frame
    sense: int = 0  # of the last sense frame
    sync: int = 0  # of the last SYNC


class ControllerState:
    """Of the shipped controller."""

    def __init__(self, controller: Controller) -> None:
        node_period_us = 1000 * controller.driver.config.node_heartbeat_period_ms
        long_us = LONG_US * -(-node_period_us // controller.period_us)  # longer than it may be silent, and operational
        self._snapshot = Snapshot(attributes_of([controller]), gate=controller.gate.memory[0], long_us=long_us)
        self._controller, self._memory = controller, controller.memory
        self._safe_cycles = int(controller.law["limits"]["safe_cycles"][0])
        self._words = controller.exchange.view(np.int64)
        self._first = self._words.copy()
        self._cycle = controller.memory.view(np.uint8)
        self._named = np.flatnonzero(_mask_of(controller.memory.dtype))
        self._start, self._asked = controller.driver.memory["start"][0], controller.exchange[list(_ASKED)]
        self._start_bytes, always = self._start.view(np.uint8), np.zeros(self._start.itemsize, np.uint8)
        for name in _START_ALWAYS:
            _fill(always, self._start.dtype, (name,))
        self._always = np.flatnonzero(always)

    def take(self) -> tuple[Any, ...]:
        other = np.flatnonzero(self._words != self._first).astype(np.uint16)
        return self._snapshot.take(), other, self._words[other]

    def put(self, taken: tuple[Any, ...]) -> None:
        attributes, other, words = taken
        self._snapshot.put(attributes)
        self._words[:] = self._first
        self._words[other] = words

    def key(self, bases: Bases) -> Key:
        record, driver = self._memory[0], self._controller.driver
        parts = (
            self._snapshot.name(*bases),
            int(record["homing_count"]) if record["mode"] == 3 else 0,
            self._asked[0].tolist(),
            int(self._controller.outputs["bits"][0]),  # asked for, and not sent yet
            _start_up(self._start[0], driver.state, bases.now_us),
            min(int(record["safe_cycles"]), self._safe_cycles),
            self._start_bytes[self._always].tobytes(),
            self._cycle[self._named].tobytes(),
        )
        return hashlib.blake2b(marshal.dumps(parts, 2), digest_size=16).digest()


class NodeState:
    """Of the shipped node and its clock."""

    def __init__(self, node: AmplifierNode, clock: Lockstep) -> None:
        self._snapshot = Snapshot(attributes_of([node, clock]), node=node)
        self._entries = [entry for entry in node.od if entry.access != "const"]
        self._named = [i for i, entry in enumerate(self._entries) if entry.index not in DICTIONARY_UNREAD]
        self._value_of = attrgetter("value")
        self._dictionary: tuple[tuple[Any, ...], bytes] = ((), b"")

    def take(self) -> tuple[Any, ...]:
        """To be called behind `key`."""
        return self._snapshot.take(), self._dictionary

    def put(self, taken: tuple[Any, ...]) -> None:
        there = self._dictionary  # since `key`, which is the last thing that happens in each state
        attributes, self._dictionary = taken
        self._snapshot.put(attributes)
        if self._dictionary[0] is not there[0]:
            for entry, value in zip(self._entries, self._dictionary[0], strict=True):
                entry.value = value

    def key(self, bases: Bases, counts: tuple[int, int, int]) -> Key:
        """``counts``: what the converters have."""
        values = tuple(map(self._value_of, self._entries))
        if values != self._dictionary[0]:
            self._dictionary = values, marshal.dumps([values[i] for i in self._named], 2)
        digest = hashlib.blake2b(marshal.dumps((self._snapshot.name(*bases), counts), 2), digest_size=16)
        digest.update(self._dictionary[1])
        return digest.digest()


def _start_up(record: np.void, state: DriverState, now_us: int) -> Any:
    told: list[Any] = []
    if state in _IN_DIALOGUE:
        told += [record[name].tobytes() for name in _START_IN_DIALOGUE]
        told += [record[name][: record["steps"]].tobytes() for name in ("row", "act")]
        told.append((record["found"] * (record["known"] == VALUE)).tobytes())
        told.append(max(int(record["answer_due_us"]) - now_us, -1))
    if state in _BEFORE_TRIAL:
        told.append(max(int(record["deadline_us"]) - now_us, -1))
    return told


def _mask_of(dtype: np.dtype[Any]) -> NDArray[np.uint8]:
    """Ones where the bytes of the controller's record belong to the key."""
    mask = np.zeros(1, dtype)
    mask.view(np.uint8)[:] = 0
    for name in ("monitors", "mode", "homed"):
        mask[name].view(np.uint8)[:] = 0xFF if name != "monitors" else 0
    whole = mask.view(np.uint8)
    for name in mask.dtype["monitors"].names or ():
        if name not in _MONITORS_UNREAD:
            _fill(whole, dtype, ("monitors", name))
    for path in (("mode",), ("homed",), ("landing_age",), ("landed_by",), ("input", "trips")):
        _fill(whole, dtype, path)
    first_count = _offset(dtype, ("tick", "count"))
    whole[first_count : first_count + 12] = 0xFF
    return whole


def _offset(dtype: np.dtype[Any], path: tuple[str, ...]) -> int:
    at = 0
    for name in path:
        assert dtype.fields is not None
        dtype, offset = dtype.fields[name][:2]
        at += offset
    return at


def _fill(whole: NDArray[np.uint8], dtype: np.dtype[Any], path: tuple[str, ...]) -> None:
    at, size = _offset(dtype, path), dtype
    for name in path:
        assert size.fields is not None
        size = size.fields[name][0]
    whole[at : at + size.itemsize] = 0xFF
