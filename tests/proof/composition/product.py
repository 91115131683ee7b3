"""The composition, compiled: two sides known by rows of what they do, any wire, anybody who operates.

`World` is where it is: the number of each side's state, the frames that are on their way, and what must never last too
long. It does in one tick what ``loop.runtime`` does, and stops wherever something is not decided by the code: there
`options` tells what may happen, and `take` lets one of them happen. What a side does is looked up in the rows; where
there is none yet, ``MISSING`` says so, and everything is done again once there is.
"""

from typing import Final, NamedTuple

import numpy as np
from kept import kernel
from numpy.typing import NDArray

Array = NDArray[np.int64]

# what a side is asked
BEGIN: Final = 0
FINISH: Final = 1
WAIT: Final = 2  # in the start-up: nothing came
COMPUTE: Final = 16  # + SKIPS * wish + ticks that were skipped
SKIPS: Final = 8
PASS: Final = 1 << 12  # + microseconds that pass
RUN: Final = PASS  # the same for the node, which acts in them
FRAME: Final = 1 << 16  # + a frame that comes
DIALOGUE: Final = 1 << 15  # more: it comes in the start-up
SHIFT: Final = 1 << 17  # + how much further the other side's counters are

# what it says
FRESH: Final = 1
DONE: Final = 2
FAILED: Final = 4
CLOSES: Final = 8  # the loop is closed from now on
QUIET: Final = 16  # 0 V with this tick's sense values there

# where the composition is in a tick
START, BEFORE, SYNCED, SENSED, AFTER, READ, COMPUTING, FINISHING, REST, ENDED = range(10)

# what may happen, in the high byte; the low one says which
DELIVER, LATE, REPEAT, DAMAGE, LOSE, VANISH, GO, SKIP, CUT, MEND, RELEASE, TICK = range(12)

MISSING: Final = -1
VIOLATED: Final = -2
FULL: Final = -3

# what never may be
STARTED_WITH_VOLTAGE, CLOSED_TOO_SOON, LANDING_FOR_EVER, TOO_LATE_AT_0_V, APART_TOO_LONG, NO_ROOM = range(1000, 1006)
TOO_LATE_LOW, UNSIGNED_TOO_LONG = range(1006, 1008)

CONTROLLER: Final = 0
NODE: Final = 1
FRAMES: Final = 2
WIRE_MOST: Final = 16
HELD_MOST: Final = 4

WORLD = np.dtype(
    [
        ("wire", "u2", (WIRE_MOST,)),
        ("received", "u2", (WIRE_MOST,)),  # by the controller's port, not read yet
        ("held", "u2", (HELD_MOST,)),
        ("left", "u1", (HELD_MOST,)),  # ticks, for which they may be held
        ("on_wire", "u1"),
        ("in_port", "u1"),
        ("are_held", "u1"),
        ("room", "u1"),
        ("controller", "i4"),
        ("node", "i4"),
        ("age_us", "i4"),  # of the tick
        ("ticks", "i4"),
        ("violation", "i4"),
        ("phase", "i1"),
        ("faults_left", "i1"),
        ("skipped", "i1"),
        ("since_decision", "i1"),  # ticks since combs were to go to 0 V, while they are not there
        ("quiet", "i1"),  # ticks in a row with 0 V commanded and this tick's sense values there
        ("apart", "i1"),  # ticks since the combs hold something else than what the gate takes them to hold
        ("believed", "i1"),  # by the gate, before its last frame
        ("cut", "i1"),  # what no longer gets through
        ("landing", "i1"),  # ticks in a row in which the stage was led down
        ("high", "i1"),  # ticks since digital outputs were to go low, while one is not
        ("unsigned", "i1"),  # ticks with a closed loop since a right signature came, where one is waited for
    ],
    align=True,
)
IN_FLIGHT: Final = 10  # words of it, which hold the frames

