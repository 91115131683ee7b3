"""The tables of docs/lookup/wire.md, made from the EDS; a test compares them with the page.

``python docs/site/object_tables.py comb_amplifier.eds`` prints them.
"""

import sys
from collections.abc import Iterable

import canopen
from canopen.objectdictionary import ODVariable, datatypes

_TYPE_NAMES = {
    datatypes.INTEGER16: "INTEGER16",
    datatypes.INTEGER32: "INTEGER32",
    datatypes.UNSIGNED8: "UNSIGNED8",
    datatypes.UNSIGNED16: "UNSIGNED16",
    datatypes.UNSIGNED32: "UNSIGNED32",
    datatypes.VISIBLE_STRING: "VISIBLE_STRING",
}


def object_table(dictionary: canopen.ObjectDictionary) -> str:
    """Markdown: one row for each object and sub-index but sub-index 0 of constant size."""
    rows = []
    for entry in dictionary.values():
        members = [entry] if isinstance(entry, ODVariable) else list(entry.values())
        for variable in members:
            if variable.access_type == "const" and variable is not entry:
                continue
            name = variable.name if variable is entry else f"{entry.name}: {variable.name}"
            rows.append(
                (
                    f"0x{variable.index:04X}:{variable.subindex:02X}",
                    name,
                    _TYPE_NAMES[variable.data_type],
                    variable.access_type,
                    _value(variable),
                )
            )
    return _table(("object", "name", "type", "access", "default (node 10)"), rows)


def pdo_table(dictionary: canopen.ObjectDictionary) -> str:
    """Markdown: the bytes of both process PDOs, from their default mapping."""
    rows = []
    for communication, mapping in ((0x1401, 0x1601), (0x1801, 0x1A01)):
        pdo_cob_id = dictionary[communication][1].default & 0x7FF
        bit = 0
        for place in range(1, dictionary[mapping][0].default + 1):
            entry = dictionary[mapping][place].default
            variable = dictionary.get_variable(entry >> 16, entry >> 8 & 0xFF)
            length = entry & 0xFF
            first, last = bit // 8, (bit + length) // 8 - 1
            place_text = f"{first}" if first == last else f"{first}..{last}"
            rows.append(
                (
                    f"0x{pdo_cob_id:03X}",
                    place_text,
                    f"0x{variable.index:04X}:{variable.subindex:02X}",
                    variable.name,
                    _TYPE_NAMES[variable.data_type],
                )
            )
            bit += length
    return _table(("COB-ID", "byte", "object", "meaning", "type"), rows)


def _value(variable: ODVariable) -> str:
    if variable.data_type == datatypes.UNSIGNED32:
        return f"0x{variable.default:08X}"
    return str(variable.default)


def _table(heads: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = [heads, tuple("---" for _ in heads), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


if __name__ == "__main__":
    od = canopen.import_od(sys.argv[1], 10)
    print(pdo_table(od), object_table(od), sep="\n\n")
