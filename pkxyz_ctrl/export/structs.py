"""Records as C structs: the header, generated from the dtypes, with every offset and size asserted.

A struct is named after where its dtype stands: ``ESTIMATE`` of ``core.estimator`` is ``pkxyz_estimator_estimate``. What
is said of a field there, in the comment behind it, is said in C as well.
"""

import ast
import hashlib
import io
import re
import sys
import tokenize
from collections.abc import Iterable
from enum import IntEnum, IntFlag
from functools import cache
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any, NamedTuple

import numpy as np

from pkxyz_ctrl.core.demand import PREDICTIVE
from pkxyz_ctrl.export.calls import CALL, Call
from pkxyz_ctrl.export.entries import ENTRIES, MANY, OF_LOOP, Entry
from pkxyz_ctrl.export.planned import PLANNED_EXCHANGE, PLANNED_EXCHANGE_MEMORY
from pkxyz_ctrl.export.shared import (
    BLOCK_ROWS,
    EVENTS,
    HISTOGRAM_US,
    MAGIC,
    PATH,
    SHARED,
    SNAPSHOTS,
    Interface,
    LoopEnd,
    Order,
    Phase,
    Told,
)
from pkxyz_ctrl.export.stored import Stored
from pkxyz_ctrl.loop.exchange import EXCHANGE, EXCHANGE_MEMORY
from pkxyz_ctrl.loop.reference import REFERENCE
from pkxyz_ctrl.safety.gate_rules import Reason
from pkxyz_ctrl.safety.modes import Event, Mode
from pkxyz_ctrl.safety.monitors import NodeEvent, SenseStatus
from pkxyz_ctrl.safety.trips import Trip

_NUMBERS = (
    ("MODE", Mode), ("EVENT", Event), ("SENSE", SenseStatus), ("NODE", NodeEvent), ("TRIP", Trip), ("CALL", Call),
    ("REFUSED", Reason),
)  # fmt: skip
_NUMBERS_SHARED = (
    ("INTERFACE", Interface), ("PHASE", Phase), ("OUTCOME", LoopEnd), ("TOLD", Told), ("ORDER", Order),
)  # fmt: skip
_C_TYPE = MappingProxyType(
    {"f8": "double", "i8": "int64_t", "i4": "int32_t", "i2": "int16_t", "i1": "int8_t", "u8": "uint64_t"}
    | {"u4": "uint32_t", "u2": "uint16_t", "u1": "uint8_t"}
)
_UNITS = MappingProxyType(
    {unit: unit for unit in ("m", "s", "us", "ms", "kg", "rad", "count", "ticks", "bit")}
    | {"n": "N", "n2": "N^2", "v": "V", "v2": "V^2", "f": "F", "volt": "V", "metre": "m", "farad": "F"}
)
_C_WORDS = frozenset({
    "auto", "break", "case", "char", "class", "const", "continue", "default", "delete", "do", "double", "else", "enum",
    "extern", "float", "for", "goto", "if", "inline", "int", "long", "new", "operator", "private", "public", "register",
    "return", "short", "signed", "static", "struct", "switch", "this", "union", "unsigned", "void", "volatile", "while",
})  # fmt: skip
"""Which no field can be called there; it has a _ behind it then."""
Dtype = np.dtype[Any]


class _Place(NamedTuple):
    """Where a dtype is defined: its module, the name there, and what is said about its fields."""

    module: str
    name: str
    comments: dict[str, str]

    @property
    def c_name(self) -> str:
        stem = self.module.rpartition(".")[2]
        own = self.name.lower()
        return f"pkxyz_{own}" if own == stem or stem in own.split("_") else f"pkxyz_{stem}_{own}"


def header(period_us: int, held: Stored) -> str:
    """``pkxyz.h``. ``period_us``: of the law that goes with it, ``held``: what of settings and memory it needs."""
    return _HEAD + _LAW.format(period_us=period_us, settings=held.settings, memory=held.memory) + _body() + _TAIL


