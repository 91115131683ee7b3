"""The object dictionary of the amplifier node, read from its EDS (CiA 306), with the access rules of CiA 301.

Written without the canopen library, which plays the master in the tests: a misreading of the EDS must not cancel out.
"""

import struct
from collections.abc import Iterator
from configparser import RawConfigParser, SectionProxy
from copy import copy
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from pathlib import Path
from re import fullmatch

Value = int | float | bytes

# CiA 301, 7.4.7.1: data types that an EDS may name; strings and domains have no fixed length
_FORMATS = {
    0x01: "<?",
    0x02: "<b",
    0x03: "<h",
    0x04: "<i",
    0x05: "<B",
    0x06: "<H",
    0x07: "<I",
    0x08: "<f",
    0x11: "<d",
    0x15: "<q",
    0x1B: "<Q",
}
_STRINGS = {0x09: "ascii", 0x0A: "hex", 0x0F: "hex"}
_FLOATS = (0x08, 0x11)


class Abort(IntEnum):
    """SDO abort codes in use here (CiA 301, table 22)."""

    TOGGLE = 0x05030000
    COMMAND = 0x05040001
    OUT_OF_MEMORY = 0x05040005
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_LENGTH = 0x06040042
    INCOMPATIBLE = 0x06040043
    LENGTH = 0x06070010
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    VALUE_RANGE = 0x06090030
    LOCAL_CONTROL = 0x08000021
    DEVICE_STATE = 0x08000022
    NO_DATA = 0x08000024


class SdoAbortError(Exception):
    """The access is refused; the server answers with ``code``."""

    def __init__(self, code: Abort) -> None:
        super().__init__(f"{code.name} (0x{code:08X})")
        self.code = code


@dataclass(slots=True)
class Entry:
    """One variable of the dictionary. ``default``: what a reset brings back. ``length``: bytes, None for a string."""

    index: int
    subindex: int
    name: str
    data_type: int
    access: str
    default: Value
    low: int | None
    high: int | None
    mappable: bool
    value: Value

    @property
    def length(self) -> int | None:
        form = _FORMATS.get(self.data_type)
        return None if form is None else struct.calcsize(form)

    def encode(self) -> bytes:
        value = self.value
        return value if isinstance(value, bytes) else struct.pack(_FORMATS[self.data_type], value)

    def decode(self, data: bytes) -> Value:
        """The value that ``data`` (little endian) stands for. Aborts: wrong length, outside the limits of the EDS."""
        self.check_length(len(data))
        if self.length is None:
            return data
        value: int | float = struct.unpack(_FORMATS[self.data_type], data)[0]
        if (self.high is not None and value > self.high) or (self.low is not None and value < self.low):
            raise SdoAbortError(Abort.VALUE_RANGE)
        return value

    def check_length(self, length: int) -> None:
        expected = self.length
        if expected is not None and length != expected:
            raise SdoAbortError(Abort.TOO_LONG if length > expected else Abort.TOO_SHORT)

    def check_writable(self) -> None:
        if self.access in ("ro", "const"):
            raise SdoAbortError(Abort.READ_ONLY)

    def check_readable(self) -> None:
        if self.access == "wo":
            raise SdoAbortError(Abort.WRITE_ONLY)


