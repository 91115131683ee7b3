"""The exported object on this machine, beside what Python made of the same: laws, exchanges, frames."""

import ctypes
import subprocess
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from exchanges import Exchange
from exchanges import missing as missing_in
from frames import judged, missing
from guarded import Guarded
from numpy.typing import NDArray
from segments import Segment

from hil.runs.scenario import load_scenario
from pkxyz_ctrl.can.process_pdo import pdo_record
from pkxyz_ctrl.export.planned import begins
from pkxyz_ctrl.export.stored import stored, stored_in_exchange
from pkxyz_ctrl.export.words import canonical
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.exchange import EXCHANGE, EXCHANGE_MEMORY
from pkxyz_ctrl.safety.modes import Mode

Records = NDArray[np.void]

HERE = Path(__file__).parent
FRAMES = 300_000


class Law(NamedTuple):
    """A shipped controller: its name, its segments as they ran in Python, and the memory (1,) after the last."""

    name: str
    segments: list[Segment]
    memory: Records


def new_memory(dtype: np.dtype[np.void]) -> Records:
    """Memory (1,) of ``cycle.MEMORY`` or of ``PLANNED_MEMORY``, as every law begins."""
    memory = np.zeros(1, dtype)
    begins(memory, cycling.MEMORY)["mode"] = Mode.IDLE
    return memory


def shared(code: Path, folder: Path) -> ctypes.CDLL:
    """An object for this machine as a library, with ``play`` around it."""
    out = code.with_suffix(".so")
    sources = [HERE / "play.c", *(folder / name for name in ("config.c", "reference.c", "selftest.c", "port_host.c"))]
    words = ["cc", "-shared", "-fPIC", "-O2", "-fno-strict-aliasing", f"-I{folder}", "-o", out, *sources, code]
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
    config, memory = np.zeros(1, EXCHANGE), np.zeros(1, EXCHANGE_MEMORY)
    config["gate"][0] = gate = load_scenario("raster").setup().gate.record
    config["driver"][0, 0]["drive"] = pdo_record(int(gate["drive_id"][0]), True)
    here = judged(config, FRAMES, 13)
    failures = [f"no frame was refused for {name}" for name in missing(here)]
    reasons = np.zeros(len(here.frames), np.int32)
    words = [array.ctypes.data_as(ctypes.c_void_p) for array in (config, memory, here.frames)]
    status = library.judge(*words, len(reasons), reasons.ctypes.data_as(ctypes.c_void_p))
    same = reasons == here.reasons
    if status != 0 or not same.all():
        failures.append(f"the gate's answer to frame {int(same.argmin())}, status {status}")
    if not np.array_equal(canonical(memory["gate"][0]), canonical(here.memory)):
        failures.append("the gate's memory in the end")
    passed = here.frames[(here.reasons == 0) & (here.frames["mode"] >= 0)]
    voltages = np.count_nonzero((passed["can_id"] == gate["drive_id"][0]) & (passed["data"] << 16 != 0))
    print(f"host: {FRAMES} frames judged, {voltages} voltages passed, {time.monotonic() - begin_s:.0f} s")
    return failures if voltages > FRAMES // 100 else [*failures, "hardly a voltage passed the gate"]


def first_difference(law: Law, library: ctypes.CDLL) -> str:
    """Where a library parts from Python; empty if nowhere. It holds no more than a board does."""
    held, ticks = stored(begins(law.segments[0].law, cycling.LAW)), 0
    settings, memory = Guarded(held.settings), Guarded(held.memory)
    memory.fill(new_memory(law.memory.dtype))
    for segment in law.segments:
        settings.fill(segment.law)
        rows, path = np.zeros_like(segment.rows), segment.reference
        words = [array.ctypes.data_as(ctypes.c_void_p) for array in (path, segment.inputs, rows)]
        status = library.play(settings.pointer, memory.pointer, words[0], len(path), words[1], len(rows), words[2])
        if status != 0:
            return f"{law.name}: status at tick {ticks + status - 1}"
        same = (canonical(rows).reshape(len(rows), -1) == canonical(segment.rows).reshape(len(rows), -1)).all(axis=1)
        if not same.all():
            return f"{law.name}: row of tick {ticks + int(same.argmin())}"
        ticks += len(rows)
    same = np.array_equal(canonical(memory.records(law.memory.dtype)), canonical(law.memory))
    return "" if same else f"{law.name}: memory at the end"


def exchanges_compared(played: list[Exchange], library: ctypes.CDLL) -> list[str]:
    """What every call of every exchange left: frames with the gate's verdicts, rows, and the memory in the end."""
    begin_s = time.monotonic()
    failures = [f"the exchanges had no {name}" for name in missing_in(played)]
    failures += [found for exchange in played if (found := parted(exchange, library))]
    calls = sum(len(exchange.calls) for exchange in played)
    print(f"host: {calls} calls of {len(played)} exchanges compared, {time.monotonic() - begin_s:.0f} s")
    return failures


def parted(exchange: Exchange, library: ctypes.CDLL) -> str:
    """Where a library parts from Python in an exchange; empty if nowhere."""
    held = stored_in_exchange(exchange.config["law"][0])
    settings, memory = Guarded(held.settings), Guarded(held.memory)
    settings.fill(exchange.config)
    digests = np.zeros_like(exchange.digests)
    path, calls, left = (a.ctypes.data_as(ctypes.c_void_p) for a in (exchange.reference, exchange.calls, digests))
    status = library.converse(
        settings.pointer, memory.pointer, path, len(exchange.reference), calls, len(exchange.calls), left
    )
    same = digests == exchange.digests
    if status != 0 or not same.all():
        return f"{exchange.name}: call {int(same.argmin())} of {len(same)}, status {status}"
    ours = canonical(memory.records(EXCHANGE_MEMORY))[: held.memory // 8]
    return "" if np.array_equal(ours, exchange.held) else f"{exchange.name}: memory at the end"