CONTROLLER_LABEL = np.dtype(
    [
        ("mode", "i1"), ("driver", "i1"), ("may_energise", "i1"), ("believes", "i1"), ("counts", "i2"),
        ("choice", "i2"), ("is_landmark", "i1"), ("is_starting", "i1"), ("may_put_out", "i1"),
        ("goes_by_signature", "i1"),
    ],
    align=True,
)  # fmt: skip
NODE_LABEL = np.dtype([("counts", "i4"), ("next_us", "i4"), ("bits", "i4")], align=True)
FRAME_LABEL = np.dtype(
    [
        ("from_us", "i4"), ("counted", "i4"), ("is_request", "i4"), ("is_signature", "i4"), ("cuts", "i4"),
        ("damages", "i4"), ("damaged", "i4", (4,)),
    ],
    align=True,
)  # fmt: skip
RULES = np.dtype(
    [
        ("late", "i4"), ("repeat", "i4"), ("damage", "i4"), ("lose", "i4"), ("skip", "i4"), ("cut", "i4"),
        ("late_ticks", "i4"), ("settle_ticks", "i4"), ("agree_ticks", "i4"), ("landing_ticks", "i4"),
        ("settled", "i4"), ("period_us", "i4"), ("poll_us", "i4"), ("turnaround_us", "i4"),
        ("mode_landing", "i4"), ("mode_enabled", "i4"), ("longest", "i4"), ("longest_apart", "i4"),
        ("unsigned_ticks", "i4"), ("longest_high", "i4"), ("longest_unsigned", "i4"),
    ],
    align=True,
)  # fmt: skip
OPTIONS_MOST: Final = 64
DRIVE_COUNTED, SYNC_COUNTED, SENSE_COUNTED = 1, 2, 3
_SYNCS: Final = 240


SENT_MOST: Final = 7
ANSWER = np.dtype(
    [
        ("key", "i8"),  # side, state and what was asked; -1: free
        ("to", "i4"),
        ("told", "i2"),
        ("drive", "u1"),  # how much further its counters are
        ("sync", "u1"),
        ("sense", "u1"),
        ("sent", "u1"),  # how many frames
        ("frames", "u2", (SENT_MOST,)),
    ],
    align=True,
)
assert ANSWER.itemsize == 32  # two in a line of the cache: one miss for all that is read of it


class Rows(NamedTuple):
    """What the sides do, as far as anybody asked, and what is known of their states and frames."""

    answers: NDArray[np.void]  # hash table
    controllers: NDArray[np.void]
    nodes: NDArray[np.void]
    frame_labels: NDArray[np.void]
    choices: NDArray[np.int16]  # (n, 1 + wishes)
    rules: NDArray[np.void]
    missing: Array  # (3,) side, state, asked
    asked: Array  # (n, 3) side, state, asked: the last ones, where somebody looks
    looks: Array  # (2,) whether somebody does, and how many there were


@kernel
def key_of(side: int, state: int, asked: int) -> int:
    return side << 58 | state << 20 | asked


@kernel
def place_of(answers: NDArray[np.void], key: int) -> int:
    """Where the answer with a key stands, or is to stand."""
    mask = len(answers) - 1
    at = (key * 0x9E3779B97F4A7C1 >> 17) & mask
    while answers[at]["key"] != key and answers[at]["key"] != -1:
        at = at + 1 & mask
    return at


@kernel
def refill(answers: NDArray[np.void], were: NDArray[np.void]) -> None:
    """A larger hash table for the same answers."""
    for row in range(len(were)):
        if were[row]["key"] != -1:
            answers[place_of(answers, were[row]["key"])] = were[row]


@kernel
def row_of(r: Rows, side: int, state: int, asked: int) -> int:
    """Where the answer stands, or MISSING."""
    key = key_of(side, state, asked)
    at = place_of(r.answers, key)
    if r.answers[at]["key"] != key:
        r.missing[0], r.missing[1], r.missing[2] = side, state, asked
        return MISSING
    if r.looks[0] != 0:
        last = r.asked[r.looks[1] % len(r.asked)]
        last[0], last[1], last[2] = side, state, asked
        r.looks[1] += 1
    return at


# -- what the sides do --------------------------------------------------------------------------------------------


@kernel
def controller_does(w: np.void, r: Rows, asked: int) -> int:
    """The bits that it says, or something below 0."""
    row = row_of(r, CONTROLLER, w["controller"], asked)
    if row < 0:
        return MISSING
    answer = r.answers[row]
    w["controller"] = answer["to"]
    drive, sync = np.int64(answer["drive"]), np.int64(answer["sync"])
    if drive != 0 or sync != 0:
        other = row_of(r, NODE, w["node"], SHIFT + drive * _SYNCS + sync)
        if other < 0:
            return MISSING
        w["node"] = r.answers[other]["to"]
        if not _shift(w, r, drive, sync, 0):
            return MISSING
    return _said(w, answer)


