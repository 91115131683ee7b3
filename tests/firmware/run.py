"""Proof of bits: ``make test-firmware``. A million ticks through the exported controller, on this machine and on an
emulated Cortex-M7, beside the same ticks in Python; what the objects hold; and that a difference would be seen.

The emulator and the compiler for ARM are Debian's packages, unpacked beside, or what is on PATH. Where they can't be
had the board's part is left out, loudly. Exit code 0 if all that was tried holds, 1 if not.
"""

import dataclasses
import multiprocessing
import os
import re
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from unittest import mock

import numpy as np
from closed_loop import PARTS, closed_loop
from compared import Law, compared_here, exchanges_compared, first_difference, frames_compared, new_memory, shared
from disassembly import fused_instructions
from exchanges import exchanges
from numpy.typing import NDArray
from on_board import HELD_MOST, SCRATCH, board_tools, compared_on_board
from segments import TICKS, segments

from hil.commands.export import exported_of
from hil.lanes.setup import Setup
from hil.runs.scenario import load_scenario
from pkxyz_ctrl.compiled.kernel_cache import choose_kernel_cache
from pkxyz_ctrl.config.files import CONFIG_DIR, ConfigError
from pkxyz_ctrl.design.model.discrete_law import LawError
from pkxyz_ctrl.export import kernels as exporting
from pkxyz_ctrl.export.folder import write
from pkxyz_ctrl.export.kernels import Kernels, kernels
from pkxyz_ctrl.export.lowering import Lowered, lower
from pkxyz_ctrl.export.planned import PLANNED_MEMORY, is_planned
from pkxyz_ctrl.export.stored import stored_in_exchange
from pkxyz_ctrl.export.targets import TARGETS
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.trips import Trip

Records = NDArray[np.void]

TICKS_LEAST = 1_000_000
YIELDING = 5
PLANNED_SEGMENTS, PLANNED_CODE_MOST = 80, 90_000
FROM_OUTSIDE = Trip.GATE_BLOCKED | Trip.OPERATOR | Trip.SOLVER
"""What no law but the one that plans raises by itself: its callers do."""


def main(ticks: int) -> int:
    """Everything, with at least so many ticks; prints what was found.

    Beside this process two close the loop, of which most is waiting for the board, and one compiles, which yields to
    them all. The emulated board, which this one only waits for, has a thread.
    """
    begin_s = time.monotonic()
    SCRATCH.mkdir(exist_ok=True)
    failures: list[str] = []
    spawning = multiprocessing.get_context("spawn")
    with (
        ProcessPoolExecutor(len(PARTS), spawning) as closing,
        ProcessPoolExecutor(1, spawning, os.nice, (YIELDING,)) as compiling,
        ThreadPoolExecutor(1) as waiting,
        tempfile.TemporaryDirectory(dir=SCRATCH) as folder,
    ):
        work = Path(folder)
        again = compiling.submit(anew)
        board_tools()  # fetched once, before two processes look for them
        host = exported("host", work)  # the kernels are there from now on
        closed = [closing.submit(closed_loop, part) for part in PARTS]
        others = {name: compiling.submit(lowered, name) for name in TARGETS}
        board = exported("cortex-m7", work)
        failures += own_test(host)
        laws = played(ticks)
        failures += covered(laws)
        failures += too_large(laws)
        conversations = list(exchanges())
        on_board = waiting.submit(compared_on_board, laws, conversations, board)
        library = shared(host / "pkxyz.o", host)
        failures += compared_here(laws, library)
        failures += exchanges_compared(conversations, library)
        failures += frames_compared(library)
        failures += planted(laws[0], host)
        failures += clean(board, {name: other.result() for name, other in others.items()}, again.result())
        failures += on_board.result()
        failures += planned(work)
        failures += [line for part in closed for line in part.result()]
    for line in failures:
        print(f"FAILED: {line}")
    print(f"{'failed' if failures else 'passed'}, {time.monotonic() - begin_s:.0f} s in all")
    return 1 if failures else 0


def exported(target: str, work: Path, controller: str | None = None) -> Path:
    """The folder of ``pkxyz export`` for a target, of the default scenario."""
    out = work / f"{target}-{controller}"
    write(out, target, exported_of(load_scenario("raster", controller=controller), TICKS))
    return out


