"""The parts of a tick as they are widened: kernels for one device, each a plain function of LLVM's with all inlined.

``python -m hil.abreast.parts FILE`` writes their IR: in a process of its own, as numba reads ``NUMBA_OPT`` once, and
LLVM's options are for good.
"""

import re
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

_EVERYTHING: Final = 100_000
"""Threshold of the inliner."""


@kernel
def part_plant(params: Records, states: Records, at_us: int, laws: Records, memories: Records, found: Records) -> None:
    """The plant at a sample: drive counts to the combs, truth and sense counts out."""
    if found[0]["faulted"] == 0:
        memory = memories[0]
        due = memory["tick"]["count"][laws[0]["tick"]["delay_periods"] - 1]
        exchange(params, states, at_us, due, memory["row"], memory["input"]["sense_count"])


@kernel
def part_observe(laws: Records, memories: Records, reference: Records, found: Records) -> None:
    """The first part of the period."""
    if found[0]["faulted"] == 0:
        cycle.observe(laws, memories, reference)


@kernel
def part_respond(laws: Records, memories: Records, windows_us: Records, found: Records) -> None:
    """The second, and what of it is kept."""
    if found[0]["faulted"] == 0:
        cycle.respond(laws, memories)
        take(memories[0]["row"], laws[0]["period_us"], windows_us, found[0])


class Argument(NamedTuple):
    """``dtype``: of the record, or None for a whole number; ``many``: how many there are is handed over, too."""

    name: str
    dtype: np.dtype[Any] | None
    many: bool = False


_PLANT = (Argument("params", PARAMS), Argument("states", STATE))
_LAW, _MEMORY, _FOUND = Argument("laws", cycle.LAW), Argument("memories", cycle.MEMORY), Argument("found", SCANNED)
PARTS: Final[dict[str, tuple[Any, tuple[Argument, ...]]]] = {
    "part_plant": (part_plant, (*_PLANT, Argument("at_us", None), _LAW, _MEMORY, _FOUND)),
    "part_observe": (part_observe, (_LAW, _MEMORY, Argument("reference", REFERENCE, many=True), _FOUND)),
    "part_respond": (part_respond, (_LAW, _MEMORY, Argument("windows_us", WINDOW, many=True), _FOUND)),
}
"""By the names that they have as LLVM's functions, in their order."""


def main(out: Path) -> None:
    """Compile each and write one module. Loops stay as they are: none becomes a call that copies memory."""
    llvm.set_option("", "-disable-loop-idiom-all")
    module, plain = None, []
    for name, (part_kernel, arguments) in PARTS.items():
        signature = tuple(
            types.int64 if a.dtype is None else types.Array(from_dtype(a.dtype), 1, "C") for a in arguments
        )
        part_kernel.compile(signature)
        overload = part_kernel.overloads[signature]
        plain.append(_plain(name, overload.fndesc.llvm_func_name, arguments))
        part = llvm.parse_assembly(overload.library.get_llvm_str())
        if module is None:
            module = part
        else:
            module.link_in(part)
    out.write_text(_inlined(str(module), plain), encoding="utf-8")


def _plain(name: str, symbol: str, arguments: tuple[Argument, ...]) -> str:
    """A function of pointers and counts that hands them over as numba does."""
    taken, handed = [], ["ptr %told", "ptr %problem"]
    for argument in arguments:
        if argument.dtype is None:
            taken.append(f"i64 %{argument.name}")
            handed.append(f"i64 %{argument.name}")
            continue
        taken.append(f"ptr %{argument.name}")
        count = f"%{argument.name}_n" if argument.many else "1"
        if argument.many:
            taken.append(f"i64 {count}")
        size = argument.dtype.itemsize
        handed += ["ptr null", "ptr null", f"i64 {count}", f"i64 {size}", f"ptr %{argument.name}"]
        handed += [f"i64 {count}", f"i64 {size}"]
    return (
        f"\ndefine i32 @{name}({', '.join(taken)}) {{\n  %told = alloca ptr\n  %problem = alloca ptr\n"
        f"  %status = call i32 @{symbol}({', '.join(handed)})\n  ret i32 %status\n}}\n"
    )


def _inlined(ir: str, plain: list[str]) -> str:
    """The module with nothing left to call but what libraries have, and no vectors."""
    for name in ("NRT_incref", "NRT_decref"):
        nothing = f"define internal void @{name}(ptr %0) alwaysinline {{ ret void }}"
        ir = re.sub(rf"^define [^\n]*@{name}\(.*?^}}$", nothing, ir, count=1, flags=re.MULTILINE | re.DOTALL)
    module = llvm.parse_assembly(ir.replace(" noinline", " nounwind") + "".join(plain))
    for function in module.functions:
        if not function.is_declaration:
            function.linkage = "external" if function.name in PARTS else "internal"
            if function.name not in PARTS:
                function.add_function_attribute("alwaysinline")
    for variable in module.global_variables:
        if not variable.is_declaration:
            variable.linkage = "internal"
    machine = llvm.Target.from_default_triple().create_target_machine(cpu="x86-64", opt=3)
    options = llvm.create_pipeline_tuning_options(speed_level=2)
    options.slp_vectorization = options.loop_vectorization = options.loop_unrolling = False
    options.inlining_threshold = _EVERYTHING
    builder = llvm.create_pass_builder(machine, options)
    for _ in range(2):
        builder.getModulePassManager().run(module, builder)
    return str(module)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
