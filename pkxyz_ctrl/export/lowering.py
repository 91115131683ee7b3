"""From the kernels' LLVM IR to an object for a target: wrappers dropped, a plain C entry each, LLVM's own passes."""

import re
from collections.abc import Sequence
from typing import NamedTuple

import llvmlite.binding as llvm

from pkxyz_ctrl.compiled.whole_program import rolled_out
from pkxyz_ctrl.export import runtime
from pkxyz_ctrl.export.elf import undefined
from pkxyz_ctrl.export.entries import MANY, RECORD, Argument, Entry, entries_for
from pkxyz_ctrl.export.kernels import ExportError, Kernels
from pkxyz_ctrl.export.targets import Target

_SOFT_DOUBLE = re.compile(r"__aeabi_(d\w+|\w*2d|cd\w+|f2d)")
_LIBRARY = re.compile(r"(__aeabi_)?mem(set|clr|cpy|move)[48]?")
# of mangled names: where a tick's time goes, all else is to be small; of that what stands apart, not to be made small
# with its callers, nor to have its stack held while others work; and what of it is seldom called, or so long that its
# loops had better stay loops
_IN_A_HURRY = re.compile(r"10pkxyz_ctrl4(core|loop10active_set)")
_APART = re.compile(
    r"10adaptation(5learn|7foresee|8_compare|5begin)B|10linear_law(7advance|12add_feedback)B|5youla12add_feedbackB"
    r"|9estimator11predict_farB|9feed_hold3rowB|5cycle(7observe|7respond)B"
)
_SELDOM = re.compile(
    r"10adaptation(5learn|7foresee|5begin|8set_base|8_compare|5clear)B|9estimator11predict_farB|9feed_hold6sampleB"
)
_ROLLED_OUT = 70  # instructions: a board counts each, and its memory is small
_ROUNDS = 2  # of the passes: what a callee turned out to return is known to its caller in the second


class Lowered(NamedTuple):
    """``code``: an ELF object. ``owed``: symbols that the port's libraries have to define."""

    code: bytes
    assembly: str
    owed: tuple[str, ...]


def lower(kernels: Kernels, target: Target) -> Lowered:
    """Compile for a target. Raises ``ExportError`` if a kernel needs what no bare machine has: a heap, an exception."""
    machine = target.machine
    entries = entries_for(has_loop=target.has_loop, is_planned=kernels.is_planned)
    text = _prepared(kernels, target, machine, entries)
    public = {entry.name for entry in entries}
    module = _optimised(text, machine, public, is_small=not target.is_hosted)
    if not target.is_wide:
        narrow = _without_wide_divisions(_without_wide_conversions(str(module)))
        module = _optimised(narrow, machine, public, is_small=not target.is_hosted)
    _name_plainly(module, kernels)
    if not target.is_hosted:
        module = _with_memory_functions(module, target, machine)
    for function in module.functions:
        if not function.is_declaration:
            function.add_function_attribute("nounwind")
    code = machine.emit_object(module)
    owed = tuple(sorted(undefined(code)))
    refused = [name for name in owed if not _may_be_owed(name, target)]
    if refused:
        raise ExportError(f"a kernel needs {', '.join(refused)}, which no board has: no heap, no exception, no libm")
    return Lowered(code, machine.emit_assembly(module), owed)


def _may_be_owed(name: str, target: Target) -> bool:
    if target.is_hosted:
        return _LIBRARY.fullmatch(name) is not None
    return not target.has_double and _SOFT_DOUBLE.fullmatch(name) is not None


def _prepared(kernels: Kernels, target: Target, machine: llvm.TargetMachine, entries: Sequence[Entry]) -> str:
    text = kernels.ir
    for line, value in (("triple", target.llvm_triple), ("datalayout", machine.target_data)):
        text = re.sub(rf'^target {line} = ".*"$', f'target {line} = "{value}"', text, count=1, flags=re.MULTILINE)
    for name in ("NRT_incref", "NRT_decref"):  # of arrays that nobody allocated
        text = _replaced(text, name, f"define internal void @{name}(ptr %0) alwaysinline {{ ret void }}")
    text = re.sub(r"@(floor|llvm\.floor\.f64)\(", "@pkxyz.floor(", text)
    text = re.sub(r"^declare .*@pkxyz\.floor\(.*$", "", text, flags=re.MULTILINE)
    root, own_root = ("llvm.sqrt.f64", "") if target.has_double else ("pkxyz.sqrt", runtime.SQUARE_ROOT)
    text = re.sub(r"@(sqrt|llvm\.sqrt\.f64)\(", f"@{root}(", text)
    if own_root:
        text = re.sub(r"^declare .*@pkxyz\.sqrt\(.*$", "", text, flags=re.MULTILINE)
    return text + runtime.FLOOR + own_root + "".join(_c_entry(entry, kernels) for entry in entries)


def _replaced(text: str, name: str, definition: str) -> str:
    pattern = rf"^define [^\n]*@{re.escape(name)}\(.*?^}}$"
    return re.sub(pattern, lambda _: definition, text, count=1, flags=re.MULTILINE | re.DOTALL)


