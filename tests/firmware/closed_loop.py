"""The loop closed on the emulated board: its rows, frames and words are those of lockstep, and when it is killed the
amplifier goes to 0 V by itself. ``python tests/firmware/closed_loop.py LAW...`` compares the whole matrix of faults.
"""

import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from on_board import SCRATCH, board_tools

from hil.emulator.rig import EmulatedRig, image_of
from hil.faults.fault import Fault
from hil.lanes.blocks import Blocks
from hil.lanes.lockstep import LockstepRig
from hil.lanes.setup import Setup
from hil.recording.recording import Recording
from hil.studies.faults.matrix import CASES, CLEAR_S, NODE_MS
from hil.studies.faults.outcome import setup_for
from pkxyz_ctrl.compiled.kernel_cache import choose_kernel_cache
from pkxyz_ctrl.loop.controller import StartUpError
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.trips import Trip

LAW = "lqg"
FEW = ("amplifier.2:trip", "node:reset", "bus.drive:forged", "controller:lost_tick", "controller:killed")
"""Cases of the matrix that are tried each time: emergency, start-up after a clear, gate, time, and the end."""
_AT_S, _LASTS_S, _CLEAR_S, _DURATION_S = 0.1, 0.02, 0.02, 0.17
_KILLED_AFTER = 400
LOOK_MS = 1.0


class Ran(NamedTuple):
    """``rows`` (n,), the frame log, sentences about faults, missed ticks."""

    rows: NDArray[np.void]
    frames: bytes
    faults: list[str]
    missed: int


def closed_loop(part: Callable[[Path], list[str]]) -> list[str]:
    """One of ``PARTS`` of what is tried each time; returns what is not as it has to be, and prints what was found."""
    begin_s = time.monotonic()
    why_not = use_tools()
    if why_not:
        print(f"\n*** SKIPPED: the loop was not closed on a board: {why_not}\n", file=sys.stderr)
        return []
    with tempfile.TemporaryDirectory(dir=SCRATCH) as folder:
        failures = part(Path(folder))
    print(f"closed loop on the board, {part.__name__}: {time.monotonic() - begin_s:.0f} s")
    return failures


def broken(work: Path) -> list[str]:
    """Killed, under some faults, and with a node that does not start."""
    setup = dataclasses.replace(setup_for(LAW), duration_s=_DURATION_S, clear_s=_CLEAR_S)
    failures = [*killed(setup, work)]
    for text in FEW:
        case = next(case for case in CASES if case.text == text)
        fault = case.fault.model_copy(update={"at_s": _AT_S, "duration_s": _LASTS_S})
        failures += differences(setup, fault, work)
    return [*failures, *differences(setup, Fault(target="node", kind="wrong_identity", at_s=0.0), work)]


def matrix(laws: Sequence[str]) -> list[str]:
    """Every shipped fault under these laws, as ``pkxyz faults`` has them."""
    why_not = use_tools()
    if why_not:
        return [why_not]
    failures = []
    with tempfile.TemporaryDirectory(dir=SCRATCH) as folder:
        for law in laws:
            setup = dataclasses.replace(setup_for(law), clear_s=CLEAR_S)
            for case in CASES:
                failures += differences(setup, case.on(setup.bus.period_us).fault, Path(folder))
    return failures


def use_tools() -> str:
    """Have emulator and compiler on PATH, as ``pkxyz emulate`` wants them; why that can't be, empty if they are."""
    tools, why_not = board_tools()
    if tools is None:
        return why_not
    if tools.folder is not None:
        os.environ["PATH"] = f"{tools.folder}{os.pathsep}{os.environ['PATH']}"
        os.environ["LD_LIBRARY_PATH"] = tools.environment["LD_LIBRARY_PATH"]
    return ""


def differences(setup: Setup, fault: Fault, work: Path) -> Iterator[str]:
    """What is otherwise on the board, under one fault."""
    broken = dataclasses.replace(setup, faults=(fault,))
    vars(broken)["law"] = setup.law  # designed once
    ours, theirs = ran(LockstepRig(broken, work / "frames.log"), work), on_board(broken, work)
    print(f"board: {setup.controller.name}, {fault}: {_decision(theirs.rows)}")
    where = f"{setup.controller.name}, {fault}"
    if len(ours.rows) != len(theirs.rows):
        yield f"{where}: {len(theirs.rows)} rows, not {len(ours.rows)}"
        return
    apart = [
        f"{name} of tick {int(np.argmax(_bytes(ours.rows, name) != _bytes(theirs.rows, name)))}"
        for name in ROW.names or ()
        if ours.rows[name].tobytes() != theirs.rows[name].tobytes()
    ]
    apart += [word for word in ("frames", "faults", "missed") if getattr(ours, word) != getattr(theirs, word)]
    yield from (f"{where}: {what}" for what in apart)


def on_board(setup: Setup, work: Path) -> Ran:
    """A run on the board."""
    return ran(EmulatedRig(setup, image_of(setup, work), work, work / "frames.log"), work)


