"""The folder of an export: everything that builds on a machine without Python, and says what it is."""

import hashlib
import json
import math
from importlib.metadata import version
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import llvmlite
import llvmlite.binding as llvm
import numba
import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel_cache import digest_of_kernels
from pkxyz_ctrl.export.elf import loaded_bytes
from pkxyz_ctrl.export.kernels import ExportError, kernels
from pkxyz_ctrl.export.lowering import Lowered, lower
from pkxyz_ctrl.export.planned import is_planned, memory_of, whole
from pkxyz_ctrl.export.selftest import EVERY, SelfTest, self_test
from pkxyz_ctrl.export.stored import Stored, stored_in_exchange
from pkxyz_ctrl.export.structs import header, loop_header, struct_name
from pkxyz_ctrl.export.targets import TARGETS, Target
from pkxyz_ctrl.export.words import CANONICAL_NAN, FNV_OFFSET, FNV_PRIME, c_words, double_words, words_of
from pkxyz_ctrl.loop.row import ROW

Records = NDArray[np.void]

PORT = Path(__file__).parent / "port"
REFERENCE_MAX_BYTES = 2 << 20
"""Of a microcontroller's flash; a board that streams its reference needs no more than some rows."""

BUSY_MOST = 0.8
"""Share of a period that the longest tick may take: frames, interrupts and caches want the rest."""


LOOP_SOURCES = Path(__file__).parent / "linux"
"""The loop at rate around the kernels, in C."""
_LOOP_RULE = """
loop/loop: $(wildcard loop/*.c loop/*.h) pkxyz.h pkxyz.o
\t$(CC) $(CFLAGS) -I. -o $@ $(wildcard loop/*.c) pkxyz.o
"""
_LOOP_README = """
## The loop at rate

`loop/` is a program around the same object: one of the ports `port_can.c` (the kernel's CAN sockets) and `port_unix.c`,
absolute deadlines, SCHED_FIFO and locked memory where permitted. `loop/loop loop.bin` starts the amplifier, runs the
scenario, leads the stage down at its end or on SIGTERM, and leaves rows and frames in `run/`, which `pkxyz replay run`
reads. `loop.bin` holds bus, law and path and stays as it is.
"""


class Exported(NamedTuple):
    """What is to be exported: what the controller goes by, (1,) of ``exchange.EXCHANGE``, the reference's rows (n,),
    calls (m,) of an exchange for the self-test, names for people.
    """

    config: Records
    reference: Records
    calls: Records
    scenario: str
    controller: str
    config_digest: str
    beside: tuple[tuple[str, bytes], ...] = ()
    """Files that the target has besides, by name."""

    @property
    def law(self) -> Records:
        """(1,) of ``cycle.LAW``."""
        law: Records = self.config["law"][0]
        return law

    @property
    def stored(self) -> Stored:
        """What a board holds of both records."""
        return stored_in_exchange(self.law)


def target_of(name: str) -> Target:
    """Raises ``ExportError`` for a name that is none."""
    if name not in TARGETS:
        raise ExportError(f"--target: {name!r} is none; choose {', '.join(TARGETS)}")
    return TARGETS[name]


def require_exportable(law: Records, target: str) -> None:
    """Raises ``ExportError`` for a law whose longest tick has no room in its period there."""
    period_us, most_us = int(law["period_us"][0]), tick_most_us(law, target_of(target))
    if period_us * BUSY_MOST < most_us:
        fewer = "fewer rounds of its solver (mpc.iterations_max), " if is_planned(law) else ""
        raise ExportError(
            f"a period of {period_us} us is too short for {target}, where the longest tick takes {most_us} us; give a "
            f"bus of {math.ceil(most_us / BUSY_MOST)} us or more, {fewer}or another target"
        )


def tick_most_us(law: Records, target: Target) -> int:
    """What the longest tick of a law takes on a target; 0 where that is short. A plan's grows with its solver's rounds,
    which are bounded, and each with the cube of the limits that may be held.
    """
    if not is_planned(law):
        return target.tick_most_us
    numbers = law["tick"]["predictive"][0]
    larger = (int(numbers["horizon"]) / 10) ** 3
    return target.tick_most_us + math.ceil(target.round_most_us * (1 + int(numbers["iterations_max"])) * larger)


def require_room(reference: Records, instead: str) -> None:
    """Raises ``ExportError`` for a path that a board's flash has no room for; ``instead`` says what to do."""
    if reference.nbytes > REFERENCE_MAX_BYTES:
        raise ExportError(
            f"the reference takes {reference.nbytes / 2**20:.1f} MiB, more than a board's flash; {instead}"
        )


def write(out: Path, target_name: str, exported: Exported) -> dict[str, Any]:
    """Write the folder, which must be empty or not there; returns its manifest. Raises ``ExportError``, ``OSError``."""
    target = target_of(target_name)
    require_exportable(exported.law, target_name)
    if not target.is_hosted:
        rows = REFERENCE_MAX_BYTES // exported.reference.itemsize
        require_room(exported.reference, f"give --ticks {rows} or less, and stream the rest")
    test = self_test(exported.config, exported.reference, exported.calls)
    lowered = lower(kernels(is_planned=target.has_loop or is_planned(exported.law)), target)
    files = _files(target_name, target, exported, test, lowered)
    manifest = _manifest(target_name, target, exported, test, lowered, files)
    files["manifest.json"] = (json.dumps(manifest, indent=2) + "\n").encode()
    out.mkdir(parents=True, exist_ok=True)
    if any(out.iterdir()):
        raise ExportError(f"--out: {out}: is not empty, and nothing is overwritten; give a new folder, or empty it")
    for name, content in sorted(files.items()):
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_bytes(content)
    return manifest


