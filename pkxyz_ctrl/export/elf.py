"""What an ELF object holds: its symbols and sections, as far as the export has to know."""

import struct
from collections.abc import Iterator
from typing import NamedTuple

_SYMBOL_TABLE, _UNDEFINED, _ALLOCATED, _NO_BITS = 2, 0, 2, 8


class Symbol(NamedTuple):
    """``size`` in bytes; ``is_defined``: in this very object."""

    name: str
    size: int
    is_defined: bool


class _Section(NamedTuple):
    name: int
    kind: int
    flags: int
    offset: int
    size: int
    link: int
    entry_size: int


def symbols(data: bytes) -> list[Symbol]:
    """All with a name."""
    sections, wide = _sections(data), data[4] == 2
    found = []
    for section in sections:
        if section.kind != _SYMBOL_TABLE:
            continue
        names = sections[section.link].offset
        for at in range(section.offset, section.offset + section.size, section.entry_size):
            if wide:
                name, _, _, index, _, size = struct.unpack_from("<IBBHQQ", data, at)
            else:
                name, _, size, _, _, index = struct.unpack_from("<IIIBBH", data, at)
            text = _text(data, names + name)
            if text and not text.startswith("$"):  # ARM's marks of code and data
                found.append(Symbol(text, size, index != _UNDEFINED))
    return found


def undefined(data: bytes) -> set[str]:
    """Names that somebody else has to define."""
    return {symbol.name for symbol in symbols(data) if not symbol.is_defined}


def loaded_bytes(data: bytes) -> int:
    """Bytes of code and constants that the object takes in the memory of the processor."""
    return sum(s.size for s in _sections(data) if s.flags & _ALLOCATED and s.kind != _NO_BITS)


def _sections(data: bytes) -> list[_Section]:
    if data[:4] != b"\x7fELF" or data[5] != 1:
        raise ValueError("not an ELF object of a little-endian processor")
    return list(_each_section(data))


def _each_section(data: bytes) -> Iterator[_Section]:
    wide = data[4] == 2
    (start,) = struct.unpack_from("<Q" if wide else "<I", data, 0x28 if wide else 0x20)
    size, count = struct.unpack_from("<HH", data, 0x3A if wide else 0x2E)
    for at in range(start, start + size * count, size):
        fields = struct.unpack_from("<IIQQQQIIQQ" if wide else "<IIIIIIIIII", data, at)
        name, kind, flags, _, offset, length, link, _, _, entry_size = fields
        yield _Section(name, kind, flags, offset, length, link, entry_size)


def _text(data: bytes, at: int) -> str:
    return data[at : data.index(b"\0", at)].decode("ascii")
