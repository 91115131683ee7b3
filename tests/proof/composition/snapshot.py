"""State of live objects: taken, put back, and named by a key in which counters and times are relative.

Nothing is modelled here. `Snapshot` walks from the roots over every object of ours and copies what their attributes
hold, so an attribute that is new tomorrow is part of the state tomorrow. The key of a state is what decides its
future. It leaves out what nothing in the composition reads (texts, histories, records), and holds

- alive counters and SYNC counters as differences to the sender's own, modulo 256 and 240: whatever compares them,
  compares such differences, and CRCs are kept as right or wrong, which no shift of a counter changes
  (``test_smt_crc.py``);
- instants as differences to now, those long past as "past": whatever compares instants, compares differences with a
  limit; of a deadline that is over, only that it is; of an age (`AGES`), what is longer than three ticks is alike;
- counts that only ever are compared with a limit (`SATURATED`) up to that limit.

An attribute that none of these tables names enters the key as it is. So a forgotten one can only keep states apart
that are alike (the exploration would not come to an end), never merge two that differ.
"""

import hashlib
import marshal
import struct
from collections import deque
from collections.abc import Callable, Iterable
from enum import Enum
from operator import attrgetter
from typing import Any

import numpy as np

from hil.node.amplifier import AmplifierNode
from hil.node.object_dictionary import ObjectDictionary
from pkxyz_ctrl.can.driver_rules import DriverState
from pkxyz_ctrl.can.start_plan import VALUE
from pkxyz_ctrl.loop.controller import Controller

DRIVE_ID = 0x30A
LONG_US = 60_000  # three ticks
_NEVER_US = 1 << 61

# Words; and frames, which are gone before anything else happens.
_DRIVER_WORDS = (
    "silent_us", "failed_state", "foreign_id", "foreign_length", "foreign_data",
    "emergency", "emergency_us", "outgoing",
)  # fmt: skip

# What nothing that decides reads: words, statistics, copies for SDO.
UNREAD = {
    ("Controller", "faults"),
    ("Controller", "_reference"),
    ("TransmitGate", "memory.blocked_frames"),
    ("AmplifierDriver", "emergencies"),
    *(("AmplifierDriver", f"memory.{name}") for name in _DRIVER_WORDS),
    ("DriveReceiver", "crc"),
    ("SenseTransmitter", "crc"),
    ("SenseTransmitter", "counts"),
    ("SenseTransmitter", "_sent"),
    ("Alarm", "_armed_us"),  # not after due_us, where it only goes back to sleep
    ("SdoServer", "_multiplexer"),  # of a segmented transfer, which nobody begins
    ("Lockstep", "_order"),
    ("Lockstep", "now_us"),
    ("Lockstep", "running"),
    ("Lockstep", "_heap"),  # the alarms and due times that put them there are in the key
    # the plant stands still: always the same counts, or a status that says otherwise
    *(("SenseInput", f"memory.count[{place}]") for place in range(3)),
}
TEXTS = {
    ("TransmitGate", "latched"),
    ("TransmitGate", "memory.latched"),
    ("AmplifierDriver", "memory.failure"),
}
INSTANTS = {("TransmitGate", "memory.time_us"), ("Alarm", "due_us")}
AGES = {("TransmitGate", "memory.time_us"), ("SenseTransmitter", "sync_us")}
AGES.add(("AmplifierDriver", "memory.node_heartbeat_us"))
DURATIONS = {"cycle_us", "beat_period_us", "time_us", "_event_us", "_drive_timeout_us"}
DRIVE_COUNTERS = {("TransmitGate", "memory.counter"), ("TransmitGate", "memory.counter_next")}
SENSE_COUNTERS = {("SenseInput", "memory.counter")}
SENT_COUNTERS = {("AmplifierDriver", f"memory.{name}") for name in ("drive_counter", "sync_count")}
SENT_COUNTERS.add(("SenseTransmitter", "counter"))
SATURATED = {("TransmitGate", "memory.syncs"): 2, ("AmplifierNode", "_silent_syncs"): 4}
DICTIONARY_UNREAD = {0x1001, 0x1003, 0x2000, 0x2001, 0x6401, 0x6411}

