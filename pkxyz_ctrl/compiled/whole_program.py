"""A kernel and all that it calls, optimised as one program.

numba optimises each function by itself and hands the result to its callers. What LLVM weighs when it inlines is then
code with its loops already unrolled, of which it has to keep a copy for whoever else may call. Here a caller is handed
functions as numba made them, and they are its own: a tick takes a tenth to a sixth less time. Its bits are the same,
as LLVM keeps the order of IEEE 754's operations; compiling takes as long as before, and machine code is no larger.

They are private, not internal: LLVM's loader looks for a function by its name in all that it has loaded, in what is
local to an object, too, and such a one may have lost arguments that the other still has.

What bounds a period is neither the number of its instructions nor the length of its code (2 kB less change nothing,
2 kB more take 2 % of the time), but chains in which one number waits for another: voltage, motion, strokes, estimate,
force. Where a chain stands still a sampling profile by instruction shows: at roots and divisions, and where a row was
just written number by number and is read in vectors, which waits until it stands in the cache. So like operations on
neighbours become one in twos only, and loops are rolled out up to sixty instructions, not LLVM's three hundred.

numba tells functions of one name and records of one kind apart by counts that start anew in each process. Two kernels
that different processes had left in the cache could therefore bear one name, and LLVM, which links by name, took one
for the other: a wrong number, or a call into nothing. Here a function's number is drawn from 2^64, so that a name means
one compilation, whoever loads it; its environment, its wrappers and what a cache holds of it are named after it.
"""

import os
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from llvmlite.binding import Linkage, set_option
from numba import config
from numba.core.bytecode import FunctionIdentity
from numba.core.codegen import CPUCodeLibrary, JITCPUCodegen

_optimise = CPUCodeLibrary._optimize_final_module
_choose_options = JITCPUCodegen._customize_tm_options

_OPTIONS = (  # of LLVM, for all that this process compiles; one that it should not know any more is passed over
    "-slp-max-reg-size=128",
    "-slp-threshold=2",
)
_SHAPE = {  # what else LLVM is told here: up to so many instructions ...
    "unroll-threshold": 60,  # loops are rolled out,
    "tail-dup-size": 4,  # the end of a branch is written twice, in place of a jump,
    "two-entry-phi-node-folding-threshold": 2,  # both branches are worked out, in place of one
}
_SHAPE_ELSEWHERE = {"tail-dup-size": 2, "two-entry-phi-node-folding-threshold": 4}  # as LLVM has it
_RARELY = "_rarely"


def optimise_whole_programs() -> None:
    """From now on, in this process; not where numba is to optimise nothing, for what is exported."""
    if config.OPT != 0:
        CPUCodeLibrary._optimize_final_module = _optimise_whole
        config.SLP_VECTORIZE = 1  # the pass that makes pairs; off with numba
        for option in _OPTIONS:
            set_option("numba", option)
        _tell(_SHAPE)
        FunctionIdentity._unique_ids = iter(_drawn, None)  # without an end; a fork draws others
        if platform.machine() in ("x86_64", "AMD64"):
            JITCPUCodegen._customize_tm_options = _choose_near
            config.USE_LLVMLITE_MEMORY_MANAGER = True  # which lays the parts of a program side by side


@contextmanager
def rolled_out(instructions: int) -> Iterator[None]:
    """For others than this machine: roll loops out up to so many, whatever this process compiles else."""
    _tell({"unroll-threshold": instructions, **_SHAPE_ELSEWHERE})
    try:
        yield
    finally:
        _tell(_SHAPE)


def rare(function: Callable[..., Any]) -> Callable[..., Any]:
    """Of a kernel that hardly any tick calls: it is laid out of the way, and its caller keeps its numbers in registers
    as if there were no call. Told by the name: where a whole program is optimised, a function has nothing else left.
    """
    function.__qualname__ += _RARELY
    return function


def _tell(options: dict[str, int]) -> None:
    for name, value in options.items():
        set_option("numba", f"-{name}={value}")


def _choose_near(codegen: Any, options: dict[str, Any]) -> None:
    """A program's constants lie within 2 GB of it: told by four bytes, not by an instruction of ten."""
    _choose_options(codegen, options)
    options["codemodel"], options["reloc"] = "small", "pic"


def _drawn() -> int:
    return int.from_bytes(os.urandom(8))


def _optimise_whole(library: Any) -> None:
    module = library._final_module
    handed_on = module.clone()
    for function in handed_on.functions:
        if not function.is_declaration and function.linkage == Linkage.external:
            function.linkage = Linkage.linkonce_odr
    library._shared_module = handed_on
    for function in module.functions:
        if not function.is_declaration and function.linkage == Linkage.linkonce_odr:
            function.linkage = Linkage.private
        if _RARELY in function.name:
            function.add_function_attribute("cold")
    _optimise(library)
