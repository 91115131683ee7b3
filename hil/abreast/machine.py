"""The widened kernels as this machine's code: made once in a minute or so, and kept beside numba's.

Their IR comes from a process without optimisation; all is inlined into the parts of a tick and nothing vectorised, so
that what is read is plain; then it is widened, and LLVM makes AVX-512 of it.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

import llvmlite.binding as llvm

from hil.abreast.parts import PARTS, SHARED, Argument
from hil.abreast.text import LANES
from hil.abreast.widened import widened
from pkxyz_ctrl.export.kernels import kept

_EVERYTHING = 100_000
"""Threshold of the inliner."""


def can_be_had() -> bool:
    """Whether this machine has the vectors for it."""
    return bool(llvm.get_host_cpu_features().get("avx512dq"))


class Code:
    """``run``: of ``run_ticks``; ``frame``: bytes of the room that it is handed."""

    def __init__(self, obj: bytes, frame: int) -> None:
        self.frame = frame
        target = llvm.Target.from_default_triple().create_target_machine()
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), target)
        self._engine.add_object_file(llvm.object_file.ObjectFileRef.from_data(obj))
        self._engine.finalize_object()
        self.run = self._engine.get_function_address("run_ticks")


@cache
def code() -> Code:
    """Kept, or made now."""
    sources = ("ir.py", "flow.py", "varying.py", "regions.py", "text.py", "shape.py", "block.py", "operations.py")
    made = kept("abreast.bin", sources, _made)
    frame, _, obj = made.partition(b"\n")
    return Code(obj, int(frame))


def _made() -> bytes:
    text, frame = widened(_inlined(_emitted()), SHARED)
    machine = llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=3
    )
    module = llvm.parse_assembly(text + _loop())
    options = llvm.create_pipeline_tuning_options(speed_level=2)
    options.slp_vectorization = options.loop_vectorization = options.loop_unrolling = False
    builder = llvm.create_pass_builder(machine, options)
    first = llvm.create_new_module_pass_manager()
    first.add_sroa_pass()
    first.add_simplify_cfg_pass()
    first.run(module, builder)
    builder.getModulePassManager().run(module, builder)
    return f"{frame}\n".encode() + machine.emit_object(module)


def _emitted() -> str:
    """What ``parts`` writes."""
    with tempfile.TemporaryDirectory(prefix="pkxyz-abreast-") as folder:
        out = Path(folder) / "parts.ll"
        env = {
            **os.environ, "NUMBA_OPT": "0", "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": "",
            "NUMBA_CACHE_DIR": folder, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        }  # fmt: skip
        words = [sys.executable, "-W", "ignore", "-m", "hil.abreast.parts", str(out)]
        subprocess.run(words, env=env, check=True, capture_output=True)
        return out.read_text(encoding="utf-8")


def _inlined(emitted: str) -> str:
    """One plain function for each part, with nothing left to call but what libraries have."""
    first, _, ir = emitted.partition("\n")
    symbols = json.loads(first)
    for name in ("NRT_incref", "NRT_decref"):
        plain = f"define internal void @{name}(ptr %0) alwaysinline {{ ret void }}"
        ir = re.sub(rf"^define [^\n]*@{name}\(.*?^}}$", plain, ir, count=1, flags=re.MULTILINE | re.DOTALL)
    ir = ir.replace(" noinline", " nounwind") + "".join(
        _plain(name, symbols[name], arguments) for name, (_, arguments) in PARTS.items()
    )
    module = llvm.parse_assembly(ir)
    for function in module.functions:
        if not function.is_declaration:
            is_part = function.name in {f"{name}_of_one" for name in PARTS}
            function.linkage = "external" if is_part else "internal"
            if not is_part:
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
        f"\ndefine i32 @{name}_of_one({', '.join(taken)}) {{\n  %told = alloca ptr\n  %problem = alloca ptr\n"
        f"  %status = call i32 @{symbol}({', '.join(handed)})\n  ret i32 %status\n}}\n"
    )


def _loop() -> str:
    """``run_ticks``: all groups through one part of a tick before any through the next, tick by tick."""
    given = ["i64 %ticks", "ptr %at_each_us", "i64 %groups"]
    for name in dict.fromkeys(a.name for _, arguments in PARTS.values() for a in arguments if a.dtype is not None):
        many = any(a.many for _, arguments in PARTS.values() for a in arguments if a.name == name)
        given += [f"ptr %{name}", *([f"i64 %{name}_n"] if many else [])]
    lines = [f"define i64 @run_ticks({', '.join([*given, 'ptr %frame'])}) {{", "start:", "  br label %tick", "tick:"]
    lines += [
        "  %i = phi i64 [ 0, %start ], [ %i.next, %tick.end ]",
        "  %where = getelementptr i64, ptr %at_each_us, i64 %i",
    ]
    lines += ["  %at_us = load i64, ptr %where", f"  br label %{next(iter(PARTS))}.begin"]
    following = [*list(PARTS)[1:], None]
    for (name, (_, arguments)), after in zip(PARTS.items(), following, strict=True):
        handed = []
        lines += [f"{name}.begin:", f"  br label %{name}", f"{name}:"]
        lines += [f"  %{name}.g = phi i64 [ 0, %{name}.begin ], [ %{name}.next, %{name} ]"]
        for a in arguments:
            if a.dtype is None or a.name in SHARED:
                handed.append(f"i64 %{a.name}" if a.dtype is None else f"ptr %{a.name}")
            else:
                stride = f"[{a.dtype.itemsize * LANES} x i8]"
                lines.append(f"  %{name}.{a.name} = getelementptr {stride}, ptr %{a.name}, i64 %{name}.g")
                handed.append(f"ptr %{name}.{a.name}")
            if a.many:
                handed.append(f"i64 %{a.name}_n")
        lines += [
            f"  call i32 @{name}_of_one({', '.join([*handed, 'ptr %frame'])})",
            f"  %{name}.next = add i64 %{name}.g, 1",
        ]
        lines += [f"  %{name}.more = icmp ult i64 %{name}.next, %groups"]
        behind = f"{after}.begin" if after else "tick.end"
        lines += [f"  br i1 %{name}.more, label %{name}, label %{behind}"]
    lines += ["tick.end:", "  %i.next = add i64 %i, 1", "  %more = icmp ult i64 %i.next, %ticks"]
    lines += ["  br i1 %more, label %tick, label %done", "done:", "  ret i64 0", "}", ""]
    return "\n".join(lines)
