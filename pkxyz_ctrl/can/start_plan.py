"""What the start-up asks and writes, compiled: a table of what has to hold, and what follows from what was found.

The table is made in ``startup``, which also has the words.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.can import cob_id
from pkxyz_ctrl.compiled.kernel import kernel

ROWS_MOST: Final = 45
STEPS_MOST: Final = 85

# what a row is about; from COB_ID to COUNT one process PDO, in this order
IDENTITY, TOLD, COB_ID, KIND, ENTRY, COUNT, OTHER = range(7)
# what a step does with its row: compare, or read whatever it is; write it, or something else on the way to it
IDENTIFY, ASK, READ_BACK, WRITE, COMPLETE, ON, OFF, CLEAR = range(8)
# what was found: nothing yet, a value, or that there is no such object
UNKNOWN, VALUE, ABSENT = range(3)

# flags of a row: not compared; what is there is taken where it can't be written; of the digital outputs; of the
# read-back at work; read once more at the end
ANY, MAY_DIFFER, OUTPUTS, READ_BACK_AT_WORK, AT_LAST = 1, 2, 4, 8, 16
_GROUPS: Final = OUTPUTS | READ_BACK_AT_WORK  # which a node may lack, and is not driven by

# lines of a report that stand in for an object
SHOWN_HEARTBEAT_LOST, SHOWN_LEAVING, SHOWN_DRIVE_TIMEOUT = 1, 2, 4

ROW = np.dtype(
    [
        ("value", "u4"),
        ("alike", "u4"),  # bits in which it may differ
        ("index", "u2"),
        ("subindex", "u1"),
        ("size", "u1"),  # bytes
        ("part", "u1"),  # IDENTITY to OTHER
        ("flags", "u1"),  # ANY, MAY_DIFFER
    ],
    align=True,
)

START = np.dtype(
    [
        ("rows", ROW, (ROWS_MOST,)),  # first identity, revision and serial number, then what has to hold
        ("order", "u1", (ROWS_MOST,)),  # of those that are signed, by index and sub-index
        ("signed", "i4"),  # how many these are
        ("signature_row", "i4"),  # which says the node's own signature; -1: none
        ("count", "i4"),  # of the rows
        ("protection", "i4"),
        ("proven", "u4", (4,)),  # vendor, product, revision and serial number that a report is about
        ("shown", "i4"),  # bits of what it shows; 0: there is none
        ("retries", "i4"),
        ("boot_timeout_us", "i8"),
        ("start_timeout_us", "i8"),
        ("sdo_timeout_us", "i8"),
        ("trial_us", "i8"),
    ],
    align=True,
)

START_MEMORY = np.dtype(
    [
        ("deadline_us", "i8"),  # of boot-up, start or trial
        ("answer_due_us", "i8"),
        ("found", "u4", (ROWS_MOST,)),
        ("tried_identity", "u4", (4,)),  # of the node that was tried last
        ("reply", "u4"),  # what was answered when it failed
        ("known", "u1", (ROWS_MOST,)),  # what ``found`` is
        ("row", "u1", (STEPS_MOST,)),
        ("act", "u1", (STEPS_MOST,)),
        ("steps", "i4"),
        ("position", "i4"),  # of the open step
        ("tries", "i4"),  # so often it was asked
        ("is_planned", "i4"),  # 1: the steps are those of the plan, not the survey before it
        ("is_surveyed", "i4"),  # 1: what the node holds was read since the start
        ("repeats_left", "i4"),
        ("never_booted", "i4"),  # 1: it was asked without its boot-up message
        ("is_tried", "i4"),
        ("has_tried", "i4"),  # 1: ``tried_identity`` is one
        ("times_left", "i4"),  # heartbeats in a row that said that it left
        ("cause", "i4"),  # why the start-up failed
        ("cause_row", "i4"),
        ("reply_size", "i4"),
    ],
    align=True,
)

_INVALID: Final = cob_id.COB_ID_INVALID
_VENDOR: Final = 1  # row of 0x1018:1; the other parts of the identity follow
_SYNC_ID, _SYNC_COUNTER, _ERROR_BEHAVIOUR, _CONSUMER = 0x1005, 0x1019, 0x1029, 0x1016
_ERROR_MODE, _ERROR_VALUE = 0x6443, 0x6444
_BOTH: Final = SHOWN_HEARTBEAT_LOST | SHOWN_LEAVING
_ALONE: Final = SHOWN_HEARTBEAT_LOST | SHOWN_DRIVE_TIMEOUT


@kernel
def value_of(row: np.void, act: int) -> int:
    """What a step writes, or has to read."""
    if act == CLEAR:
        return 0
    return int(row["value"]) | _INVALID if act == OFF else int(row["value"])


@kernel
def identify(start: np.void, memory: np.void) -> None:
    """Steps that ask who it is; what was found before is forgotten."""
    memory["steps"] = memory["is_planned"] = 0
    for place in range(start["count"]):
        memory["known"][place] = UNKNOWN
        if start["rows"][place]["part"] == IDENTITY:
            _add(memory, place, IDENTIFY)


@kernel
def survey(start: np.void, memory: np.void) -> None:
    """Steps that ask what it holds, and whether that is there at all."""
    memory["steps"] = 0
    for place in range(start["count"]):
        if start["rows"][place]["part"] != IDENTITY:
            _add(memory, place, ASK)


@kernel
def plan(start: np.void, memory: np.void) -> int:
    """Steps for a node that holds what was found: writes, then the read-back of everything that has to hold, also of
    what stood already, since one answer that was damaged must not pass for a value that is there. Returns the row
    without which it must not be started, -1 if it may.
    """
    memory["steps"], memory["is_planned"], memory["is_surveyed"] = 0, 1, 1
    refused = lacks(start, memory)
    if refused >= 0:
        return refused
    rows, count = start["rows"], start["count"]
    for place in range(count):
        if rows[place]["part"] == COB_ID and _is_wanted(start, memory, place):
            _map(start, memory, place)
    for place in range(count):
        if rows[place]["part"] == OTHER and not stands(start, memory, place) and not _is_absent(start, memory, place):
            _add(memory, place, WRITE)
    for place in range(count):
        is_off = rows[place]["part"] == COB_ID and not _is_as_wanted(start, memory, place)
        if is_off and _is_wanted(start, memory, place):
            _add(memory, place, ON)
    for place in range(count):
        if rows[place]["part"] >= COB_ID and not _is_absent(start, memory, place):
            _add(memory, place, ASK if rows[place]["flags"] & MAY_DIFFER else READ_BACK)
    for place in range(count):
        if rows[place]["flags"] & AT_LAST and memory["known"][place] != ABSENT:
            _add(memory, place, ASK)
    return -1


@kernel
def is_proven(start: np.void, memory: np.void) -> bool:
    """Whether a report on this very module shows that its combs go to 0 V without us."""
    return shown(start, memory) & _ALONE != 0


@kernel
def shown(start: np.void, memory: np.void) -> int:
    """Bits of what a report shows of the module that was found."""
    return int(start["shown"]) if has_identity(memory, start["proven"]) else 0


@kernel
def is_known(memory: np.void) -> bool:
    """Whether it is the node that was tried last."""
    return memory["has_tried"] != 0 and has_identity(memory, memory["tried_identity"])


@kernel
def remember_tried(memory: np.void) -> None:
    """The node that was found has shown what it does without us; one that does not tell who it is stays unknown."""
    memory["has_tried"] = 1
    for part in range(4):
        memory["tried_identity"][part] = memory["found"][_VENDOR + part]
        if memory["known"][_VENDOR + part] != VALUE:
            memory["has_tried"] = 0


@kernel
def has_identity(memory: np.void, identity: NDArray[np.uint32]) -> bool:
    """Whether the node that was found says that it is this one."""
    for part in range(4):
        if memory["known"][_VENDOR + part] != VALUE or memory["found"][_VENDOR + part] != identity[part]:
            return False
    return True


@kernel
def _add(memory: np.void, row: int, act: int) -> None:
    place = memory["steps"]
    if place < STEPS_MOST:
        memory["row"][place], memory["act"][place] = row, act
        memory["steps"] = place + 1


@kernel
def stands(start: np.void, memory: np.void, place: int) -> bool:
    """Whether the node holds it already."""
    row, found = start["rows"][place], memory["found"][place]
    return memory["known"][place] == VALUE and (found ^ row["value"]) & ~row["alike"] == 0


@kernel
def _is_absent(start: np.void, memory: np.void, place: int) -> bool:
    """Whether the node lacks the object of this row, or a part of it."""
    index = start["rows"][place]["index"]
    for other in range(start["count"]):
        row = start["rows"][other]
        if row["part"] >= COB_ID and row["index"] == index and memory["known"][other] == ABSENT:
            return True
    return False


@kernel
def has_group(start: np.void, memory: np.void, group: int) -> bool:
    """Whether all rows of a group, OUTPUTS or READ_BACK_AT_WORK, are there and stand, as was read last; False where
    there are none.
    """
    asked = 0
    for place in range(start["count"]):
        if start["rows"][place]["flags"] & group:
            asked = 1
            is_there = memory["known"][place] == VALUE
            if not is_there or (start["rows"][place]["part"] >= COB_ID and not stands(start, memory, place)):
                return False
    return asked != 0


@kernel
def _is_wanted(start: np.void, memory: np.void, place: int) -> bool:
    """Whether a PDO is to be mapped: that of a group only on a node that has all of it."""
    group = start["rows"][place]["flags"] & _GROUPS
    for other in range(start["count"]):
        if start["rows"][other]["flags"] & group and memory["known"][other] == ABSENT:
            return False
    return True


@kernel
def signature(start: np.void, memory: np.void) -> int:
    """CRC-16 (polynomial 0x1021, from 0xFFFF) over what the node was found to hold of all that keeps the combs safe:
    index, sub-index and value, little endian, in their order.
    """
    crc = 0xFFFF
    for n in range(start["signed"]):
        place = start["order"][n]
        if memory["known"][place] == VALUE:
            row = start["rows"][place]
            crc = _crc16(crc, int(row["index"]) | int(row["subindex"]) << 16, 3)
            crc = _crc16(crc, int(memory["found"][place]), int(row["size"]))
    return crc


@kernel
def is_signed(start: np.void, memory: np.void) -> bool:
    """Whether the node can tell its signature at work, and signs what we do."""
    if not has_group(start, memory, READ_BACK_AT_WORK):
        return False
    return bool(memory["found"][start["signature_row"]] == signature(start, memory))


@kernel
def _crc16(crc: int, value: int, size: int) -> int:
    for byte in range(size):
        crc ^= (value >> 8 * byte & 0xFF) << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021) & 0xFFFF if crc & 0x8000 else crc << 1
    return crc


@kernel
def lacks(start: np.void, memory: np.void) -> int:
    """Of what is lacking and has nothing to stand in for it, the first by index; -1 if there is none."""
    refused, lowest = -1, 0x10000
    for place in range(start["count"]):
        row = start["rows"][place]
        is_lacking = row["part"] >= COB_ID and row["flags"] & _GROUPS == 0 and memory["known"][place] == ABSENT
        if is_lacking and row["index"] < lowest and not _is_dispensable(start, memory, row["index"]):
            refused, lowest = place, row["index"]
    return refused


@kernel
def _is_dispensable(start: np.void, memory: np.void, index: int) -> bool:
    """Whether a node may be started without this object."""
    if index in (_ERROR_MODE, _ERROR_VALUE):
        return shown(start, memory) & _BOTH == _BOTH
    if index == _CONSUMER:
        return start["protection"] != 0 and shown(start, memory) & SHOWN_DRIVE_TIMEOUT != 0
    return index in (_SYNC_ID, _SYNC_COUNTER, _ERROR_BEHAVIOUR)


@kernel
def _is_mapped(start: np.void, memory: np.void, place: int) -> bool:
    """Whether entries and their number stand, of the PDO whose COB-ID is in row ``place``."""
    place += 2
    while start["rows"][place]["part"] == ENTRY:
        if not stands(start, memory, place):
            return False
        place += 1
    return stands(start, memory, place)


@kernel
def _is_as_wanted(start: np.void, memory: np.void, place: int) -> bool:
    return _is_mapped(start, memory, place) and stands(start, memory, place)


@kernel
def _map(start: np.void, memory: np.void, place: int) -> None:
    """CiA 301, 7.5.2.36: PDO off, mapping empty, entries, number of entries; it goes on once all else is written. A PDO
    whose mapping stands is left alone.
    """
    is_as_wanted = _is_as_wanted(start, memory, place)
    if not is_as_wanted:
        _add(memory, place, OFF)
    if not stands(start, memory, place + 1):
        _add(memory, place + 1, WRITE)
    if is_as_wanted or _is_mapped(start, memory, place):
        return
    end = place + 2
    while start["rows"][end]["part"] == ENTRY:
        end += 1
    _add(memory, end, CLEAR)
    for entry in range(place + 2, end):
        _add(memory, entry, WRITE)
    _add(memory, end, COMPLETE)