# Of the controller's record, what the law computes with and writes down is left out: any law is explored.
_MONITORS_UNREAD = (
    "unexplained_trend_n", "commanded_trend_n", "commanded_n", "moved_n", "frozen", "frozen_sense_count",
)  # fmt: skip

CONSTANT_KINDS = {"PdoParameters", "ProcessCodec", "NodeObjects", "ObjectDictionary"}
CONSTANT = {
    "_w0", "_w1", "_w2", "_heartbeat_frame", "_sense_id", "_drive_id", "_sdo_request_id", "_sdo_response_id",
    "_emergency_id", "_node_heartbeat_id", "_flags_sent", "period_us", "_heartbeat_period_us", "_node_timeout_us",
    "_node_period_us", "_drive_timeout_syncs", "node_id", "_protection", "_boot_us", "turnaround_us", "_length",
    "_protected", "_limit", "config", "_config", "_heartbeat", "can", "law", "row", "_consumers", "_plant",
    "_settings",
}  # fmt: skip

RECORDS = {"AmplifierDriver", "TransmitGate", "SenseInput"}
"""Whose ``memory`` is a record of integers: each field is an attribute, ``memory.counter``."""

_NOT_CONSTANT = {("DriveReceiver", "receive"), ("AmplifierNode", "_receivers")}
_MUTABLE = {list, dict, set, deque, bytearray}


def _is_ours(value: object) -> bool:
    module = type(value).__module__
    if not module.startswith(("pkxyz_ctrl.", "hil.")) or isinstance(value, Enum | tuple | type):
        return False
    return not getattr(type(value), "model_config", None) and not _is_frozen(value)


def _is_frozen(value: object) -> bool:
    parameters = getattr(type(value), "__dataclass_params__", None)
    return parameters is not None and parameters.frozen


def names_of(value: object) -> tuple[str, ...]:
    slots = [name for kind in type(value).__mro__ for name in getattr(kind, "__slots__", ()) if hasattr(value, name)]
    return (*slots, *vars(value)) if hasattr(value, "__dict__") else tuple(slots)


def _is_constant(kind: str, name: str, value: object) -> bool:
    """What is never rebound, or says nothing: parts that are walked themselves, settings, functions, tables."""
    if kind in CONSTANT_KINDS or name in CONSTANT:
        return True
    if name == "memory":
        return kind not in RECORDS
    if (kind, name) in _NOT_CONSTANT:
        return False
    return callable(value) or _is_ours(value) or isinstance(value, np.ndarray | memoryview)


def _rule(kind: str, name: str, x: str) -> str | None:
    """The expression by which an attribute, that the expression ``x`` reads, enters the key; None: not at all."""
    place = kind, name
    if place in UNREAD or place in SENT_COUNTERS:
        return None
    if place in TEXTS:
        return f"bool({x})"
    if place in DRIVE_COUNTERS:
        return f"None if {x} is None or {x} < 0 else {x} - drive & 255"
    if place in SENSE_COUNTERS:
        return f"None if {x} < 0 else {x} - sense & 255"
    if place in SATURATED:
        return f"{x} if {x} < {SATURATED[place]} else {SATURATED[place]}"
    if place in INSTANTS or (name.endswith("_us") and name not in DURATIONS):
        past = -LONG_US if place in AGES else -1
        return f"{x} if {x} is None or {x} > {_NEVER_US} else {x} - now_us if {x} - now_us > {past} else {past}"
    return RULES.get(place, RULES.get(("", name), "{x} if type({x}) in _PLAIN else plain({x})")).format(x=x)


