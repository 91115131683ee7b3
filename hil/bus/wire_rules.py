"""The wire between two endpoints while nothing goes wrong on it, compiled: arbitration and times as ``wire`` has them.
Errors that were counted before are forgotten frame by frame.

A frame that carries data has at most eight bytes, as an integer of 64 bits, the first one lowest.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.bus.frame_time import duration_ns_kernel
from pkxyz_ctrl.compiled.kernel import kernel

Records = NDArray[np.void]

PLACES: Final = 4  # frames that wait at a time
NEVER_US: Final = 1 << 62
_BYTES: Final = 8
_EMPTY: Final = -1
_US_NS: Final = 1000

FRAME = np.dtype(
    [
        ("word", "i8"),
        ("duration_ns", "i8"),
        ("can_id", "i4"),  # 11 bits; none two alike wait at a time
        ("flags", "i4"),
        ("length", "i4"),
        ("sender", "i4"),
    ],
    align=True,
)

WIRE = np.dtype(
    [
        ("nominal_bitrate", "i8"),
        ("data_bitrate", "i8"),
        ("to_end_ns", "i8"),  # frame_time.to_end_ns
        ("start_ns", "i8"),  # of the frame under way, or of the one that would win
        ("end_us", "i8"),  # of its EOF; NEVER_US: the wire is idle
        ("free_ns", "i8"),  # end of the latest interframe space
        ("busy_ns", "i8"),
        ("frames", "i8"),
        ("queue", FRAME, (PLACES,)),
        ("done", FRAME, (1,)),  # the frame that has just ended
        ("payload", "u1", (_BYTES,)),
        ("transmit_errors", "i4", (2,)),  # by sender; each below what makes it error-passive
        ("receive_errors", "i4", (2,)),
        ("place", "i4"),  # in ``queue``, of the frame under way
        ("waiting", "i4"),
    ],
    align=True,
)


def clear(wire: Records) -> None:
    """Idle, and nothing queued."""
    wire["queue"]["can_id"] = _EMPTY
    wire["end_us"], wire["waiting"] = NEVER_US, 0


@kernel
def send(wire: np.void, sender: int, can_id: int, flags: int, length: int, word: int, now_us: int) -> bool:
    """Queue a frame; False if there is no room for it, or there can be no such frame."""
    for place in range(PLACES):
        frame = wire["queue"][place]
        if frame["can_id"] != _EMPTY:
            continue
        payload = wire["payload"]
        for i in range(_BYTES):
            payload[i] = word >> 8 * i & 0xFF
        duration_ns = duration_ns_kernel(wire["nominal_bitrate"], wire["data_bitrate"], can_id, payload[:length], flags)
        if duration_ns < 0:
            return False
        frame["word"], frame["duration_ns"], frame["can_id"] = word, duration_ns, can_id
        frame["flags"], frame["length"], frame["sender"] = flags, length, sender
        wire["waiting"] += 1
        if wire["end_us"] == NEVER_US or now_us * _US_NS <= wire["start_ns"]:
            arbitrate(wire, now_us)
        return True
    return False


@kernel
def arbitrate(wire: np.void, now_us: int) -> None:
    """Choose the frame that starts next: the lowest identifier."""
    best = -1
    for place in range(PLACES):
        can_id = wire["queue"][place]["can_id"]
        if can_id != _EMPTY and (best < 0 or can_id < wire["queue"][best]["can_id"]):
            best = place
    if best < 0:
        wire["end_us"] = NEVER_US
        return
    start_ns = max(now_us * _US_NS, wire["free_ns"])
    wire["place"], wire["start_ns"] = best, start_ns
    wire["end_us"] = (start_ns + wire["queue"][best]["duration_ns"] + wire["to_end_ns"]) // _US_NS


@kernel
def end(wire: np.void) -> None:
    """The frame under way has ended: it stands in ``done``. Who has seen to it lets the next one start."""
    frame, done = wire["queue"][wire["place"]], wire["done"][0]
    done["word"], done["can_id"], done["length"] = frame["word"], frame["can_id"], frame["length"]
    done["flags"], done["sender"] = frame["flags"], frame["sender"]
    wire["free_ns"] = wire["start_ns"] + frame["duration_ns"]
    wire["busy_ns"] += frame["duration_ns"]
    wire["frames"] += 1
    frame["can_id"] = _EMPTY
    wire["waiting"] -= 1
    errors, sender = wire["transmit_errors"], frame["sender"]
    if errors[sender] > 0:
        errors[sender] -= 1


@kernel
def received(wire: np.void) -> None:
    """The other one has got the frame in ``done``."""
    errors, receiver = wire["receive_errors"], 1 - wire["done"][0]["sender"]
    if errors[receiver] > 0:
        errors[receiver] -= 1
