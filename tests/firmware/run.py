"""Proof of bits: ``make test-firmware``. A million ticks through the exported controller, on this machine and on an
emulated Cortex-M7, beside the same ticks in Python; what the objects hold; and that a difference would be seen.

The emulator and the compiler for ARM are Debian's packages, unpacked beside, or what is on PATH. Where they can't be
had the board's part is left out, loudly. Exit code 0 if all that was tried holds, 1 if not.
"""

import ctypes
import dataclasses
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from debian import fetched
from disassembly import fused_instructions, stack_bound
from frames import judged, missing
from numpy.typing import NDArray
from segments import PREVIEW, TICKS, Segment, segments

from hil.lanes.setup import Setup
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.compiled.kernel_cache import choose_kernel_cache
from pkxyz_ctrl.config.files import CONFIG_DIR, ConfigError
from pkxyz_ctrl.core.tick import PREDICTIVE
from pkxyz_ctrl.design.model.discrete_law import LawError
from pkxyz_ctrl.export import kernels as exporting
from pkxyz_ctrl.export.elf import symbols
from pkxyz_ctrl.export.entries import ENTRIES
from pkxyz_ctrl.export.folder import Exported, write
from pkxyz_ctrl.export.kernels import Kernels, kernels
from pkxyz_ctrl.export.lowering import lower
from pkxyz_ctrl.export.targets import TARGETS
from pkxyz_ctrl.export.wire import new_wire_memory, wire_record
from pkxyz_ctrl.export.words import FNV_OFFSET, FNV_PRIME, canonical
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.trips import Trip

Records = NDArray[np.void]

TICKS_LEAST = 1_000_000
FRAMES = 300_000
HERE = Path(__file__).parent
ROOT = HERE.parents[1]
SCRATCH = ROOT / ".firmware"
BOARD_PACKAGES = ("qemu-system-arm", "gcc-arm-none-eabi")
FROM_OUTSIDE = Trip.GATE_BLOCKED | Trip.OPERATOR | Trip.SOLVER
"""What no exported law raises by itself: its callers do, and the one law with a solver does not go."""
MHZ = 480


class Law(NamedTuple):
    """A shipped controller: its name, its segments as they ran in Python, and the memory (1,) after the last."""

    name: str
    segments: list[Segment]
    memory: Records


def main(ticks: int) -> int:
    """Everything, with at least so many ticks; prints what was found."""
    begin_s = time.monotonic()
    SCRATCH.mkdir(exist_ok=True)
    failures: list[str] = []
    with tempfile.TemporaryDirectory(dir=SCRATCH) as folder:
        work = Path(folder)
        host, board = exported("host", work), exported("cortex-m7", work)
        failures += own_test(host)
        laws = played(ticks)
        failures += covered(laws)
        library = shared(host / "pkxyz.o", host)
        failures += compared_here(laws, library)
        failures += frames_compared(library)
        failures += planted(laws[0], host)
        failures += clean(board)
        failures += compared_on_board(laws, board)
    for line in failures:
        print(f"FAILED: {line}")
    print(f"{'failed' if failures else 'passed'}, {time.monotonic() - begin_s:.0f} s in all")
    return 1 if failures else 0


def exported(target: str, work: Path) -> Path:
    """The folder of ``pkxyz export`` for a target, of the default scenario."""
    setup = load_scenario("raster").setup()
    reference = reference_rows(setup.trajectory.sample(0, TICKS + PREVIEW, setup.bus.period_us))
    (segment,) = segments(setup.law, setup.trajectory, setup.bus.period_us, 1, 0)
    out = work / target
    wire = wire_record(setup.gate, DriverConfig())
    records = setup.law, wire, reference, segment.inputs[:1000]
    write(out, target, Exported(*records, "raster", setup.controller.name, ""))
    return out


