"""What the memory of a stage in operation holds, saved as the folder of a run: after a fault, or when asked."""

import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from hil.bus.frame_log import FrameLog
from hil.operate.memory import StageMemory
from hil.operate.tick_frames import frames_of
from hil.recording.recording import RecordingWriter
from hil.runs.run_folder import FRAMES, RECORDING, SUMMARY
from pkxyz_ctrl.loop.row import ROW

BEFORE_S, AFTER_S = 2.0, 0.2
"""Around a fault."""
_FOLDERS_MOST = 100
_ROWS_AT_ONCE = 4096


class NotSavedError(Exception):
    """The message says why."""


def save(memory: StageMemory, description: dict[str, Any], seconds: float, why: str, base: Path) -> Path:
    """Save the last ``seconds``, as far as they are there; returns the folder. Raises ``NotSavedError``."""
    kind = "fault" if why else "saved"
    ticks = memory.reader("ticks")
    newest, count = ticks.newest, round(seconds * 1e6 / description["period_us"])
    try:
        folder = _made(base, kind)
        with RecordingWriter(folder / RECORDING, {"kind": kind, "loop": description}) as writer:
            first, last = _rows(ticks, newest, count, writer)
        frames = _frames(memory, first, last, folder / FRAMES)
        about = {"kind": kind, "words": why, "first_tick": first, "last_tick": last, "frames": frames}
        (folder / SUMMARY).write_text(json.dumps(about | {"loop": description}, indent=1) + "\n", encoding="utf-8")
    except (OSError, RuntimeError) as error:
        raise NotSavedError(f"the last {seconds:g} s could not be saved in {base}: {error}") from None
    return folder


def _made(base: Path, kind: str) -> Path:
    base.mkdir(parents=True, exist_ok=True)
    if len(list(base.glob(f"{kind}-*"))) >= _FOLDERS_MOST:
        raise NotSavedError(f"{base} holds {_FOLDERS_MOST} folders {kind}-* already: move some away")
    name = f"{kind}-{time.strftime('%Y%m%dT%H%M%S')}"
    for n in range(_FOLDERS_MOST):
        folder = base / (f"{name}-{n}" if n else name)
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder
    raise NotSavedError(f"{base / name}: is there already")


def _rows(ticks: Any, newest: int, count: int, writer: RecordingWriter) -> tuple[int, int]:
    first = last = -1
    for behind in range(count, 0, -_ROWS_AT_ONCE):
        found = ticks.before(newest - max(0, behind - _ROWS_AT_ONCE), min(behind, _ROWS_AT_ONCE))
        if len(found):
            rows = np.ascontiguousarray(found["row"]).astype(ROW)
            writer.write(rows)
            first = int(rows["tick"][0]) if first < 0 else first
            last = int(rows["tick"][-1])
    if first < 0:
        raise NotSavedError("there is no tick yet")
    return first, last


def _frames(memory: StageMemory, first: int, last: int, file: Path) -> int:
    """Those of the ticks, as far back as they are kept; returns how many."""
    reader = memory.reader("frames", from_start=True)
    with FrameLog(file, "can") as log:
        while len(found := reader.read_block(_ROWS_AT_ONCE)):
            for record in found:
                if first <= int(record["tick"]) <= last:
                    for frame, t_us in frames_of(record):
                        log.record(frame, t_us)
        log.flush()
        return log.frames