def planned(work: Path) -> list[str]:
    """The law that plans, whose object is one of its own. Fewer ticks, as each takes a board ten times as long; that it
    is refused there for that has nothing to do with its bits.
    """
    with mock.patch("pkxyz_ctrl.export.folder.require_exportable"):
        host, board = (exported(target, work, "mpc") for target in ("host", "cortex-m7"))
    law = ran(setup_of("mpc"), PLANNED_SEGMENTS, 0)
    solved = np.concatenate([segment.rows["solver_iterations"] for segment in law.segments])
    found, gave_up = solved[solved > 0], np.count_nonzero(solved < 0)
    print(f"mpc: {len(solved)} ticks, {len(found)} plans in {found.max()} rounds at most, {gave_up} that failed")
    failures = own_test(host) + compared_here([law], shared(host / "pkxyz.o", host))
    failures += [] if gave_up else ["no plan failed"]
    return failures + compared_on_board([law], [], board, PLANNED_CODE_MOST)


def own_test(host: Path) -> list[str]:
    """The folder builds by its own files, and its self-test passes."""
    subprocess.run(["make", "--silent", "-C", host], check=True)
    begin_s = time.monotonic()
    done = subprocess.run([host / "selftest"], check=False, capture_output=True, text=True)
    print(f"host: {done.stdout.strip()}, {time.monotonic() - begin_s:.2f} s")
    return [] if done.returncode == 0 else ["the self-test of the exported folder"]


def played(ticks: int) -> list[Law]:
    """Every shipped law but the one that plans, through all its segments in Python."""
    names = sorted(path.stem for path in (CONFIG_DIR / "controllers").glob("*.toml"))
    setups = [setup_of(name) for name in names]
    going = [s for s in setups if not is_planned(s.law)]
    lqg = next(s for s in going if s.controller.name == "lqg")
    going.append(dataclasses.replace(lqg, bus=lqg.bus.model_copy(update={"delay_periods": 2})))
    each = -(-ticks // TICKS // len(going))
    found = []
    begin_s = time.monotonic()
    for seed, setup in enumerate(going):
        found.append(ran(setup, each, seed))
    done = sum(len(segment.rows) for law in found for segment in law.segments)
    print(f"Python: {done} ticks of {len(found)} laws, {time.monotonic() - begin_s:.0f} s")
    return found


def ran(setup: Setup, count: int, seed: int) -> Law:
    """So many segments of a law in Python."""
    memory = new_memory(PLANNED_MEMORY if is_planned(setup.law) else cycling.MEMORY)
    run = list(segments(setup.law, setup.trajectory, setup.bus.period_us, count, seed, memory))
    return Law(f"{setup.controller.name}, {setup.bus.name}, delay {setup.bus.delay_periods}", run, memory)


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


def too_large(laws: list[Law]) -> list[str]:
    """Laws of which a board would have to hold more than it should."""
    failures = []
    for law in laws:
        held = stored_in_exchange(law.segments[0].law)
        print(f"{law.name:34} {held.settings:6} bytes of law and settings, {held.memory:6} of memory")
        failures += [f"{law.name}: more than {HELD_MOST} bytes"] if sum(held) > HELD_MOST else []
    return failures


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


def lowered(name: str) -> Lowered:
    """The kernels for a target."""
    target = TARGETS[name]
    return lower(kernels(is_planned=target.has_loop), target)


def clean(board: Path, others: dict[str, Lowered], again: Kernels) -> list[str]:
    """No target's code fuses a multiplication with an addition, nor needs what a port does not owe."""
    failures = []
    for name, target in TARGETS.items():
        found = fused_instructions(others[name].assembly)
        failures += [f"{name}: {line}" for line in found]
        if name == "cortex-m7" and others[name].code != (board / "pkxyz.o").read_bytes():
            failures.append("the same input gave other bytes")
        if others[name].owed and target.has_double and not target.is_hosted:
            failures.append(f"{name}: needs {others[name].owed}")
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


if __name__ == "__main__":
    choose_kernel_cache()
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else TICKS_LEAST))
