"""The parts of a tick as they are widened: kernels for one device, and their LLVM IR before anything is optimised.

``python -m hil.abreast.parts FILE`` writes it below a line of JSON that has the symbols: in a process of its own, as
numba reads ``NUMBA_OPT`` once.
"""

import json
import sys
from pathlib import Path
from typing import Any, Final, NamedTuple

import llvmlite.binding as llvm
import numpy as np
from numba import from_dtype, types
from numpy.typing import NDArray

from hil.lanes.fast import exchange
from hil.lanes.many import SCANNED, WINDOW, take
from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.loop import cycle
from pkxyz_ctrl.loop.reference import REFERENCE
from sim.motion.layout import PARAMS, STATE

Records = NDArray[np.void]


@kernel
def part_plant(params: Records, states: Records, at_us: int, laws: Records, memories: Records) -> None:
    """The plant at a sample: drive counts to the combs, truth and sense counts out."""
    memory = memories[0]
    due = memory["tick"]["count"][laws[0]["tick"]["delay_periods"] - 1]
    exchange(params, states, at_us, due, memory["row"], memory["input"]["sense_count"])


@kernel
def part_observe(laws: Records, memories: Records, reference: Records) -> None:
    """The first part of the period."""
    cycle.observe(laws, memories, reference)


@kernel
def part_respond(laws: Records, memories: Records, windows_us: Records, found: Records) -> None:
    """The second, and what of it is kept."""
    cycle.respond(laws, memories)
    take(memories[0]["row"], laws[0]["period_us"], windows_us, found[0])


class Argument(NamedTuple):
    """``dtype``: of the record, or None for a whole number; ``many``: how many there are is handed over, too."""

    name: str
    dtype: np.dtype[Any] | None
    many: bool = False


_PLANT = (Argument("params", PARAMS), Argument("states", STATE))
_LAW, _MEMORY = Argument("laws", cycle.LAW), Argument("memories", cycle.MEMORY)
_KEPT = (Argument("windows_us", WINDOW, many=True), Argument("found", SCANNED))
PARTS: Final[dict[str, tuple[Any, tuple[Argument, ...]]]] = {
    "part_plant": (part_plant, (*_PLANT, Argument("at_us", None), _LAW, _MEMORY)),
    "part_observe": (part_observe, (_LAW, _MEMORY, Argument("reference", REFERENCE, many=True))),
    "part_respond": (part_respond, (_LAW, _MEMORY, *_KEPT)),
}
SHARED: Final = frozenset({"laws", "reference", "windows_us"})
"""Arguments that are one for all devices of a batch."""


def main(out: Path) -> None:
    """Compile each and write one module."""
    module, symbols = None, {}
    for name, (function, arguments) in PARTS.items():
        signature = tuple(
            types.int64 if a.dtype is None else types.Array(from_dtype(a.dtype), 1, "C") for a in arguments
        )
        function.compile(signature)
        overload = function.overloads[signature]
        symbols[name] = overload.fndesc.llvm_func_name
        part = llvm.parse_assembly(overload.library.get_llvm_str())
        if module is None:
            module = part
        else:
            module.link_in(part)
    out.write_text(f"{json.dumps(symbols)}\n{module}", encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
