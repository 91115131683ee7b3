"""What the native loop shares with whoever starts it: one mapped file. It never waits for anything that stands in it.

``SHARED`` is the file's beginning. Behind it come ``settings["blocks"]`` blocks of the path, ``PATH``, then the ring's
bytes. Each number that crosses has one writer: the loop reads settings, config, path, orders, ``looked``, change and
sheets, and writes all else but ``ring["tail"]`` and ``events["tail"]``. What ``operated`` holds is for a stage in
operation: then set-points come in sheets, not in blocks.
"""

from enum import IntEnum, IntFlag
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.can.driver_rules import OUTGOING
from pkxyz_ctrl.export.planned import PLANNED_EXCHANGE, PLANNED_EXCHANGE_MEMORY
from pkxyz_ctrl.loop.exchange import EXCHANGE_MEMORY
from pkxyz_ctrl.loop.law_change import CHANGE
from pkxyz_ctrl.loop.reference import REFERENCE

Records = NDArray[np.void]

MAGIC: Final = 0x504F4F4C5A59584B  # KXYZLOOP
BLOCK_ROWS: Final = 1024
"""Rows of the path from one block to the next."""
AHEAD_ROWS: Final = 32
"""... and so many of the next one behind them: what a law looks ahead."""
SHEET_ROWS: Final = 1024
SNAPSHOTS: Final = 64
HISTOGRAM_US: Final = 2000
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
    SESSION_GONE = 9
    SET_POINTS_LATE = 10


class Told(IntEnum):
    """What an event is about: ``told`` of a call that left frames, an emergency, the mode FAULT that was entered."""

    FRAMES = 0
    EMERGENCY = 1
    FAULT = 2


class Order(IntFlag):
    """What ``ORDERS`` have; of a sheet and a change of law also what was refused, as it came too late."""

    REQUEST = 1
    CLEAR = 2
    RELEASE = 4
    QUIET = 8
    SETTLE = 16
    AIM = 32
    LAW = 64
    SHEET = 128


SETTINGS = np.dtype(
    [
        ("magic", "u8"),
        ("layout", "u8"),  # of all records, as a digest: a program of another version refuses the file
        ("period_us", "i8"),
        ("ticks", "i8"),  # to be recorded
        ("landing_ticks", "i8"),  # behind them, on the way down
        ("blind_ticks", "i8"),  # for so long a session may look at nothing while the loop is closed
        ("sense_deadline_us", "i8"),
        ("heartbeat_deadline_us", "i8"),
        ("guard_us", "i8"),  # a tick that ends later than this before the next one gives that up
        ("latest_start_us", "i8"),  # a tick that is woken later than this is given up
        ("standstill_us", "i8"),  # for so long time waits for a tick, or an answer, that is late; 0: it goes on
        ("spin_us", "i8"),  # how long before an instant sleeping ends
        ("company_us", "i8"),  # for which an empty bus is given time
        ("silent_us", "i8"),  # after a fault, for so long without its heartbeat, the amplifier is gone
        ("ring_bytes", "i8"),
        ("blocks", "i4"),  # of the path
        ("priority", "i4"),  # of SCHED_FIFO
        ("node_heartbeat_id", "i4"),
        ("sense_id", "i4"),
        ("drive_id", "i4"),
        ("loop_closed", "i4"),  # a bit a mode
        ("interface", "i4"),
        ("fd", "i4"),
        ("is_operated", "i4"),  # 1: by orders and sheets
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
        ("stood_us", "i8"),  # for so long time stood still
        ("heartbeat_us", "i8"),  # when the node said last that it is there
        ("phase", "i4"),
        ("outcome", "i4"),
        ("signal", "i4"),  # that asked for the end
        ("status", "i4"),  # of a kernel that failed
        ("port", PORT, (1,)),
        ("lateness", "i8", (HISTOGRAM_US,)),  # wake-ups by whole us of lateness, the last entry all beyond
        ("answers", "i8", (HISTOGRAM_US,)),  # by whole us from a sense frame read to the drive frame handed over
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

ORDERS = np.dtype(
    [
        ("number", "i8"),  # written last; nothing of this is written again before the loop has answered it
        ("tick", "i8"),  # of a change of law: the one that it is meant for, or the next
        ("changed_from", "i8"),  # reference tick of the sheet's first row that is another one than in the sheet before
        ("count", "i8"),  # position trigger, as ``outputs.aim``
        ("start_m", "f8"),
        ("pitch_m", "f8"),
        ("window_m", "f8"),  # in position, as ``outputs.settle``
        ("sigmas", "f8"),
        ("dwell_ticks", "i4"),
        ("axis", "i4"),
        ("direction", "i4"),
        ("bits", "i4"),  # which of these are meant
        ("event", "i4"),
        ("quiet", "i4"),
        ("sheet", "i4"),  # which of the two
    ],
    align=True,
)

OBEYED = np.dtype(
    [
        ("number", "i8"),  # of the orders that were answered
        ("refused", "i8"),  # bits of these that came too late
        ("late_rows", "i8"),  # by how much the last sheet came too late; negative: it had so much time left
        ("refusals", "i8"),  # of sheets, since the beginning
    ],
    align=True,
)

SHEET = np.dtype(
    [
        ("first", "i8"),  # reference tick of the first row
        ("count", "i8"),  # of rows; grows behind them
        ("rests_from", "i8"),  # reference tick from which on the set-point stands, if that is one of these rows
        ("rows", REFERENCE, (SHEET_ROWS,)),
    ],
    align=True,
)

SNAPSHOT = np.dtype(
    [
        ("begun", "i8"),  # which it is, from 1 on, before it is written, and ...
        ("number", "i8"),  # ... after it
        ("obeyed", OBEYED, (1,)),
        ("port", PORT, (1,)),
        ("memory", EXCHANGE_MEMORY, (1,)),
    ],
    align=True,
)

OPERATED = np.dtype(
    [
        ("orders", ORDERS, (1,)),
        ("looked", "i8"),  # newest snapshot that the session has looked at; what followed from it was ordered before
        ("newest", "i8"),  # snapshot
        ("snapshots", SNAPSHOT, (SNAPSHOTS,)),  # of the ends of the last ticks
        ("change", CHANGE, (1,)),
        ("sheets", SHEET, (2,)),
    ],
    align=True,
)

SHARED = np.dtype(
    [
        ("settings", SETTINGS, (1,)),
        ("state", STATE, (1,)),
        ("ring", RING, (1,)),
        ("config", PLANNED_EXCHANGE, (1,)),
        ("memory", PLANNED_EXCHANGE_MEMORY, (1,)),
        ("events", EVENTS_RING, (1,)),
        ("operated", OPERATED, (1,)),
    ],
    align=True,
)


def size_of(blocks: int, ring_bytes: int) -> int:
    """Bytes of a file with so many blocks and such a ring."""
    return SHARED.itemsize + blocks * PATH.itemsize + ring_bytes
