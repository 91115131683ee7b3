"""The exported object on an emulated Cortex-M7, beside what Python made of the same; its sizes and instructions."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from compared import Law
from disassembly import fused_instructions, stack_bound
from exchanges import Exchange, hashes
from numpy.typing import NDArray

from pkxyz_ctrl.export.elf import loaded_bytes, symbols
from pkxyz_ctrl.export.entries import ENTRIES
from pkxyz_ctrl.export.planned import begins
from pkxyz_ctrl.export.stored import stored
from pkxyz_ctrl.export.targets import TARGETS
from pkxyz_ctrl.export.words import canonical
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.exchange import EXCHANGE_MEMORY
from pkxyz_ctrl.safety.modes import Mode

sys.path.append(str(Path(__file__).parents[1] / "fetched"))
from debian import fetched

Records = NDArray[np.void]

HERE = Path(__file__).parent
SCRATCH = HERE.parents[1] / ".firmware"
BOARD_PACKAGES = ("qemu-system-arm", "gcc-arm-none-eabi")
MHZ = 480
CODE_MOST, HELD_MOST, STACK_MOST = 56_000, 20 << 10, 2 << 10
"""Bytes of code, of law and memory together, and of stack on a Cortex-M7."""


def compared_on_board(laws: list[Law], exchanges: list[Exchange], board: Path, code_most: int = CODE_MOST) -> list[str]:
    """The same on the emulated Cortex-M7, by a hash of each row; and how many instructions each tick took."""
    tools, why_not = board_tools()
    if tools is None:
        print(
            f"\n*** SKIPPED: test-firmware on the board, nothing was tried on a Cortex-M7: {why_not}\n", file=sys.stderr
        )
        return []
    failures = built(board, tools, code_most)
    if failures:
        return failures
    with (board / "segments").open("wb") as file:
        for law in laws:
            for n, segment in enumerate(law.segments):
                head = np.array([len(segment.reference), len(segment.inputs), n == 0, Mode.IDLE], np.int32)
                sized = segment.law.tobytes()[: sizes_on_board(law)[0]]
                file.writelines((head.tobytes(), sized, segment.reference.tobytes(), segment.inputs.tobytes()))
    begin_s = time.monotonic()
    done = tools.run("qemu-system-arm", *QEMU, "-icount", "shift=0", "-kernel", "board.elf", cwd=board)
    if done.returncode != 0:
        return [f"the board ended with {done.returncode}: {done.stdout[-200:]} {done.stderr[-200:]}"]
    print(
        f"Cortex-M7: {sum(len(s.rows) for law in laws for s in law.segments)} ticks, {time.monotonic() - begin_s:.0f} s"
    )
    return [*board_differences(laws, (board / "results").read_bytes()), *exchanges_on_board(exchanges, board, tools)]


def sizes_on_board(law: Law) -> tuple[int, int]:
    """Bytes of law and memory there: the records of every law, and of what a planner has besides what it needs."""
    held = stored(begins(law.segments[0].law, cycling.LAW))
    return max(held.settings, cycling.LAW.itemsize), max(held.memory, cycling.MEMORY.itemsize)


QEMU = ("-M", "mps2-an500", "-nographic", "-monitor", "none", "-serial", "null", "-semihosting-config",
        "enable=on,target=native")  # fmt: skip
INSTRUCTIONS_A_COUNT = 40
"""The board's counter runs at 25 MHz, and with ``-icount shift=0`` an instruction takes a nanosecond."""
RESULT = np.dtype([("hash", "<u8"), ("counts", "<u4"), ("status", "<u4")])


def board_differences(laws: list[Law], results: bytes) -> Iterator[str]:
    """What the board made otherwise; prints the instructions a tick."""
    at = 0
    print(f"{'instructions a tick':28} {'median':>8} {'p99.9':>8} {'most':>8}   at {MHZ} MHz, one each")
    for law in laws:
        counts: list[NDArray[np.uint32]] = []
        for segment in law.segments:
            size = len(segment.rows) * RESULT.itemsize
            got = np.frombuffer(results[at : at + size], RESULT)
            length = sizes_on_board(law)[1]
            memory = np.zeros(1, law.memory.dtype)
            memory.view(np.uint8)[:length] = np.frombuffer(results[at + size : at + size + length], np.uint8)
            at += size + length
            same = (got["hash"] == hashes(canonical(segment.rows).reshape(len(segment.rows), -1))) & (
                got["status"] == 0
            )
            if not same.all():
                yield f"Cortex-M7, {law.name}: row of a tick, the {int(same.argmin())}th of its segment"
                break
            counts.append(got["counts"])
        else:
            if not np.array_equal(canonical(memory), canonical(law.memory)):
                yield f"Cortex-M7, {law.name}: memory at the end"
        taken = np.concatenate(counts) * INSTRUCTIONS_A_COUNT if counts else np.zeros(1)
        middle, high, most = np.percentile(taken, [50, 99.9, 100])
        print(f"{law.name:28} {middle:8.0f} {high:8.0f} {most:8.0f}   {most / MHZ:.1f} us")