RULES = {
    # any counter may come first once drive frames are let in again
    ("DriveReceiver", "counter"): f"None if {{x}} is None or {DRIVE_ID} not in node._receivers"
    " else {x} - drive & 255",
    # measured anew at the next SYNC, read in the turn-around behind it
    ("SenseTransmitter", "cycle_us"): "{x} if node._sense.due_us is not None else 0",
    ("", "_sync_expected"): "{x} and ({x}[0] - sync) % 240",
    ("EmergencyProducer", "_active"): "tuple(sorted(map(int, {x})))",
    ("EmergencyProducer", "_waiting"): "tuple([frame[:2] for frame in {x}])",
    ("", "_receivers"): "tuple(sorted([(i, f.__name__) for i, f in {x}.items()]))",
    ("", "_sync_following"): "len({x})",
    ("", "_w3"): "{x} is None",
    ("", "_sync_frames"): "len({x})",
    ("", "_layout"): "len({x}.fields)",
}
_PLAIN = {int, bool, bytes, str, type(None)}


_ASKED = ("blocked", "event", "clearing", "restart_due", "is_restarting")
_IN_DIALOGUE = (DriverState.IDENTIFYING, DriverState.CONFIGURING)


# Of the start-up's record, what decides in every state; the others are read in the dialogue, or before the trial ends.
_START_ALWAYS = ("tried_identity", "has_tried", "repeats_left", "is_tried", "times_left")
_START_IN_DIALOGUE = ("known", "steps", "position", "tries", "is_planned")
_BEFORE_TRIAL = (DriverState.RESETTING, DriverState.STARTING, DriverState.TRYING)


def _start_up(record: np.void, state: DriverState, now_us: int) -> Any:
    told = [record[name].tobytes() for name in _START_ALWAYS]
    if state in _IN_DIALOGUE:
        told += [record[name].tobytes() for name in _START_IN_DIALOGUE]
        told += [record[name][: record["steps"]].tobytes() for name in ("row", "act")]
        told.append((record["found"] * (record["known"] == VALUE)).tobytes())
        told.append(max(int(record["answer_due_us"]) - now_us, -1))
    if state in _BEFORE_TRIAL:
        told.append(max(int(record["deadline_us"]) - now_us, -1))
    return told


def plain(v: Any) -> Any:
    """The value in types that have one spelling as bytes."""
    if type(v) in _PLAIN:
        return v
    if isinstance(v, Enum):
        return v.value
    if isinstance(v, tuple | list | deque):
        return tuple(map(plain, v))
    if isinstance(v, set | frozenset):
        return tuple(sorted(map(plain, v)))
    if isinstance(v, dict):
        return tuple(sorted((plain(k), plain(x)) for k, x in v.items()))
    if callable(v):
        return v.__name__
    if isinstance(v, bytearray):
        return bytes(v)
    raise TypeError(f"no rule for a {type(v).__name__}: {v!r}")


class Bases:
    """What counters and times are relative to."""

    __slots__ = ("drive", "now_us", "sense", "sync")

    def __init__(self, now_us: int, drive: int, sense: int, sync: int) -> None:
        self.now_us, self.drive, self.sense, self.sync = now_us, drive, sense, sync


class Attributes:
    """Every attribute that may change, of every object that can be reached, learnt from a composition that has run."""

    def __init__(self, roots: Iterable[object]) -> None:
        self._names: list[tuple[str, list[str]]] = []
        for value in _walk(roots):
            kind = type(value).__name__
            names = [name for name in names_of(value) if not _is_constant(kind, name, getattr(value, name))]
            self._names.append((kind, names))

    def of(self, roots: Iterable[object]) -> list[tuple[Any, str, str]]:
        """(object, its kind, attribute) of another composition of the same make; what it hasn't got yet is None."""
        found = []
        for value, (kind, names) in zip(_walk(roots), self._names, strict=True):
            assert type(value).__name__ == kind, "the two compositions are not of the same make"
            for name in names:
                if not hasattr(value, name):
                    setattr(value, name, None)
                found.append((value, kind, name))
        return found


