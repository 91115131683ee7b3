"""The widened kernels as this machine's code: made once, in a minute and a half, and kept beside numba's."""

import hashlib
from functools import cache
from pathlib import Path

import llvmlite.binding as llvm

import hil.abreast.widening as widening
from hil.abreast.parts import PARTS
from hil.abreast.widening.text import LANES
from hil.abreast.widening.widened import widened
from pkxyz_ctrl.export.kernels import emitted, kept, place_of

ALIKE = frozenset({"reference", "windows_us"})
"""Arguments that are one for all devices of a batch; laws besides, or one for each."""
_MADE_OF = tuple(sorted([*Path(widening.__file__).parent.glob("*.py"), Path(__file__)]))


def can_be_had() -> bool:
    """Whether this machine has the vectors for it."""
    return bool(llvm.get_host_cpu_features().get("avx512dq"))


def is_there(*, own_laws: bool) -> bool:
    """Whether it has been made and kept."""
    place = _place(own_laws)
    return can_be_had() and place is not None and place.is_file()


@cache
def _place(own_laws: bool) -> Path | None:
    return place_of(_name(own_laws), _MADE_OF)


class Code:
    """``run``: address of ``run_ticks``; ``frame``: bytes of the room that it is handed."""

    def __init__(self, made: bytes) -> None:
        frame, _, obj = made.partition(b"\n")
        self.frame = int(frame)
        target = llvm.Target.from_default_triple().create_target_machine()
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), target)
        self._engine.add_object_file(llvm.object_file.ObjectFileRef.from_data(obj))
        self._engine.finalize_object()
        self.run = self._engine.get_function_address("run_ticks")


@cache
def code(*, own_laws: bool) -> Code:
    """For a law of all, or one of each device: kept, or made now."""
    return Code(kept(_name(own_laws), _MADE_OF, lambda: _made(own_laws)))


def _name(own_laws: bool) -> str:
    """Of what is kept: for processors like this one."""
    processor = f"{llvm.get_host_cpu_name()} {llvm.get_host_cpu_features().flatten()}"
    return f"abreast_{'own' if own_laws else 'one'}_{hashlib.sha256(processor.encode()).hexdigest()[:8]}.bin"


def _made(own_laws: bool) -> bytes:
    """Bytes of the frame, and the object file below."""
    ir = kept("abreast.ll", _MADE_OF, lambda: emitted("hil.abreast.parts").encode()).decode()
    shared = ALIKE if own_laws else ALIKE | {"laws"}
    text, frame = widened(ir, shared)
    machine = llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=3
    )
    module = llvm.parse_assembly(text + _loop(shared))
    options = llvm.create_pipeline_tuning_options(speed_level=2)
    passes = llvm.create_new_module_pass_manager()  # all of O2 take six times as long, for 3 % of speed
    passes.add_sroa_pass()
    passes.add_simplify_cfg_pass()
    passes.run(module, llvm.create_pass_builder(machine, options))
    return f"{frame}\n".encode() + machine.emit_object(module)


def _loop(shared: frozenset[str]) -> str:
    """``run_ticks``: all groups through one part of a tick before any through the next, tick by tick."""
    records = {a.name: a for _, arguments in PARTS.values() for a in arguments if a.dtype is not None}
    handed = ["i64 %ticks", "ptr %at_each_us", "i64 %groups"]
    for argument in records.values():
        handed += [f"ptr %{argument.name}", *([f"i64 %{argument.name}_n"] if argument.many else [])]
    lines = [
        f"define i64 @run_ticks({', '.join([*handed, 'ptr %frame'])}) {{", "start:", "  br label %tick", "tick:",
        "  %i = phi i64 [ 0, %start ], [ %i.next, %tick.end ]",
        "  %where = getelementptr i64, ptr %at_each_us, i64 %i",
        "  %at_us = load i64, ptr %where",
        f"  br label %{next(iter(PARTS))}.begin",
    ]  # fmt: skip
    for name, after in zip(PARTS, [*list(PARTS)[1:], None], strict=True):
        lines += _all_groups(name, f"{after}.begin" if after else "tick.end", shared)
    lines += [
        "tick.end:", "  %i.next = add i64 %i, 1", "  %more = icmp ult i64 %i.next, %ticks",
        "  br i1 %more, label %tick, label %done", "done:", "  ret i64 0", "}", "",
    ]  # fmt: skip
    return "\n".join(lines)


def _all_groups(name: str, behind: str, shared: frozenset[str]) -> list[str]:
    """A part of a tick for each group."""
    lines = [f"{name}.begin:", f"  br label %{name}", f"{name}:"]
    lines.append(f"  %{name}.g = phi i64 [ 0, %{name}.begin ], [ %{name}.next, %{name} ]")
    handed = []
    for a in PARTS[name][1]:
        if a.dtype is None:
            handed.append(f"i64 %{a.name}")
        elif a.name in shared:
            handed.append(f"ptr %{a.name}")
        else:
            stride = f"[{a.dtype.itemsize * LANES} x i8]"
            lines.append(f"  %{name}.{a.name} = getelementptr {stride}, ptr %{a.name}, i64 %{name}.g")
            handed.append(f"ptr %{name}.{a.name}")
        if a.many:
            handed.append(f"i64 %{a.name}_n")
    return [
        *lines,
        f"  call i32 @{name}({', '.join([*handed, 'ptr %frame'])})",
        f"  %{name}.next = add i64 %{name}.g, 1",
        f"  %{name}.more = icmp ult i64 %{name}.next, %groups",
        f"  br i1 %{name}.more, label %{name}, label %{behind}",
    ]