class ObjectDictionary:
    """Values by (index, subindex). Subscripts reach them from inside, past the access rules; masters use `entry`."""

    def __init__(self, entries: dict[tuple[int, int], Entry]) -> None:
        self._entries = entries
        self._indices = {index for index, _ in entries}

    @classmethod
    def from_eds(cls, path: str | Path, node_id: int) -> "ObjectDictionary":
        """Read ``path``; ``$NODEID`` becomes ``node_id``. ValueError names the section that is not understood."""
        factory = _read_eds(Path(path).read_text(encoding="utf-8"), str(path), node_id)
        return cls({(entry.index, entry.subindex): copy(entry) for entry in factory})

    def __getitem__(self, key: tuple[int, int]) -> int:
        value = self._entries[key].value
        if not isinstance(value, int):
            raise TypeError(f"object {key[0]:04X}h sub {key[1]} holds no integer")
        return value

    def __setitem__(self, key: tuple[int, int], value: Value) -> None:
        self._entries[key].value = value

    def __contains__(self, key: tuple[int, int]) -> bool:
        return key in self._entries

    def __iter__(self) -> Iterator[Entry]:
        return iter(self._entries.values())

    def entry(self, index: int, subindex: int) -> Entry:
        """The variable, or the abort that its absence calls for."""
        found = self._entries.get((index, subindex))
        if found is None:
            raise SdoAbortError(Abort.NO_SUBINDEX if index in self._indices else Abort.NO_OBJECT)
        return found

    def install(self, index: int, subindex: int, value: Value) -> None:
        """Make ``value`` the factory setting: it holds now and after every reset."""
        found = self._entries[index, subindex]
        found.default = found.value = value

    def reset(self, first: int, last: int) -> None:
        """Bring back the defaults of all objects with ``first`` <= index <= ``last``."""
        for found in self._entries.values():
            if first <= found.index <= last:
                found.value = found.default


@lru_cache(maxsize=8)  # a study makes one node after the other
def _read_eds(text: str, path: str, node_id: int) -> tuple[Entry, ...]:
    parser = RawConfigParser(inline_comment_prefixes=(";",))
    parser.read_string(text, source=path)
    entries = []
    for name in parser.sections():
        match = fullmatch(r"([0-9A-Fa-f]{4})(?:[Ss]ub([0-9A-Fa-f]{1,2}))?", name)
        if match is None or "datatype" not in parser[name]:
            continue  # file information, lists of objects, and the heads of arrays and records
        try:
            entries.append(_entry(int(match[1], 16), int(match[2] or "0", 16), parser[name], node_id))
        except (KeyError, ValueError) as error:
            raise ValueError(f"{path}: section [{name}] is not a variable that this node knows: {error}") from error
    return tuple(entries)


def _entry(index: int, subindex: int, section: SectionProxy, node_id: int) -> Entry:
    data_type = int(section["datatype"], 0)
    if data_type not in _FORMATS and data_type not in _STRINGS:
        raise ValueError(f"data type 0x{data_type:04X}")
    default = _value(section.get("defaultvalue", ""), data_type, node_id)
    low, high = (_limit(section.get(key, ""), data_type, node_id) for key in ("lowlimit", "highlimit"))
    return Entry(
        index=index,
        subindex=subindex,
        name=section["parametername"],
        data_type=data_type,
        access=section.get("accesstype", "rw").lower(),
        default=default,
        low=low,
        high=high,
        mappable=int(section.get("pdomapping", "0"), 0) == 1,
        value=default,
    )


def _limit(text: str, data_type: int, node_id: int) -> int | None:
    if not text.strip() or data_type in _STRINGS:
        return None
    value = _value(text, data_type, node_id)
    return value if isinstance(value, int) else None


def _value(text: str, data_type: int, node_id: int) -> Value:
    """CiA 306: C notation, ``$NODEID+`` in front or ``+$NODEID`` behind; negative numbers may be two's complement."""
    text = text.strip()
    if data_type in _STRINGS:
        return bytes.fromhex(text) if _STRINGS[data_type] == "hex" else text.encode("ascii")
    if data_type in _FLOATS:
        return float(text or 0.0)
    value = (
        sum(node_id if term.upper() == "$NODEID" else int(term, 0) for term in text.split("+") if term) if text else 0
    )
    form = _FORMATS[data_type]
    bits = 8 * struct.calcsize(form)
    if form[1].islower() and (1 << (bits - 1)) <= value < (1 << bits):
        value -= 1 << bits
    struct.pack(form, value)  # a default that its own type cannot hold is a mistake in the EDS
    return value