def _c_entry(entry: Entry, kernels: Kernels) -> str:
    """A function of pointers, counts and numbers that hands them over as numba does; what is told goes to its last."""
    symbol = kernels.symbols[entry.name]
    found = re.search(rf"^define [^\n]*@{re.escape(symbol)}\(([^\n]*)\)", kernels.ir, re.MULTILINE)
    taken, before, handed = [], "", ["ptr %told", "ptr %problem"]
    for argument in entry.arguments:
        parameters, widened, values = _handed(argument)
        taken += parameters
        before += widened
        handed += values
    if found is None or found[1].count("%") != len(handed):
        raise ExportError(f"this version of numba hands arguments of {entry.name} over in another way: see constraints")
    if entry.told:
        taken.append("ptr %told")
    else:
        before += "  %told = alloca ptr\n"
    return (
        f"\ndefine i32 @{entry.name}({', '.join(taken)}) {{\n{before}  %problem = alloca ptr\n"
        f"  %status = call i32 @{symbol}({', '.join(handed)})\n  ret i32 %status\n}}\n"
    )


def _handed(argument: Argument) -> tuple[list[str], str, list[str]]:
    """What C gives for an argument, what has to be done to it, and what numba takes: for an array owner, parent, items,
    bytes of an item, data, shape, strides.
    """
    name = argument.name
    dtype = argument.taken
    if dtype is None:
        if argument.c_type == "int64_t":
            return [f"i64 %{name}"], "", [f"i64 %{name}"]
        return [f"i32 %{name}"], f"  %{name}_n = sext i32 %{name} to i64\n", [f"i64 %{name}_n"]
    if argument.kind == RECORD:
        return [f"ptr %{name}"], "", [f"ptr %{name}"]
    taken, before, count = [f"ptr %{name}"], "", "1"
    if argument.kind == MANY:
        taken.append(f"i32 %{name}_count")
        before, count = f"  %{name}_n = sext i32 %{name}_count to i64\n", f"%{name}_n"
    size = dtype.itemsize
    handed = ["ptr null", "ptr null", f"i64 {count}", f"i64 {size}", f"ptr %{name}", f"i64 {count}", f"i64 {size}"]
    return taken, before, handed


def _optimised(text: str, machine: llvm.TargetMachine, public: set[str], *, is_small: bool) -> llvm.ModuleRef:
    """The module with nothing left that no entry calls, and nothing vectorised: order of operations is the source's.
    ``is_small``: as small as speed where it counts allows.
    """
    module = llvm.parse_assembly(text)
    module.verify()
    for function in module.functions:
        if not function.is_declaration:
            function.linkage = "external" if function.name in public else "internal"
            if is_small and (not _IN_A_HURRY.search(function.name) or _SELDOM.search(function.name)):
                function.add_function_attribute("optsize")
            if is_small and _APART.search(function.name):
                function.add_function_attribute("noinline")
    for variable in module.global_variables:
        if not variable.is_declaration:
            variable.linkage = "internal"
    options = llvm.create_pipeline_tuning_options(speed_level=2)
    options.slp_vectorization = options.loop_vectorization = False
    builder = llvm.create_pass_builder(machine, options)
    with rolled_out(_ROLLED_OUT):
        for _ in range(_ROUNDS):
            builder.getModulePassManager().run(module, builder)
    return module


def _without_wide_conversions(text: str) -> str:
    """Calls of our own in place of what would become a call of a helper."""
    operand = r"([%@\w.$\"-]+)"
    before = text
    text = re.sub(rf"= sitofp i64 {operand} to double", r"= call double @pkxyz.from_i64(i64 \1)", text)
    text = re.sub(rf"= uitofp (?:nneg )?i64 {operand} to double", r"= call double @pkxyz.from_u64(i64 \1)", text)
    text = re.sub(rf"= fptosi double {operand} to i64", r"= call i64 @pkxyz.to_i64(double \1)", text)
    if text == before:
        return text
    declared = "" if "@llvm.fabs.f64(" in text else "declare double @llvm.fabs.f64(double)\n"
    return text + declared + runtime.CONVERSIONS


def _without_wide_divisions(text: str) -> str:
    """Likewise for divisions of 64 bits."""
    operand = r"([%@\w.$\"-]+)"
    before = text
    for operation in ("sdiv", "udiv", "srem", "urem"):
        pattern = rf"= {operation} (?:exact )?i64 {operand}, {operand}"
        text = re.sub(pattern, rf"= call i64 @pkxyz.{operation}(i64 \1, i64 \2)", text)
    return text if text == before else text + runtime.DIVISIONS


def _name_plainly(module: llvm.ModuleRef, kernels: Kernels) -> None:
    """Where each comes from, in place of numba's mangled names, which count what was compiled before."""
    for function in module.functions:
        parts = re.match(r"_ZN((?:\d+[A-Za-z_]\w*)+)", function.name)
        if not function.is_declaration and parts:
            function.name = ".".join(_components(function.name[3:]))
    for number, variable in enumerate(module.global_variables):
        if variable.name.startswith(".const"):
            variable.name = f"table.{number}"


def _components(mangled: str) -> list[str]:
    """``11pkxyz_ctrl4core`` ... as [pkxyz_ctrl, core, ...]: names with their lengths before them."""
    words = []
    while match := re.match(r"\d+", mangled):
        begin, length = match.end(), int(match[0])
        words.append(mangled[begin : begin + length])
        mangled = mangled[begin + length :]
    return words


def _with_memory_functions(module: llvm.ModuleRef, target: Target, machine: llvm.TargetMachine) -> llvm.ModuleRef:
    needed = undefined(machine.emit_object(module))
    added = runtime.memory_functions(needed, "i64" if target.is_wide else "i32")
    return llvm.parse_assembly(str(module) + added) if added else module
