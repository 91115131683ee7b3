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

Digital outputs, those that wait for a SYNC and those that are owed are no counts: they are in the key as they are, as
is the signature, with the SYNCs until it is due.

An attribute that none of these tables names enters the key as it is. So a forgotten one can only keep states apart
that are alike (the exploration would not come to an end), never merge two that differ.
"""

import struct
from collections import deque
from collections.abc import Callable, Iterable
from enum import Enum
from typing import Any

import numpy as np
from configurations import SIGNATURE_SYNCS

from hil.node.object_dictionary import ObjectDictionary

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
DURATIONS = {"cycle_us", "beat_period_us", "time_us", "_event_us", "_drive_timeout_us"}
DRIVE_COUNTERS = {("TransmitGate", "memory.counter")}
SENSE_COUNTERS = {("SenseInput", "memory.counter")}
SENT_COUNTERS = {("AmplifierDriver", f"memory.{name}") for name in ("drive_counter", "sync_count")}
SENT_COUNTERS.add(("SenseTransmitter", "counter"))
SATURATED = {("TransmitGate", "memory.syncs"): 2, ("AmplifierNode", "_silent_syncs"): 4}
SATURATED["AmplifierDriver", "memory.signature_age"] = 2 * SIGNATURE_SYNCS + 3  # beyond what it is compared with
CONSTANT_KINDS = {"PdoParameters", "ProcessCodec", "NodeObjects", "ObjectDictionary"}
CONSTANT = {
    "_w0", "_w1", "_w2", "_heartbeat_frame", "_sense_id", "_drive_id", "_sdo_request_id", "_sdo_response_id",
    "_emergency_id", "_node_heartbeat_id", "_flags_sent", "period_us", "_heartbeat_period_us", "_node_timeout_us",
    "_node_period_us", "_drive_timeout_syncs", "node_id", "_protection", "_boot_us", "turnaround_us", "_length",
    "_protected", "_limit", "config", "_config", "_heartbeat", "can", "law", "row", "_consumers", "_plant",
    "_settings", "_ours",
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


def _same(copies: dict[int, Any], at: int, held: Any) -> Any:
    """A copy of what is held: the last one, if that is still alike, so that states share it."""
    last = copies.get(at)
    if last != held or type(last) is not type(held):
        last = copies[at] = held.copy()
    return last


def _rule(kind: str, name: str, x: str, other: str = "{x} if type({x}) in _PLAIN else plain({x})") -> str | None:
    """The expression by which an attribute, that the expression ``x`` reads, enters the key; None: not at all.
    ``other``: where no table names it.
    """
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
    is_instant = place in INSTANTS or (name.endswith("_us") and name not in DURATIONS)
    if is_instant and place not in RULES:
        past = -LONG_US if place in AGES else -1
        return f"{x} if {x} is None or {x} > {_NEVER_US} else {x} - now_us if {x} - now_us > {past} else {past}"
    return RULES.get(place, RULES.get(("", name), other)).format(x=x)


RULES = {
    # an age, as above; `long_us` is longer than a node may be silent that is still taken for operational
    ("AmplifierDriver", "memory.node_heartbeat_us"): "max({x} - now_us, -long_us)",
    # any may come next where none was there
    ("TransmitGate", "memory.counter_next"): "None if gate['counter'] < 0 else {x} - drive & 255",
    # any counter may come first once drive frames are let in again
    ("DriveReceiver", "counter"): f"None if {{x}} is None or {DRIVE_ID} not in node._receivers"
    " else {x} - drive & 255",
    # measured anew at the next SYNC, read at the response behind it: is the next heartbeat due before the next SYNC?
    ("SenseTransmitter", "cycle_us"): f"min({{x}}, {LONG_US}) if node._sense.due_us is not None else 0",
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


def plain(v: Any) -> Any:
    """The value in types that have one spelling as bytes."""
    if type(v) in _PLAIN:
        return v
    if isinstance(v, Enum):
        return v.value
    if isinstance(v, tuple | list | deque):
        return tuple([x if type(x) in _PLAIN else plain(x) for x in v])
    if isinstance(v, set | frozenset):
        return tuple(sorted(map(plain, v))) if v else ()
    if isinstance(v, dict):
        return tuple(sorted((plain(k), plain(x)) for k, x in v.items()))
    if callable(v):
        return v.__name__
    if isinstance(v, bytearray):
        return bytes(v)
    raise TypeError(f"no rule for a {type(v).__name__}: {v!r}")


def attributes_of(roots: Iterable[object]) -> list[tuple[Any, str, str]]:
    """(object, its kind, attribute) of all that may change in what can be reached."""
    return [
        (value, type(value).__name__, name)
        for value in _walk(roots)
        for name in names_of(value)
        if not _is_constant(type(value).__name__, name, getattr(value, name))
    ]


class Snapshot:
    """Takes, restores and names the attributes of one side; records in it are named only: their owner keeps them.

    The functions are made for the attributes at hand: a loop over them would cost ten times as much.
    """

    def __init__(self, attributes: list[tuple[Any, str, str]], **names: object) -> None:
        """``names``: of objects that the rules speak of."""
        objects = {id(o): o for o, _, _ in attributes}
        called = {key: f"o{n}" for n, key in enumerate(objects)}
        space: dict[str, Any] = {called[key]: o for key, o in objects.items()} | names
        space |= {"plain": plain, "_PLAIN": _PLAIN, "same": _same, "c": dict[int, Any]()}
        reads, writes, unpacks, keys = [], [], [], []
        for n, (o, kind, name) in enumerate(attributes):
            held, place = getattr(o, name), f"{called[id(o)]}.{name}"
            if isinstance(held, np.ndarray):
                fields, layout = _layout_of(held.dtype)
                space |= {f"b{n}": held.view(np.uint8).data, f"u{n}": struct.Struct(layout).unpack}
                unpacks.append(f"    f{n} = u{n}(b{n})\n")
                rules = (_rule(kind, f"{name}.{field}", f"f{n}[{k}]", "{x}") for k, field in enumerate(fields))
                keys += [f"({rule})" for rule in rules if rule is not None]
                continue
            at = len(reads)
            if type(held) in _MUTABLE:
                writes.append(f"    c[{at}] = s[{at}]; {place} = s[{at}].copy()")
                reads.append(f"same(c, {at}, {place})")
            else:
                writes.append(f"    {place} = s[{at}]")
                reads.append(place)
            rule = _rule(kind, name, f"s{n}")
            if rule is not None:
                unpacks.append(f"    s{n} = {place}\n")
                keys.append(f"({rule})")
        source = f"def take():\n    return ({', '.join(reads)},)\ndef put(s):\n" + "\n".join(writes)
        source += f"\ndef name(now_us, drive, sense, sync):\n{''.join(unpacks)}    return ({', '.join(keys)},)\n"
        exec(compile(source, "<state>", "exec"), space)
        self.take: Callable[[], tuple[Any, ...]] = space["take"]
        self.put: Callable[[tuple[Any, ...]], None] = space["put"]
        self.name: Callable[[int, int, int, int], tuple[Any, ...]] = space["name"]


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