def loop_header(period_us: int = 0, held: Stored | None = None) -> str:
    """``pkxyz.h`` with what the native loop shares, which itself takes any law."""
    held = held or Stored(PLANNED_EXCHANGE.itemsize, PLANNED_EXCHANGE_MEMORY.itemsize)
    law = _LAW.format(period_us=period_us, settings=held.settings, memory=held.memory)
    numbers = {"MAGIC": f"{MAGIC:#x}", "LAYOUT": f"{layout():#x}", "BLOCK_ROWS": BLOCK_ROWS, "EVENTS": EVENTS}
    numbers["HISTOGRAM_US"], numbers["SNAPSHOTS"], numbers["PREDICTIVE"] = HISTOGRAM_US, SNAPSHOTS, PREDICTIVE
    defined = "".join(f"#define PKXYZ_{name} {value}\n" for name, value in numbers.items())
    return _HEAD + law + defined + _body() + _shared_body() + _TAIL


@cache
def layout() -> int:
    """Digest of all that the native loop shares, (64 bits): whoever reads it must mean the same. Of the dtypes and
    numbers themselves, not of the words about them: a loop that begins waits for it.
    """
    kinds = [kind for _, kind in (*_NUMBERS, *_NUMBERS_SHARED)]
    numbers = [(kind.__name__, [(member.name, int(member)) for member in kind]) for kind in kinds]
    shared = repr((numbers, BLOCK_ROWS, _laid_out(SHARED), _laid_out(PATH)))
    return int.from_bytes(hashlib.sha256(shared.encode()).digest()[:8], "little")


def _laid_out(dtype: Dtype) -> object:
    """Where everything of a record stands, and as what: of records in it, too."""
    if dtype.fields is None:
        return dtype.str
    fields = dtype.fields.items()
    parts = [(name, offset, kind.shape, _laid_out(kind.base)) for name, (kind, offset, *_) in fields]
    return dtype.itemsize, parts


@cache
def _body() -> str:
    taken = [argument.dtype for entry in ENTRIES for argument in entry.arguments if argument.dtype is not None]
    records, names = _in_order([*taken, CALL]), _names()
    parts = [_enumeration(prefix, kind) for prefix, kind in _NUMBERS]
    parts += [_struct(dtype, names) for dtype in records]
    parts += [_declared(entry, names) for entry in ENTRIES]
    return "\n".join(["", *parts, ""])


@cache
def _shared_body() -> str:
    known = {id(dtype) for dtype in _in_order([EXCHANGE, EXCHANGE_MEMORY, REFERENCE])}
    parts = [_enumeration(prefix, kind) for prefix, kind in _NUMBERS_SHARED]
    parts += [_struct(dtype, _names()) for dtype in _in_order([SHARED, PATH]) if id(dtype) not in known]
    parts += [_declared(entry, _names()) for entry in OF_LOOP]
    return "\n".join([*parts, ""])


def _names() -> dict[int, str]:
    return {id(dtype): place.c_name for dtype, place in _defined()}


def struct_name(dtype: Dtype) -> str:
    """What C calls a record."""
    return next(place.c_name for known, place in _defined() if known is dtype)


def unit_of(field: str) -> str:
    """``N s/m`` for ``velocity_gain_n_s_per_m``; empty for a field whose name carries none."""
    words = field.split("_")
    while words and words[0] not in (*_UNITS, "per"):
        words.pop(0)
    if not words or words[0] == "per" or any(word not in (*_UNITS, "per") for word in words):
        return ""
    if words == field.split("_") and "per" not in words:
        return ""
    above, _, below = " ".join(_UNITS.get(word, word) for word in words).partition(" per ")
    return f"{above}/{below}" if below else above


def _in_order(roots: Iterable[Dtype]) -> list[Dtype]:
    """Records, those that others hold before them."""
    found: dict[int, Dtype] = {}

    def visit(dtype: Dtype) -> None:
        for field, *_ in (dtype.fields or {}).values():
            if field.base.fields:
                visit(field.base)
        found.setdefault(id(dtype), dtype)

    for root in roots:
        visit(root)
    return list(found.values())


def _enumeration(prefix: str, kind: type[IntEnum] | type[IntFlag]) -> str:
    lines = [f"    PKXYZ_{prefix}_{member.name} = {int(member)}," for member in kind]
    return f"enum {{ /* {kind.__name__} */\n" + "\n".join(lines) + "\n};\n"