class Snapshot:
    """Takes, restores and names the state of everything that is reachable from ``roots``.

    The three functions are made for the attributes at hand: a loop over them would cost ten times as much.
    """

    def __init__(self, attributes: list[tuple[Any, str, str]], controller: Controller, node: AmplifierNode) -> None:
        self.attributes = attributes
        self._driver, self._node = controller.driver, node
        self._memory = controller.memory
        self._safe_cycles = int(controller.law["limits"]["safe_cycles"][0])
        self._exchange, self._bytes = controller.exchange, controller.exchange.view(np.uint8)
        self._cycle = controller.memory.view(np.uint8)
        self._entries = [entry for entry in node.od if entry.access != "const"]
        self._named = [i for i, e in enumerate(self._entries) if e.index not in DICTIONARY_UNREAD]
        self._mask = _mask_of(controller.memory.dtype)
        self._value_of = attrgetter("value")
        self._dictionary: tuple[tuple[Any, ...], bytes] = ((), b"")
        self._read, self._write, self._name = self._functions()

    def _functions(self) -> tuple[Callable[[], tuple[Any, ...]], Callable[..., None], Callable[..., tuple[Any, ...]]]:
        objects = {id(o): o for o, _, _ in self.attributes}
        names = {key: f"o{n}" for n, key in enumerate(objects)}
        space: dict[str, Any] = {names[key]: o for key, o in objects.items()}
        space |= {"plain": plain, "_PLAIN": _PLAIN, "node": self._node}
        reads, writes, unpacks, keys = [], [], [], []
        for n, (o, kind, name) in enumerate(self.attributes):
            held, place = getattr(o, name), f"{names[id(o)]}.{name}"
            if isinstance(held, np.ndarray):
                fields, layout = _layout_of(held.dtype)
                space |= {f"b{n}": held.view(np.uint8).data, f"u{n}": struct.Struct(layout).unpack}
                reads.append(f"b{n}.tobytes()")
                writes.append(f"    b{n}[:] = s[{n}]")
                unpacks.append(f"    f{n} = u{n}(s[{n}])\n")
                rules = (_rule(kind, f"{name}.{field}", f"f{n}[{k}]") for k, field in enumerate(fields))
                keys += [f"({rule})" for rule in rules if rule is not None]
                continue
            copies = type(held) in _MUTABLE
            maybe = " if {} is not None else None" if held is None else ""
            reads.append(f"{place}.copy(){maybe.format(place)}" if copies else place)
            writes.append(f"    {place} = s[{n}].copy()" if copies else f"    {place} = s[{n}]")
            rule = _rule(kind, name, f"s[{n}]")
            if rule is not None:
                keys.append(f"({rule})")
        source = f"def read():\n    return ({', '.join(reads)},)\ndef write(s):\n" + "\n".join(writes)
        source += f"\ndef name(s, now_us, drive, sense, sync):\n{''.join(unpacks)}    return ({', '.join(keys)},)\n"
        exec(compile(source, "<state>", "exec"), space)
        return space["read"], space["write"], space["name"]

    def take(self) -> tuple[Any, ...]:
        values = tuple(map(self._value_of, self._entries))
        if values != self._dictionary[0]:
            self._dictionary = values, marshal.dumps([values[i] for i in self._named], 2)
        return self._read(), self._dictionary, self._bytes.tobytes()

    def put(self, taken: tuple[Any, ...]) -> None:
        held, dictionary, memory = taken
        self._write(held)
        for entry, value in zip(self._entries, dictionary[0], strict=True):
            entry.value = value
        self._bytes[:] = np.frombuffer(memory, np.uint8)

    def key(self, taken: tuple[Any, ...], bases: Bases, more: tuple[Any, ...]) -> bytes:
        held, dictionary, _ = taken
        record = self._memory[0]
        homing = int(record["homing_count"]) if record["mode"] == 3 else 0
        named = self._name(held, bases.now_us, bases.drive, bases.sense, bases.sync)
        memory = (self._cycle & self._mask).tobytes()
        asked = tuple(int(self._exchange[name][0]) for name in _ASKED)
        start_up = _start_up(self._driver.memory["start"][0, 0], self._driver.state, bases.now_us)
        parts = (more, named, homing, asked, start_up, min(int(record["safe_cycles"]), self._safe_cycles), memory)
        digest = hashlib.blake2b(marshal.dumps(parts, 2), digest_size=12)
        digest.update(dictionary[1])
        return digest.digest()

    def describe(self, taken: tuple[Any, ...], bases: Bases) -> dict[str, Any]:
        """The parts of the key by name, to see what keeps two states apart."""
        places = [
            (n, kind, part)
            for n, (value, kind, name) in enumerate(self.attributes)
            for part in _parts_of(getattr(value, name), name)
        ]
        kept = [place for place in places if _rule(place[1], place[2], "x") is not None]
        named = self._name(taken[0], bases.now_us, bases.drive, bases.sense, bases.sync)
        found: dict[str, Any] = {f"{n} {kind}.{name}": v for (n, kind, name), v in zip(kept, named, strict=True)}
        for i in self._named:
            entry = self._entries[i]
            found[f"{entry.index:04X}:{entry.subindex}"] = taken[1][0][i]
        record = np.frombuffer(taken[2], self._exchange.dtype)[0]["cycle"][0]
        for name in ("input", "monitors", "mode", "homed", "homing_count", "safe_cycles"):
            found[f"memory.{name}"] = str(record[name])
        found["memory.count"] = str(record["tick"]["count"][0])
        return found