def on_board_taken(setup: Setup, work: Path) -> NDArray[np.void]:
    """(n,) of ``rig.TAKEN``: the instructions of each tick of a run."""
    rig = EmulatedRig(setup, image_of(setup, work), work, work / "frames.log")
    ran(rig, work)
    return rig.taken


def ran(rig: LockstepRig, work: Path) -> Ran:
    """What a rig makes of its setup; it logs frames into ``frames.log``."""
    setup, blocks = rig.setup, list[NDArray[np.void]]()
    failed = []
    try:
        missed, _ = rig.run(
            Blocks(
                setup.trajectory, setup.bus.period_us, setup.ticks, lambda b: blocks.append(b.copy()), lambda *_: None
            )
        )
    except StartUpError as error:
        missed, failed = -1, [str(error)]
    rows = np.concatenate(blocks) if blocks else np.zeros(0, ROW)
    return Ran(rows, (work / "frames.log").read_bytes(), rig.controller.faults + failed, missed)


def killed(setup: Setup, work: Path) -> Iterator[str]:
    """``kill -9`` of the emulator while the combs are driven."""
    rig = EmulatedRig(setup, image_of(setup, work), work, work / "frames.log")
    killer = threading.Thread(target=_kill, args=(rig,), daemon=True)
    killer.start()
    found = ran(rig, work)
    said = re.search(r"ended by signal 9 \(SIGKILL\); all combs at 0 V within ([\d.]+) ms$", found.faults[-1])
    print(f"board, killed: {found.faults[-1]}")
    if not _KILLED_AFTER <= len(found.rows) < setup.ticks:
        yield f"killed: {len(found.rows)} rows"
    elif float(found.rows["voltage_v"][-1].max()) < 10.0:
        yield "killed: no comb was driven then"
    if said is None or float(said[1]) > NODE_MS + LOOK_MS:
        yield f"killed: {found.faults[-1]}"
    if rig.node.outputs != (0, 0, 0):
        yield f"killed: outputs {rig.node.outputs}"


def _kill(rig: EmulatedRig) -> None:
    while np.count_nonzero(rig.taken["period"]) <= _KILLED_AFTER:
        time.sleep(0.01)
    os.kill(rig.board.pid, signal.SIGKILL)


def by_command(work: Path) -> list[str]:
    """``pkxyz emulate`` of the default scenario: its checks hold, its folder can be replayed, and holds what that of
    ``pkxyz sil`` holds.
    """
    begin_s = time.monotonic()
    failures, folders = [], [work / name for name in ("emulated", "lockstep")]
    for command, folder in zip(("emulate", "sil"), folders, strict=True):
        done = pkxyz(command, "raster", "--out", folder, "--json")
        if done.returncode != 0:
            return [f"pkxyz {command} raster: {done.returncode}, {done.stdout[-300:]} {done.stderr[-300:]}"]
        checks = json.loads(done.stdout)["checks"]
        print(f"pkxyz {command} raster: {len(checks)} checks hold, {time.monotonic() - begin_s:.0f} s")
    replayed = pkxyz("replay", folders[0])
    failures += [] if replayed.returncode == 0 else [f"replay: {replayed.stdout[-300:]} {replayed.stderr[-300:]}"]
    ours, theirs = (Recording.open(folder / "recording.parquet") for folder in folders)
    fields = list(ROW.names or ())
    for a, b in zip(ours.rows(fields), theirs.rows(fields), strict=True):
        failures += [f"raster: {name} differs" for name in fields if a[name].tobytes() != b[name].tobytes()]
    logs = [re.sub(rb"\) \S+ ", b") ", (folder / "frames.log").read_bytes()) for folder in folders]
    failures += [] if logs[0] == logs[1] else ["raster: frames differ"]
    lacking = [f for f in ("config.toml", "summary.json", "report.png") if not (folders[0] / f).is_file()]
    return failures + [f"raster: no {file} was left" for file in lacking]


def pkxyz(*words: object) -> subprocess.CompletedProcess[str]:
    """The command line, in a process of its own."""
    line = [sys.executable, "-m", "hil", *map(str, words)]
    return subprocess.run(line, check=False, capture_output=True, text=True, timeout=1200)


def _decision(rows: NDArray[np.void]) -> str:
    latched = np.flatnonzero(np.isin(rows["mode"], (Mode.FAULT, Mode.LANDING)))
    if not len(latched):
        return f"{len(rows)} rows, no fault decision"
    at = int(latched[0])
    names = ", ".join(str(trip.name) for trip in Trip if trip & int(rows["trips"][at]))
    return f"{len(rows)} rows, decided at tick {at}: {names}"


def _bytes(rows: NDArray[np.void], name: str) -> NDArray[np.void]:
    """(n,) of the field's bytes as one."""
    field = np.ascontiguousarray(rows[name]).reshape(len(rows), -1)
    return field.view(f"V{field.dtype.itemsize * field.shape[1]}").reshape(-1)


PARTS = (by_command, broken)


if __name__ == "__main__":
    choose_kernel_cache()
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    found = matrix(sys.argv[1:]) if len(sys.argv) > 1 else [line for part in PARTS for line in closed_loop(part)]
    print("\n".join(f"FAILED: {line}" for line in found) or "passed")
    sys.exit(bool(found))