def _struct(dtype: Dtype, names: dict[int, str]) -> str:
    place = next(place for known, place in _defined() if known is dtype)
    name = place.c_name
    lines = [f"/* {place.module.removeprefix('pkxyz_ctrl.')}.{place.name} */", "typedef struct {"]
    asserts = []
    for field, (kind, offset, *_) in (dtype.fields or {}).items():
        base = kind.base
        c_type = names[id(base)] if base.fields else _C_TYPE[base.str[1:]]
        shape = "".join(f"[{length}]" for length in kind.shape)
        said = ", ".join(text for text in (unit_of(field), place.comments.get(field, "")) if text)
        c_field = f"{field}_" if field in _C_WORDS else field
        lines.append(f"    {c_type} {c_field}{shape};" + (f" /* {said} */" if said else ""))
        asserts.append(f"PKXYZ_ASSERT(offsetof({name}, {c_field}) == {offset});")
    asserts.append(f"PKXYZ_ASSERT(sizeof({name}) == {dtype.itemsize});")
    return "\n".join([*lines, f"}} {name};", *asserts, ""])


def _declared(entry: Entry, names: dict[int, str]) -> str:
    return f"/* {entry.about}\n   Returns 0; anything else: 0 V, at once. */\n{_prototype(entry, names)};\n"


def _prototype(entry: Entry, names: dict[int, str]) -> str:
    taken = []
    for argument in entry.arguments:
        if argument.dtype is None:
            taken.append(f"{argument.c_type} {argument.name}")
            continue
        const = "const " if argument.is_const else ""
        taken.append(f"{const}{names[id(argument.dtype)]} *{argument.name}")
        taken += [f"int32_t {argument.name}_count"] if argument.kind == MANY else []
    taken += ["int64_t *told"] if entry.told else []
    return f"int32_t {entry.name}({', '.join(taken)})"


@cache
def _defined() -> tuple[tuple[Dtype, _Place], ...]:
    """Every record of the modules that are loaded, with its place."""
    found = []
    for name, module in sorted(sys.modules.items()):
        if name.startswith("pkxyz_ctrl.") and module.__file__ is not None:
            found += _defined_in(name, module)
    return tuple(found)


def _defined_in(name: str, module: ModuleType) -> list[tuple[Dtype, _Place]]:
    source = Path(str(module.__file__)).read_text(encoding="utf-8")
    if "np.dtype(" not in source:
        return []
    comments = _comments(source)
    found = []
    for node in ast.parse(source).body:
        target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
        dtype = getattr(module, target.id, None) if isinstance(target, ast.Name) else None
        if isinstance(target, ast.Name) and isinstance(dtype, np.dtype) and dtype.fields:
            said = _said(node, comments)
            missing = set(dtype.fields) - said.keys()  # a dtype that is put together from lists of fields
            for other in ast.parse(source).body if missing else ():
                said = {key: text for key, text in _said(other, comments).items() if key in missing} | said
            found.append((dtype, _Place(name, target.id, said)))
    return found


def _said(node: ast.stmt, comments: dict[int, str]) -> dict[str, str]:
    """Comments behind the fields of a list of them."""
    found = {}
    for part in ast.walk(node):
        if isinstance(part, ast.Tuple) and part.elts and isinstance(part.elts[0], ast.Constant):
            key = part.elts[0].value
            if isinstance(key, str) and part.end_lineno in comments:
                found[key] = comments[part.end_lineno]
    return found


def _comments(source: str) -> dict[int, str]:
    """By line, with nothing in them that would end a comment in C."""
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return {t.start[0]: re.sub(r"\*/|/\*", "", t.string.lstrip("# ")) for t in tokens if t.type == tokenize.COMMENT}


_HEAD = """/* Written by `pkxyz export`; see README.md. Do not edit: the object was compiled for these records. */
#ifndef PKXYZ_H
#define PKXYZ_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
#define PKXYZ_ASSERT(fact) static_assert(fact, #fact)
extern "C" {
#else
#define PKXYZ_ASSERT(fact) _Static_assert(fact, #fact)
#endif

PKXYZ_ASSERT(sizeof(double) == 8);
"""

_LAW = """
#define PKXYZ_PERIOD_US {period_us} /* between two calls of pkxyz_begin */
#define PKXYZ_CONFIG_BYTES {settings} /* of pkxyz_exchange, without what this law lacks; what it has besides behind */
#define PKXYZ_MEMORY_BYTES {memory} /* of pkxyz_exchange_memory, likewise */
"""

_TAIL = """#ifdef __cplusplus
}
#endif

#endif
"""