def _walk(roots: Iterable[object]) -> list[Any]:
    found: dict[int, Any] = {}
    waiting = list(roots)
    while waiting:
        value = waiting.pop(0)
        if id(value) in found or isinstance(value, ObjectDictionary) or not _is_ours(value):
            continue
        found[id(value)] = value
        for name in names_of(value):
            held = getattr(value, name)
            owner = getattr(held, "__self__", None)  # a bound method leads on to its object
            inside = held if isinstance(held, list | tuple) else held.values() if isinstance(held, dict) else ()
            waiting += [part for part in (held, owner, *inside) if part is not None and _is_ours(part)]
    return list(found.values())


def _mask_of(dtype: np.dtype[Any]) -> np.ndarray[Any, Any]:
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


def _layout_of(dtype: np.dtype[Any]) -> tuple[list[str], str]:
    """Names of all numbers in a record itself, and its bytes as ``struct`` reads them."""
    names, layout, end = [], "<", 0
    assert dtype.fields is not None
    for name, (inner, offset) in ((name, dtype.fields[name][:2]) for name in dtype.names or ()):
        if inner.base.fields:  # somebody else's
            continue
        count = int(np.prod(inner.shape, dtype=int))
        layout += f"{offset - end}x{count}{inner.base.char}"
        names += [name] if count == 1 else [f"{name}[{place}]" for place in range(count)]
        end = offset + inner.itemsize
    return names, f"{layout}{dtype.itemsize - end}x".replace("l", "q")


def _parts_of(held: object, name: str) -> list[str]:
    return [f"{name}.{field}" for field in _layout_of(held.dtype)[0]] if isinstance(held, np.ndarray) else [name]


def _offset(dtype: np.dtype[Any], path: tuple[str, ...]) -> int:
    at = 0
    for name in path:
        assert dtype.fields is not None
        dtype, offset = dtype.fields[name][:2]
        at += offset
    return at


def _fill(whole: np.ndarray[Any, Any], dtype: np.dtype[Any], path: tuple[str, ...]) -> None:
    at, size = _offset(dtype, path), dtype
    for name in path:
        assert size.fields is not None
        size = size.fields[name][0]
    whole[at : at + size.itemsize] = 0xFF