def own_test(host: Path) -> list[str]:
    """The folder builds by its own files, and its self-test passes."""
    subprocess.run(["make", "--silent", "-C", host], check=True)
    begin_s = time.monotonic()
    done = subprocess.run([host / "selftest"], check=False, capture_output=True, text=True)
    print(f"host: {done.stdout.strip()}, {time.monotonic() - begin_s:.2f} s")
    return [] if done.returncode == 0 else ["the self-test of the exported folder"]


def played(ticks: int) -> list[Law]:
    """Every shipped law that goes, through all its segments in Python."""
    names = sorted(path.stem for path in (CONFIG_DIR / "controllers").glob("*.toml"))
    setups = [setup_of(name) for name in names]
    going = [s for s in setups if s.law["tick"]["kind"][0] != PREDICTIVE]
    lqg = next(s for s in going if s.controller.name == "lqg")
    going.append(dataclasses.replace(lqg, bus=lqg.bus.model_copy(update={"delay_periods": 2})))
    each = -(-ticks // TICKS // len(going))
    found = []
    begin_s = time.monotonic()
    for seed, setup in enumerate(going):
        memory = cycling.new_memory(Mode.IDLE)
        run = list(segments(setup.law, setup.trajectory, setup.bus.period_us, each, seed, memory))
        found.append(Law(f"{setup.controller.name}, {setup.bus.name}, delay {setup.bus.delay_periods}", run, memory))
    done = sum(len(segment.rows) for law in found for segment in law.segments)
    print(f"Python: {done} ticks of {len(found)} laws, {time.monotonic() - begin_s:.0f} s")
    return found


def setup_of(controller: str) -> Setup:
    """A shipped controller on the bus that it is made for."""
    try:
        setup = load_scenario("raster", controller=controller).setup()
        _ = setup.law
        return setup
    except (ConfigError, LawError):
        return load_scenario("raster", controller=controller, bus="local_20k").setup()


def covered(laws: list[Law]) -> list[str]:
    """Every mode, every trip, every kind of number has been there."""
    rows = [segment.rows for law in laws for segment in law.segments]
    missing = [f"mode {mode.name}" for mode in Mode if not any((r["mode"] == mode).any() for r in rows)]
    tripped = np.bitwise_or.reduce([np.bitwise_or.reduce(r["trips"] & ~r["outside_trips"]) for r in rows])
    missing += [f"trip {trip.name}" for trip in Trip if not trip & (int(tripped) | FROM_OUTSIDE)]
    floats = [name for name in ROW.names or () if ROW[name].base.kind == "f"]
    if not any(np.isnan(r[name]).any() for r in rows for name in floats):
        missing.append("NaN")
    if not any((r["overrun"] > 0).any() for r in rows):
        missing.append("overruns")
    if not any((r["active_set_steps"] > 5).any() for r in rows):
        missing.append("an allocation at its limits")
    return [f"the ticks had no {name}" for name in missing]


def shared(code: Path, folder: Path) -> ctypes.CDLL:
    """An object for this machine as a library, with ``play`` around it."""
    out = code.with_suffix(".so")
    words = ["cc", "-shared", "-fPIC", "-O2", f"-I{folder}", "-o", out, HERE / "play.c", code]
    subprocess.run(words, check=True)
    return ctypes.CDLL(str(out))


def compared_here(laws: list[Law], library: ctypes.CDLL) -> list[str]:
    """Every row and the last memory, word by word."""
    begin_s = time.monotonic()
    failures = [difference for law in laws if (difference := first_difference(law, library))]
    print(f"host: rows and memories of all {len(laws)} laws compared, {time.monotonic() - begin_s:.0f} s")
    return failures


def frames_compared(library: ctypes.CDLL) -> list[str]:
    """The gate's answer to each frame, and what it remembers in the end."""
    begin_s = time.monotonic()
    wire = wire_record(load_scenario("raster").setup().gate, DriverConfig())
    here = judged(wire, FRAMES, 13)
    failures = [f"no frame was refused for {name}" for name in missing(here)]
    frames, memory = here.frames.copy(), new_wire_memory()
    words = [array.ctypes.data_as(ctypes.c_void_p) for array in (wire, memory, frames)]
    status = library.judge(*words, len(frames))
    same = frames["reason"] == here.reasons
    if status != 0 or not same.all():
        failures.append(f"the gate's answer to frame {int(same.argmin())}, status {status}")
    if not np.array_equal(canonical(memory), canonical(here.memory)):
        failures.append("the gate's memory in the end")
    passed = here.frames[here.reasons == 0]
    voltages = np.count_nonzero((passed["can_id"] == wire["drive"]["cob_id"][0, 0]) & (passed["data"] << 16 != 0))
    print(f"host: {FRAMES} frames judged, {voltages} voltages passed, {time.monotonic() - begin_s:.0f} s")
    return failures if voltages > FRAMES // 100 else [*failures, "hardly a voltage passed the gate"]


def first_difference(law: Law, library: ctypes.CDLL) -> str:
    """Where a library parts from Python; empty if nowhere."""
    memory, ticks = cycling.new_memory(Mode.IDLE), 0
    for segment in law.segments:
        rows, path = np.zeros_like(segment.rows), segment.reference
        words = [array.ctypes.data_as(ctypes.c_void_p) for array in (segment.law, memory, path, segment.inputs, rows)]
        status = library.play(*words[:3], len(path), words[3], len(rows), words[4])
        if status != 0:
            return f"{law.name}: status at tick {ticks + status - 1}"
        same = (canonical(rows).reshape(len(rows), -1) == canonical(segment.rows).reshape(len(rows), -1)).all(axis=1)
        if not same.all():
            return f"{law.name}: row of tick {ticks + int(same.argmin())}"
        ticks += len(rows)
    return "" if np.array_equal(canonical(memory), canonical(law.memory)) else f"{law.name}: memory at the end"


def planted(law: Law, host: Path) -> list[str]:
    """Objects that differ in one constant, or in the order of one addition, must be told from the right one."""
    failures = []
    made = kernels()
    for name, ir in (("constant", changed_constant(made.ir)), ("order", changed_order(made.ir))):
        code = host / f"{name}.o"
        code.write_bytes(lower(Kernels(ir, made.symbols), TARGETS["host"]).code)
        found = first_difference(law, shared(code, host))
        print(f"planted: another {name}: {found or 'not seen'}")
        failures += [] if found else [f"a planted difference of {name} was not seen"]
    return failures


def changed_constant(ir: str) -> str:
    """One bit of the 24 in ``feedback.add_held_share``."""
    changed, count = re.subn(r"(fdiv double %\S+, )2\.400000e\+01", r"\g<1>0x4038000000000001", ir)
    assert count == 1, count
    return changed


def changed_order(ir: str) -> str:
    """a + (b + c) in place of (a + b) + c, in ``kinematics.stroke``."""
    begin = re.search(r"^define [^\n]*10kinematics6stroke", ir, re.MULTILINE)
    assert begin is not None
    end = ir.index("\n}\n", begin.start())
    body = ir[begin.start() : end]
    pattern = r"(%\S+) = fadd double (%\S+), (%\S+)\n((?:.*\n)*?)(.*)(%\S+) = fadd double \1, (%\S+)\n"
    changed, count = re.subn(pattern, r"\4\1 = fadd double \3, \7\n\5\6 = fadd double \2, \1\n", body, count=1)
    assert count == 1
    return ir[: begin.start()] + changed + ir[end:]


def clean(board: Path) -> list[str]:
    """No target's code fuses a multiplication with an addition, nor needs what a port does not owe."""
    made, failures = kernels(), []
    for name, target in TARGETS.items():
        lowered = lower(made, target)
        found = fused_instructions(lowered.assembly)
        failures += [f"{name}: {line}" for line in found]
        if name == "cortex-m7" and lowered.code != (board / "pkxyz.o").read_bytes():
            failures.append("the same input gave other bytes")
        if lowered.owed and target.has_double and not target.is_hosted:
            failures.append(f"{name}: needs {lowered.owed}")
    again = anew()
    if lower(again, TARGETS["cortex-m7"]).code != (board / "pkxyz.o").read_bytes():
        failures.append("kernels compiled anew, with another order of sets, gave other bytes")
    return failures


def anew() -> Kernels:
    """The kernels from another process, whose sets are in another order."""
    kept = {name: os.environ.pop(name, None) for name in ("NUMBA_CACHE_DIR", "PYTHONHASHSEED")}
    os.environ["PYTHONHASHSEED"] = "7"
    try:
        return exporting.kernels()
    finally:
        os.environ.pop("PYTHONHASHSEED")
        os.environ.update({name: value for name, value in kept.items() if value is not None})


def compared_on_board(laws: list[Law], board: Path) -> list[str]:
    """The same on the emulated Cortex-M7, by a hash of each row; and how many instructions each tick took."""
    tools, why_not = board_tools()
    if tools is None:
        print(
            f"\n*** SKIPPED: test-firmware on the board, nothing was tried on a Cortex-M7: {why_not}\n", file=sys.stderr
        )
        return []
    failures = built(board, tools)
    if failures:
        return failures
    with (board / "segments").open("wb") as file:
        for law in laws:
            for n, segment in enumerate(law.segments):
                head = np.array([len(segment.reference), len(segment.inputs), n == 0, Mode.IDLE], np.int32)
                file.writelines(array.tobytes() for array in (head, segment.law, segment.reference, segment.inputs))
    begin_s = time.monotonic()
    done = tools.run("qemu-system-arm", *QEMU, "-icount", "shift=0", "-kernel", "board.elf", cwd=board)
    if done.returncode != 0:
        return [f"the board ended with {done.returncode}: {done.stdout[-200:]} {done.stderr[-200:]}"]
    print(
        f"Cortex-M7: {sum(len(s.rows) for law in laws for s in law.segments)} ticks, {time.monotonic() - begin_s:.0f} s"
    )
    return list(board_differences(laws, (board / "results").read_bytes()))


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
            memory = np.frombuffer(results[at + size : at + size + cycling.MEMORY.itemsize], cycling.MEMORY)
            at += size + cycling.MEMORY.itemsize
            same = (got["hash"] == hashes(segment.rows)) & (got["status"] == 0)
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


def hashes(rows: Records) -> NDArray[np.uint64]:
    """FNV-1a of each row (n,) by itself."""
    words = canonical(rows).reshape(len(rows), -1)
    state = np.full(len(rows), FNV_OFFSET, np.uint64)
    with np.errstate(over="ignore"):
        for column in words.T:
            state = (state ^ column) * np.uint64(FNV_PRIME)
    return state


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


def built(board: Path, tools: Tools) -> list[str]:
    """Link ``board.c`` with the exported object, run the folder's own self-test, and look at what was linked."""
    shutil.copy(HERE / "board.c", board)
    flags = ["-std=c11", "-O2", "-fno-strict-aliasing", *TARGETS["cortex-m7"].flags.split()]
    link = TARGETS["cortex-m7"].link.split()
    failures = []
    for out, sources in (
        ("board.elf", ["board.c", "selftest.c", "port_cortex_m.c"]),
        ("selftest.elf", ["main.c", "law.c", "wire.c", "reference.c", "selftest.c", "port_cortex_m.c"]),
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
    print(f"Cortex-M7: stack at most {bound} bytes, by {' > '.join(way)}; {len(symbols(code))} symbols")
    return failures + [f"board.elf: {line}" for line in fused_instructions(listing)]


if __name__ == "__main__":
    choose_kernel_cache()
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else TICKS_LEAST))
