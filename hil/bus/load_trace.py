"""Bus load over time, from a frame log: samples of the file, so that a long log costs no more than a short one."""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.bus.frame_time import frame_duration_ns
from pkxyz_ctrl.can.cob_id import SYNC
from pkxyz_ctrl.can.frame import Frame

_BINS = 110
_BIN_BYTES = 32_768  # a bin is judged by at most this much of the log, about 0.04 s of a busy wire


class BusTrace(NamedTuple):
    """Load at the middle of each sampled stretch of time since the first SYNC, which begins tick 0."""

    t_s: NDArray[np.float64]
    load: NDArray[np.float64]
    """0 to 1: time that frames took over time that passed"""


def read_bus_trace(frame_log: str | Path, can: dict[str, Any]) -> BusTrace | None:
    """Load over the time of a candump log; None if it holds too few frames. ``can``: the bus's plain ``CanConfig``."""
    nominal = can["nominal_bitrate_bit_per_s"]
    rates = nominal, can.get("data_bitrate_bit_per_s") or nominal
    size = Path(frame_log).stat().st_size
    step = math.ceil(size / _BINS)
    times, loads = [], []
    first_sync_s: float | None = None
    with Path(frame_log).open("rb") as file:
        for number in range(_BINS):
            file.seek(number * step)
            lines = file.read(min(step, _BIN_BYTES)).split(b"\n")
            frames = [parsed for line in lines[1 if number else 0 : -1] if (parsed := _parse(line)) is not None]
            if first_sync_s is None:
                first_sync_s = next(
                    (s - frame_duration_ns(f, *rates) * 1e-9 for s, f in frames if f.can_id == SYNC), None
                )
            if len(frames) < 2 or frames[-1][0] <= frames[0][0]:
                continue
            busy_ns = sum(frame_duration_ns(frame, *rates) for _, frame in frames[1:])
            begin_s, end_s = frames[0][0], frames[-1][0]  # a time stamp is the end of its frame
            times.append((begin_s + end_s) / 2)
            loads.append(busy_ns * 1e-9 / (end_s - begin_s))
    return BusTrace(np.array(times) - (first_sync_s or 0.0), np.array(loads)) if len(times) > 1 else None


def _parse(line: bytes) -> tuple[float, Frame] | None:
    """End of the frame in s, and the frame, of one line; None for an error frame, whose length is not its own."""
    stamp, _, words = line.decode("ascii").split(" ", 2)
    identifier, _, payload = words.partition("#")
    is_extended = len(identifier) == 8
    can_id = int(identifier, 16)
    if can_id > 0x1FFF_FFFF:
        return None
    if payload.startswith("#"):
        frame = Frame(can_id, bytes.fromhex(payload[2:]), True, payload[1] == "1", is_extended=is_extended)
    elif payload.startswith("R"):
        frame = Frame(can_id, bytes(int(payload[1:] or 0)), is_remote=True, is_extended=is_extended)
    else:
        frame = Frame(can_id, bytes.fromhex(payload), is_extended=is_extended)
    return float(stamp[1:-1]), frame