@kernel
def node_does(w: np.void, r: Rows, asked: int) -> int:
    row = row_of(r, NODE, w["node"], asked)
    if row < 0:
        return MISSING
    answer = r.answers[row]
    w["node"] = answer["to"]
    sense = np.int64(answer["sense"])
    if sense != 0:
        other = row_of(r, CONTROLLER, w["controller"], SHIFT + sense)
        if other < 0:
            return MISSING
        w["controller"] = r.answers[other]["to"]
        if not _shift(w, r, 0, 0, sense):
            return MISSING
    return _said(w, answer)


@kernel
def _said(w: np.void, answer: np.void) -> int:
    told = np.int64(answer["told"])
    if told < 0:
        w["violation"] = -told
        return VIOLATED
    for place in range(answer["sent"]):
        if w["on_wire"] == WIRE_MOST:
            w["violation"] = NO_ROOM
            return VIOLATED
        w["wire"][w["on_wire"]] = answer["frames"][place]
        w["on_wire"] += 1
    return told


@kernel
def _shift(w: np.void, r: Rows, drive: int, sync: int, sense: int) -> bool:
    """What is on its way was counted from where the counters were."""
    return (
        _shift_each(r, w["wire"], w["on_wire"], drive, sync, sense)
        and _shift_each(r, w["received"], w["in_port"], drive, sync, sense)
        and _shift_each(r, w["held"], w["are_held"], drive, sync, sense)
    )


@kernel
def _shift_each(r: Rows, frames: NDArray[np.uint16], count: int, drive: int, sync: int, sense: int) -> bool:
    for place in range(count):
        counted, further = r.frame_labels[frames[place]]["counted"], 0
        if counted == DRIVE_COUNTED:
            further = drive
        elif counted == SYNC_COUNTED:
            further = sync
        elif counted == SENSE_COUNTED:
            further = sense
        if further != 0:
            row = row_of(r, FRAMES, frames[place], further)
            if row < 0:
                return False
            frames[place] = r.answers[row]["to"]
    return True


@kernel
def pass_us(w: np.void, r: Rows, time_us: int) -> int:
    """Time passes on both sides; the node acts in it."""
    told = node_does(w, r, RUN + time_us)
    if told >= 0 and time_us > 0:
        told = controller_does(w, r, PASS + time_us)
    if w["phase"] != START:
        w["age_us"] += time_us
    return told


@kernel
def _first(frames: NDArray[np.uint16], count: int, place: int) -> int:
    """Take one out."""
    frame = frames[place]
    for later in range(place + 1, count):
        frames[later - 1] = frames[later]
    frames[count - 1] = 0
    return int(frame)


@kernel
def off_wire(w: np.void) -> int:
    frame = _first(w["wire"], w["on_wire"], 0)
    w["on_wire"] -= 1
    return frame


@kernel
def off_port(w: np.void) -> int:
    frame = _first(w["received"], w["in_port"], 0)
    w["in_port"] -= 1
    return frame


@kernel
def deliver(w: np.void, r: Rows, frame: int) -> int:
    if r.frame_labels[frame]["from_us"] != 0:
        return node_does(w, r, FRAME + frame)
    if w["in_port"] == WIRE_MOST:
        w["violation"] = NO_ROOM
        return VIOLATED
    w["received"][w["in_port"]] = frame
    w["in_port"] += 1
    return 0


@kernel
def hold(w: np.void, r: Rows, frame: int) -> None:
    w["held"][w["are_held"]], w["left"][w["are_held"]] = frame, r.rules[0]["late_ticks"]
    w["are_held"] += 1


@kernel
def let_go(w: np.void, place: int) -> int:
    for later in range(place + 1, w["are_held"]):
        w["left"][later - 1] = w["left"][later]
    w["left"][w["are_held"] - 1] = 0
    frame = _first(w["held"], w["are_held"], place)
    w["are_held"] -= 1
    return frame