def exchanges_on_board(exchanges: list[Exchange], board: Path, tools: "Tools") -> list[str]:
    """What every call of every exchange left there, and the memory in the end."""
    begin_s, failures = time.monotonic(), []
    with (board / "exchanges").open("wb") as file:
        for exchange in exchanges:
            head = np.array([len(exchange.reference), len(exchange.calls)], np.int32)
            file.writelines(a.tobytes() for a in (head, exchange.config, exchange.reference, exchange.calls))
    done = tools.run("qemu-system-arm", *QEMU, "-kernel", "converse.elf", cwd=board)
    if done.returncode != 0:
        return [f"converse.elf ended with {done.returncode}: {done.stdout[-200:]} {done.stderr[-200:]}"]
    left, at = (board / "digests").read_bytes(), 0
    for exchange in exchanges:
        count = len(exchange.calls)
        same = np.frombuffer(left, np.uint64, count, at) == exchange.digests
        memory = np.frombuffer(left, EXCHANGE_MEMORY, 1, at + 8 * count)
        at += 8 * count + EXCHANGE_MEMORY.itemsize
        if not same.all():
            failures.append(f"Cortex-M7, {exchange.name}: call {int(same.argmin())} of {count}")
        elif not np.array_equal(canonical(memory)[: len(exchange.held)], exchange.held):
            failures.append(f"Cortex-M7, {exchange.name}: memory at the end")
    print(f"Cortex-M7: {len(exchanges)} exchanges compared, {time.monotonic() - begin_s:.0f} s")
    return failures


class Tools(NamedTuple):
    """Where the programs are, and what they need to run."""

    folder: Path | None
    environment: dict[str, str]

    def run(self, name: str, *words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
        fetched_one = None if self.folder is None else self.folder / name
        program = str(fetched_one) if fetched_one is not None and fetched_one.is_file() else name
        return subprocess.run(
            [program, *words], cwd=cwd, env=self.environment, check=False, capture_output=True, text=True, timeout=600
        )


def board_tools() -> tuple[Tools | None, str]:
    """Compiler and emulator, from PATH or from Debian; or None and why there are none."""
    if all(shutil.which(name) for name in ("qemu-system-arm", "arm-none-eabi-gcc", "arm-none-eabi-objdump")):
        return Tools(None, dict(os.environ)), ""
    root = SCRATCH / "root"
    missing = fetched(BOARD_PACKAGES, root, with_dependencies=True)
    if missing:
        return None, missing
    libraries = os.pathsep.join(str(root / part / "x86_64-linux-gnu") for part in ("usr/lib", "lib"))
    return Tools(root / "usr" / "bin", {**os.environ, "LD_LIBRARY_PATH": libraries}), ""


def built(board: Path, tools: Tools, code_most: int) -> list[str]:
    """Link ``board.c`` with the exported object, run the folder's own self-test, and look at what was linked."""
    for name in ("board.c", "periods.c", "converse.c", "host_files.h"):
        shutil.copy(HERE / name, board)
    flags = ["-std=c11", "-O2", "-fno-strict-aliasing", *TARGETS["cortex-m7"].flags.split()]
    link = TARGETS["cortex-m7"].link.split()
    failures = []
    for out, sources in (
        ("board.elf", ["board.c", "selftest.c", "port_cortex_m.c"]),
        ("selftest.elf", ["main.c", "config.c", "reference.c", "selftest.c", "port_cortex_m.c"]),
        ("converse.elf", ["converse.c", "config.c", "reference.c", "selftest.c", "port_cortex_m.c"]),
        ("periods.elf", ["periods.c", "config.c", "reference.c", "selftest.c", "port_cortex_m.c"]),
    ):
        done = tools.run("arm-none-eabi-gcc", *flags, "-o", out, *sources, "pkxyz.o", *link, cwd=board)
        if done.returncode != 0:
            return [f"linking {out}: {done.stderr[-400:]}"]
    done = tools.run("qemu-system-arm", *QEMU, "-kernel", "selftest.elf", cwd=board)
    print(f"Cortex-M7: {(done.stdout + done.stderr).strip()}")
    failures += [] if done.returncode == 0 else ["the self-test on the board"]
    listing = tools.run("arm-none-eabi-objdump", "-d", "--no-show-raw-insn", "board.elf", cwd=board).stdout
    bound, way = max(stack_bound(listing, entry.name) for entry in ENTRIES)
    code = (board / "pkxyz.o").read_bytes()
    size = loaded_bytes(code)
    print(f"Cortex-M7: {size} bytes of code, {len(symbols(code))} symbols; stack {bound} bytes, by {' > '.join(way)}")
    if size > code_most or bound > STACK_MOST:
        failures.append(f"code or stack beyond {code_most} and {STACK_MOST} bytes")
    failures += whole_periods(board, tools)
    return failures + [f"board.elf: {line}" for line in fused_instructions(listing)]


def whole_periods(board: Path, tools: Tools) -> list[str]:
    """Instructions of a period from SYNC to drive frame, driver and gate included, in the self-test's exchange."""
    done = tools.run("qemu-system-arm", *QEMU, "-icount", "shift=0", "-kernel", "periods.elf", cwd=board)
    if done.returncode != 0:
        return [f"periods.elf ended with {done.returncode}: {done.stderr[-200:]}"]
    taken = np.fromfile(board / "counts", np.uint32) * INSTRUCTIONS_A_COUNT
    middle, high, most = np.percentile(taken, [50, 99.9, 100])
    print(f"{'whole periods':28} {middle:8.0f} {high:8.0f} {most:8.0f}   {most / MHZ:.1f} us")
    return []
