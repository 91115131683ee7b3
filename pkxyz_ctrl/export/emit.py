"""``python -m pkxyz_ctrl.export.emit FILE [planned]``: write the kernels' unoptimised LLVM IR, below a line
with their symbols.

``kernels`` runs it, in the environment that it needs.
"""

import json
import sys
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from numba import from_dtype, types

from pkxyz_ctrl.export.entries import FIELD, RECORD, Argument, Entry, entries_for


def main(out: Path, *, is_planned: bool) -> None:
    """Compile every entry and write one module."""
    module, symbols = None, {}
    for entry in entries_for(has_loop=is_planned):
        overload = _compiled(entry)
        symbols[entry.name] = overload.fndesc.llvm_func_name
        part = llvm.parse_assembly(overload.library.get_llvm_str())
        if module is None:
            module = part
        else:
            module.link_in(part)
    out.write_text(f"{json.dumps(symbols)}\n{module}", encoding="utf-8")


def _compiled(entry: Entry) -> Any:
    signature = tuple(map(_type_of, entry.arguments))
    kernel = entry.kernel
    kernel.compile(signature)
    return kernel.overloads[signature]


def _type_of(argument: Argument) -> Any:
    dtype = argument.taken
    if dtype is None:
        return types.int64
    if argument.kind == RECORD:
        return from_dtype(dtype)
    if argument.kind == FIELD:
        return from_dtype(np.dtype((dtype, (1,))))
    return types.Array(from_dtype(dtype), 1, "C")


if __name__ == "__main__":
    main(Path(sys.argv[1]), is_planned="planned" in sys.argv[2:])
