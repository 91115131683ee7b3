"""What the native loop shares with whoever starts it: one mapped file. It never waits for anything that stands in it.

``SHARED`` is the file's beginning. Behind it come ``settings["blocks"]`` blocks of the path, ``PATH``, then the ring's
bytes. Each number that crosses has one writer: the loop reads settings, config and path, and writes all else but
``ring["tail"]`` and ``events["tail"]``.
"""

from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.can.driver_rules import OUTGOING
from pkxyz_ctrl.loop.exchange import EXCHANGE, EXCHANGE_MEMORY
from pkxyz_ctrl.loop.reference import REFERENCE

Records = NDArray[np.void]

MAGIC: Final = 0x504F4F4C5A59584B  # KXYZLOOP
BLOCK_ROWS: Final = 1024
"""Rows of the path from one block to the next."""
AHEAD_ROWS: Final = 32
"""... and so many of the next one behind them: what a law looks ahead."""
LATENESS_MOST_US: Final = 2000
EVENTS: Final = 64
_WORDS: Final = 512
_CHANNEL: Final = 128


class Interface(IntEnum):
    """Which bus."""

    UNIX = 0
    SOCKETCAN = 1


class Phase(IntEnum):
    """How far the loop has come."""

    BEGUN = 0
    ALONE = 1
    STARTING = 2
    RUNNING = 3
    ENDED = 4


class LoopEnd(IntEnum):
    """How it ended."""

    NONE = 0
    DONE = 1
    SIGNAL = 2
    REFUSED = 3
    NOT_STARTED = 4
    AMPLIFIER_GONE = 5
    RECORDER_GONE = 6
    PATH_LATE = 7
    KERNEL = 8


class Told(IntEnum):
    """What an event is about: ``told`` of a call that left frames, an emergency, the mode FAULT that was entered."""

    FRAMES = 0
    EMERGENCY = 1
    FAULT = 2


SETTINGS = np.dtype(
    [
        ("magic", "u8"),
        ("layout", "u8"),  # of all records, as a digest: a program of another version refuses the file
        ("period_us", "i8"),
        ("ticks", "i8"),  # to be recorded
        ("landing_ticks", "i8"),  # behind them, on the way down
        ("sense_deadline_us", "i8"),
        ("heartbeat_deadline_us", "i8"),
        ("guard_us", "i8"),  # a tick that ends later than this before the next one gives that up
        ("latest_start_us", "i8"),  # a tick that is woken later than this is given up
        ("spin_us", "i8"),  # how long before an instant sleeping ends
        ("company_us", "i8"),  # for which an empty bus is given time
        ("silent_us", "i8"),  # after a fault, for so long without its heartbeat, the amplifier is gone
        ("ring_bytes", "i8"),
        ("blocks", "i4"),  # of the path
        ("priority", "i4"),  # of SCHED_FIFO
        ("node_heartbeat_id", "i4"),
        ("loop_closed", "i4"),  # a bit a mode
        ("interface", "i4"),
        ("fd", "i4"),
        ("is_named", "i4"),  # 1: the channel's folder stands for a name, and goes with the last one out
        ("channel", "u1", (_CHANNEL,)),  # a folder, or an interface's name; zeros behind it
    ],
    align=True,
)

PORT = np.dtype(
    [
        ("sent", "i8"),
        ("refused", "i8"),
        ("dropped", "i8"),  # for which a receiver that stood still had no room
        ("refusal", "i4"),  # errno of the latest
        ("refuses", "i4"),  # 1: since then none was taken
        ("is_bus_off", "i4"),  # 1: said by its last error frame
        ("others", "i4"),  # participants beside us; -1 where that is not known
    ],
    align=True,
)

STATE = np.dtype(
    [
        ("begun_ns", "i8"),  # where its clock is 0, of CLOCK_MONOTONIC
        ("reference_tick", "i8"),  # where on the path it is
        ("ticks", "i8"),  # that were run
        ("heartbeat_us", "i8"),  # when the node said last that it is there
        ("phase", "i4"),
        ("outcome", "i4"),
        ("signal", "i4"),  # that asked for the end
        ("status", "i4"),  # of a kernel that failed
        ("port", PORT, (1,)),
        ("lateness", "i8", (LATENESS_MOST_US,)),  # wake-ups by whole us of lateness, the last entry all beyond
        ("real_time", "u1", (_WORDS,)),  # what the system gave, in words
        ("refusal", "u1", (_WORDS,)),  # why the bus can't be had, in words
    ],
    align=True,
)

RING = np.dtype(
    [
        ("head", "i8"),  # bytes that were written, whole ticks of them
        ("lost_rows", "i8"),  # for which there was no room
        ("lost_bytes", "i8"),
        ("apart", "i8", (5,)),  # each writer has a line of the cache for itself
        ("tail", "i8"),  # bytes that were read
        ("apart_too", "i8", (7,)),
    ],
    align=True,
)

EVENT = np.dtype(
    [
        ("t_us", "i8"),
        ("told", "i8"),
        ("kind", "i4"),
        ("frame", OUTGOING, (1,)),  # that came
        ("port", PORT, (1,)),
        ("memory", EXCHANGE_MEMORY, (1,)),  # as it was then
    ],
    align=True,
)

EVENTS_RING = np.dtype(
    [
        ("head", "i8"),  # how many there were
        ("lost", "i8"),  # for which there was no room
        ("tail", "i8"),  # how many were read
        ("event", EVENT, (EVENTS,)),
    ],
    align=True,
)

PATH = np.dtype(
    [
        ("number", "i8"),  # which block stands here; -1: none. Written last
        ("rows", REFERENCE, (BLOCK_ROWS + AHEAD_ROWS,)),
    ],
    align=True,
)

SHARED = np.dtype(
    [
        ("settings", SETTINGS, (1,)),
        ("state", STATE, (1,)),
        ("ring", RING, (1,)),
        ("config", EXCHANGE, (1,)),
        ("memory", EXCHANGE_MEMORY, (1,)),
        ("events", EVENTS_RING, (1,)),
    ],
    align=True,
)


def size_of(blocks: int, ring_bytes: int) -> int:
    """Bytes of a file with so many blocks and such a ring."""
    return SHARED.itemsize + blocks * PATH.itemsize + ring_bytes