def _files(name: str, target: Target, exported: Exported, test: SelfTest, lowered: Lowered) -> dict[str, bytes]:
    values = {
        "target": name, "about": target.about, "compiler": target.compiler, "flags": target.flags,
        "scenario": exported.scenario, "controller": exported.controller,
        "period_us": str(int(exported.law["period_us"][0])), "ticks": str(len(test.tried)), "every": str(EVERY),
        "last": f"{test.digests[-1]:016x}",
        "code_bytes": str(loaded_bytes(lowered.code)), "config_bytes": str(exported.stored.settings),
        "memory_bytes": str(exported.stored.memory), "row_bytes": str(ROW.itemsize),
        "reference_bytes": str(exported.reference.nbytes), "rows": str(len(exported.reference)),
        "owed": ", ".join(lowered.owed) or "nothing",
        "port": target.port, "link": target.link, "loop_rule": _LOOP_RULE if target.has_loop else "",
        "loop_made": " loop/loop" if target.has_loop else "", "loop_readme": _LOOP_README if target.has_loop else "",
    }  # fmt: skip
    files = {file: _filled(file, values) for file in ("main.c", "Makefile", "CMakeLists.txt", "README.md")}
    files |= {
        file: (PORT / file).read_bytes() for file in (target.port, *target.link.split()) if (PORT / file).is_file()
    }
    if target.has_loop:
        files |= {f"loop/{path.name}": path.read_bytes() for path in sorted(LOOP_SOURCES.iterdir())}
    files |= dict(exported.beside)
    texts = sources(exported, has_loop=target.has_loop)
    texts |= {"pkxyz.s": lowered.assembly, "selftest.c": _self_test_c(test, memory_of(whole(exported.config)).dtype)}
    return files | {file: text.encode() for file, text in texts.items()} | {"pkxyz.o": lowered.code}


def sources(exported: Exported, *, has_loop: bool = False) -> dict[str, str]:
    """What any program around the object is compiled with: the records, the settings, the path."""
    return {
        "pkxyz.h": (loop_header if has_loop else header)(int(exported.law["period_us"][0]), exported.stored),
        "config.c": _config_c(exported),
        "reference.c": constant("pkxyz_path_words", exported.reference),
    }


def _filled(file: str, values: dict[str, str]) -> bytes:
    return Template((PORT / file).read_text(encoding="utf-8")).substitute(values).encode()


def _config_c(exported: Exported) -> str:
    """What this law has of the settings, and room for what it has of the memory."""
    return constant("pkxyz_config_words", whole(exported.config), count=exported.stored.settings // 8) + (
        "\n/* room for what this law needs of pkxyz_exchange_memory */\n"
        "uint64_t pkxyz_memory_words[PKXYZ_MEMORY_BYTES / 8];\n"
    )


def constant(name: str, records: Records, *, count: int | None = None) -> str:
    """C that defines the words of records and how many there are; or the first ``count`` words of one."""
    kind, words = struct_name(records.dtype), words_of(records)[:count]
    length = f"const int32_t {name}_count = {len(records)};\n" if count is None else ""
    return (
        f'#include "pkxyz.h"\n\n/* {len(records)} of {kind} */\n{length}'
        f"const uint64_t {name}[{len(words)}] = {{\n{c_words(words)}}};\n"
    )


def _self_test_c(test: SelfTest, memory: np.dtype[np.void]) -> str:
    records = {"row": ROW, "memory": memory}
    flags = "".join(
        f"const uint8_t pkxyz_{name}_is_double[{len(double_words(dtype))}] = "
        f"{{{','.join(str(int(is_double)) for is_double in double_words(dtype))}}};\n"
        for name, dtype in records.items()
    )
    digests = "".join(f"    0x{value:016x},\n" for value in test.digests)
    constants = (
        f"const uint64_t pkxyz_hash_begin = 0x{FNV_OFFSET:016x}, pkxyz_hash_prime = 0x{FNV_PRIME:016x};\n"
        f"const uint64_t pkxyz_nan = 0x{CANONICAL_NAN:016x};\n"
    )
    return (
        f"{constant('pkxyz_call_words', test.calls)}\n{constant('pkxyz_tried_words', test.tried)}\n"
        f"uint64_t pkxyz_doubtful_words[PKXYZ_MEMORY_BYTES / 8];\n{constants}{flags}"
        f"const uint64_t pkxyz_digests[{len(test.digests)}] = {{\n{digests}}};\n"
    )


def _manifest(
    name: str, target: Target, exported: Exported, test: SelfTest, lowered: Lowered, files: dict[str, bytes]
) -> dict[str, Any]:
    """What this is and what it was made of; the same for the same input."""
    return {
        "target": {"name": name, "triple": target.llvm_triple, "cpu": target.cpu, "features": target.features},
        "scenario": exported.scenario,
        "controller": exported.controller,
        "digests": {
            "config": exported.config_digest,
            "kernels": digest_of_kernels(),
            "files": {file: hashlib.sha256(content).hexdigest() for file, content in sorted(files.items())},
        },
        "self_test": {"ticks": len(test.tried), "every": EVERY, "fnv1a_64": [f"{d:016x}" for d in test.digests]},
        "bytes": {
            "code": loaded_bytes(lowered.code), "law": exported.stored.settings, "memory": exported.stored.memory,
            "row": ROW.itemsize, "reference": exported.reference.nbytes,
        },
        "owed_symbols": list(lowered.owed),
        "versions": {
            "pkxyz-ctrl": version("pkxyz-ctrl"), "numba": numba.__version__, "llvmlite": llvmlite.__version__,
            "llvm": ".".join(str(part) for part in llvm.llvm_version_info), "numpy": np.__version__,
        },
    }  # fmt: skip
