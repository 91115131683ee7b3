"""What of the compiled kernels gets a name in C, and what each is handed."""

from typing import Any, NamedTuple

import numpy as np

from pkxyz_ctrl.export import wire as wiring
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.reference import REFERENCE


class Argument(NamedTuple):
    """One array of records: a pointer to the one record, or a pointer and how many there are."""

    name: str
    dtype: np.dtype[np.void]
    is_const: bool = False
    many: bool = False


class Entry(NamedTuple):
    """A kernel that returns nothing, and its name in C; there it returns a status, 0 if all is well."""

    name: str
    kernel: Any
    arguments: tuple[Argument, ...]
    about: str


_WIRE = Argument("wire", wiring.WIRE, is_const=True)
_WIRE_MEMORY = Argument("wire_memory", wiring.WIRE_MEMORY)
_MEMORY = Argument("memory", cycling.MEMORY)
_FRAME = Argument("frame", wiring.FRAME)

ENTRIES = (
    Entry(
        "pkxyz_cycle",
        cycling.cycle,
        (
            Argument("law", cycling.LAW, is_const=True),
            _MEMORY,
            Argument("reference", REFERENCE, is_const=True, many=True),
        ),
        "One period: reads memory->input, leaves counts for the combs, mode and record in memory->row.",
    ),
    Entry(
        "pkxyz_begin",
        wiring.begin,
        (_WIRE_MEMORY,),
        "Before the first frame, once: nothing has been sent or received.",
    ),
    Entry(
        "pkxyz_judge",
        wiring.judge,
        (_WIRE, _WIRE_MEMORY, _FRAME),
        "The gate. Every frame, before it is sent: frame->reason is 0 if it may be, and then it counts as sent.",
    ),
    Entry(
        "pkxyz_clear",
        wiring.clear,
        (_WIRE_MEMORY,),
        "After a fault was cleared: until then, the first frame that was refused leaves only what is always permitted.",
    ),
    Entry(
        "pkxyz_sync",
        wiring.sync,
        (_WIRE, _WIRE_MEMORY),
        "With each SYNC that goes out: what was sensed before is old.",
    ),
    Entry(
        "pkxyz_receive",
        wiring.receive,
        (_WIRE, _WIRE_MEMORY, Argument("frame", wiring.FRAME, is_const=True)),
        "Each frame that comes: length, counter and CRC of the sense frame are looked at, others are passed over.",
    ),
    Entry(
        "pkxyz_take",
        wiring.take,
        (_WIRE_MEMORY, _MEMORY),
        "Before pkxyz_cycle: sense counts and their status go to memory->input.",
    ),
    Entry(
        "pkxyz_drive",
        wiring.drive,
        (_WIRE, Argument("memory", cycling.MEMORY, is_const=True), _FRAME),
        "After pkxyz_cycle: the drive frame with frame->counter; judge it before it is sent.",
    ),
)
