"""OD.h and OD.c of CANopenNode 4 from an EDS: ``python od_from_eds.py comb_amplifier.eds NODE_ID FOLDER``.

Its own editor makes them for who has one. Every object becomes a VAR or a RECORD. CANopenNode wants its PDOs numbered
from the first, so those before the EDS's own are there too, switched off.
"""

import sys
from pathlib import Path

import canopen
from canopen.objectdictionary import ODVariable

_STRING = 0x09
_COUNTS = {
    "NMT": 1, "EM": 1, "EM_PROD": 1, "SYNC": 1, "HB_CONS": 1, "HB_PROD": 1, "SDO_SRV": 1, "RPDO": 2, "TPDO": 2,
    "ARR_1003": 8, "ARR_1016": 1,
}  # fmt: skip
_OFF = 0x80000000
Sub = tuple[int, bytes, str]
"""Sub-index, default as bytes, attribute."""


def objects_of(eds: Path, node_id: int) -> dict[int, tuple[str, list[Sub]]]:
    """By index: VAR or REC, and what is in it."""
    found: dict[int, tuple[str, list[Sub]]] = {}
    for index, entry in sorted(canopen.import_od(str(eds), node_id).items()):
        if isinstance(entry, ODVariable):
            found[index] = "VAR", [_sub(0, entry)]
        else:
            found[index] = "REC", [_sub(part, variable) for part, variable in sorted(entry.subindices.items())]
    for communication, mapping in ((0x1400, 0x1600), (0x1800, 0x1A00)):
        number = [(0, b"\2", "ODA_SDO_R"), (1, _OFF.to_bytes(4, "little"), "ODA_SDO_RW | ODA_MB")]
        found.setdefault(communication, ("REC", [*number, (2, b"\xfe", "ODA_SDO_RW")]))
        entries: list[Sub] = [(part, bytes(4), "ODA_SDO_RW | ODA_MB") for part in range(1, 9)]
        found.setdefault(mapping, ("REC", [(0, b"\0", "ODA_SDO_RW"), *entries]))
    found.setdefault(0x1006, ("VAR", [(0, bytes(4), "ODA_SDO_RW | ODA_MB")]))
    return dict(sorted(found.items()))


def _sub(part: int, variable: ODVariable) -> Sub:
    is_text = variable.data_type == _STRING
    default = variable.default if variable.default is not None else ("" if is_text else 0)
    data = default.encode() if isinstance(default, str) else variable.encode_raw(default)
    attribute = "ODA_SDO_RW" if variable.writable else "ODA_SDO_R"
    attribute += " | ODA_STR" if is_text else " | ODA_MB" if len(data) > 1 else ""
    return part, data, attribute + (" | ODA_TRPDO" if variable.pdo_mappable else "")


def header(objects: dict[int, tuple[str, list[Sub]]]) -> str:
    lines = ["#ifndef OD_H", "#define OD_H"]
    lines += [f"#define OD_CNT_{name} {count}" for name, count in _COUNTS.items()]
    lines += [f"#define OD_ENTRY_H{index:04X} &OD->list[{place}]" for place, index in enumerate(objects)]
    identity = ("vendor_ID", "productCode", "revisionNumber", "serialNumber")
    lines += [
        f"typedef struct {{ struct {{ uint32_t {', '.join(identity)}; }} x1018_identity; }} OD_PERSIST_COMM_t;",
        "extern OD_PERSIST_COMM_t OD_PERSIST_COMM;",
        "extern OD_t *OD;",
        "#define OD_INIT_CONFIG(config) {}",
        "#endif",
    ]
    return "\n".join(lines) + "\n"


def source(objects: dict[int, tuple[str, list[Sub]]]) -> str:
    lines = ["#define OD_DEFINITION", '#include "301/CO_ODinterface.h"', '#include "OD.h"']
    numbers = [int.from_bytes(data, "little") for part, data, _ in objects[0x1018][1] if part]
    lines.append(f"OD_PERSIST_COMM_t OD_PERSIST_COMM = {{{{{', '.join(map(str, numbers))}}}}};")
    entries = []
    for index, (kind, subs) in objects.items():
        for part, data, _ in subs:
            lines.append(f"static uint8_t v{index:04X}_{part}[] __attribute__((aligned(8))) = {_array(data)};")
        if kind == "VAR":
            ((_, data, attribute),) = subs
            lines.append(f"static OD_obj_var_t o{index:04X} = {{v{index:04X}_0, {attribute}, {len(data)}}};")
        else:
            rows = (f"{{v{index:04X}_{part}, {part}, {attribute}, {len(data)}}}" for part, data, attribute in subs)
            lines.append(f"static OD_obj_record_t o{index:04X}[] = {{{', '.join(rows)}}};")
        name = f"&o{index:04X}" if kind == "VAR" else f"o{index:04X}"
        entries.append(f"    {{0x{index:04X}, {len(subs)}, ODT_{kind}, {name}, NULL}},")
    lines += ["static OD_entry_t list[] = {", *entries, "    {0, 0, 0, NULL, NULL}", "};"]
    lines += ["static OD_t od = {sizeof(list) / sizeof(list[0]) - 1, list};", "OD_t *OD = &od;"]
    return "\n".join(lines) + "\n"


def _array(data: bytes) -> str:
    return "{" + (", ".join(map(str, data)) or "0") + "}"


if __name__ == "__main__":
    made = objects_of(Path(sys.argv[1]), int(sys.argv[2]))
    folder = Path(sys.argv[3])
    (folder / "OD.h").write_text(header(made), encoding="ascii")
    (folder / "OD.c").write_text(source(made), encoding="ascii")
