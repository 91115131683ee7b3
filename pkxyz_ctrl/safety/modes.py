"""The modes of the controller: one table, and nothing but the table decides.

Whoever runs the cycle turns what happened (the node answered, a person asked, a monitor tripped) into an :class:`Event`
and asks :func:`next_mode`. A pair that the table does not name is refused: the mode stays.
"""

from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel


class Mode(IntEnum):
    BOOT = 0
    PRE_OPERATIONAL = 1
    IDLE = 2
    HOMING = 3
    ENABLED = 4
    TRACKING = 5
    FAULT = 6
    LANDING = 7


class Event(IntEnum):
    NONE = 0
    NODE_FOUND = 1
    NODE_READY = 2
    NODE_LOST = 3
    HOME = 4
    HOMED = 5
    ENABLE = 6
    ENABLE_UNHOMED = 7
    TRACK = 8
    HOLD = 9
    DISABLE = 10
    TRIP = 11
    CLEAR = 12
    ENABLE_UNSETTLED = 13
    CLEAR_UNSETTLED = 14
    LAND = 15
    LANDED = 16


EVENT_MEANING: Final[dict[Event, str]] = {
    Event.NONE: "nothing happened",
    Event.NODE_FOUND: "the amplifier node answered its reset with a boot-up message",
    Event.NODE_READY: "the driver has checked and configured the node, and its heartbeat says operational",
    Event.NODE_LOST: "the driver has given the node up, or begins its start-up again",
    Event.HOME: "asked for: measure the sense offsets",
    Event.HOMED: "the sense offsets are averaged and in force",
    Event.ENABLE: "asked for: close the loop, with sense offsets known",
    Event.ENABLE_UNHOMED: "asked for: close the loop, with sense offsets unknown; refused in every mode",
    Event.TRACK: "asked for: follow the reference",
    Event.HOLD: "asked for: stop following, hold the set-point",
    Event.DISABLE: "asked for: lead the stage down, then open the loop, 0 V",
    Event.TRIP: "a monitor or the transmit gate has tripped; combs or sensors can't be trusted",
    Event.CLEAR: "asked for: forget the fault and begin again, after enough cycles at 0 V",
    Event.ENABLE_UNSETTLED: "asked for: close the loop, too few safe cycles after the last; refused in every mode",
    Event.CLEAR_UNSETTLED: "asked for: forget the fault, too few cycles at 0 V after it; refused in every mode",
    Event.LAND: "a monitor or the operator has tripped; combs and sensors can be trusted",
    Event.LANDED: "the time to lead the stage down is over, after a wish to open the loop",
}


class ModeFacts(NamedTuple):
    """What holds while in a mode.

    ``may_energise``: a voltage other than 0 V may go out. ``loop_closed``: what is measured has a part in it.
    ``node_expected``: the node is operational, so every tick owes us a sense frame and a heartbeat is due.
    """

    may_energise: bool
    loop_closed: bool
    node_expected: bool
    meaning: str


MODE_FACTS: Final[dict[Mode, ModeFacts]] = {
    Mode.BOOT: ModeFacts(False, False, False, "nothing is known of the node"),
    Mode.PRE_OPERATIONAL: ModeFacts(False, False, False, "the node was found and is being checked and configured"),
    Mode.IDLE: ModeFacts(False, False, True, "frames flow, 0 V, loop open"),
    Mode.HOMING: ModeFacts(False, False, True, "0 V, the sense offsets are being averaged"),
    Mode.ENABLED: ModeFacts(True, True, True, "loop closed, holding the set-point"),
    Mode.TRACKING: ModeFacts(True, True, True, "loop closed, following the reference"),
    Mode.FAULT: ModeFacts(False, False, False, "0 V, latched with its reason until cleared"),
    Mode.LANDING: ModeFacts(True, False, True, "the stage is led down to rest, for a given time; then 0 V"),
}

# LAND where nothing has to be led down is a trip. How LANDING ends depends on how it began: by TRIP, if by LAND.
# Losing the node at 0 V is an inconvenience: begin again. Losing it under voltage is a fault that a person has to read.
# CLEAR leads to BOOT, not to where it came from: after a fault nothing about the node is taken as known.
TRANSITIONS: Final[dict[tuple[Mode, Event], Mode]] = {
    (Mode.BOOT, Event.NODE_FOUND): Mode.PRE_OPERATIONAL,
    (Mode.BOOT, Event.TRIP): Mode.FAULT,
    (Mode.BOOT, Event.LAND): Mode.FAULT,
    (Mode.PRE_OPERATIONAL, Event.NODE_READY): Mode.IDLE,
    (Mode.PRE_OPERATIONAL, Event.NODE_LOST): Mode.BOOT,
    (Mode.PRE_OPERATIONAL, Event.TRIP): Mode.FAULT,
    (Mode.PRE_OPERATIONAL, Event.LAND): Mode.FAULT,
    (Mode.IDLE, Event.HOME): Mode.HOMING,
    (Mode.IDLE, Event.ENABLE): Mode.ENABLED,
    (Mode.IDLE, Event.NODE_LOST): Mode.BOOT,
    (Mode.IDLE, Event.TRIP): Mode.FAULT,
    (Mode.IDLE, Event.LAND): Mode.FAULT,
    (Mode.HOMING, Event.HOMED): Mode.IDLE,
    (Mode.HOMING, Event.DISABLE): Mode.IDLE,
    (Mode.HOMING, Event.NODE_LOST): Mode.BOOT,
    (Mode.HOMING, Event.TRIP): Mode.FAULT,
    (Mode.HOMING, Event.LAND): Mode.FAULT,
    (Mode.ENABLED, Event.TRACK): Mode.TRACKING,
    (Mode.ENABLED, Event.DISABLE): Mode.LANDING,
    (Mode.ENABLED, Event.LAND): Mode.LANDING,
    (Mode.ENABLED, Event.NODE_LOST): Mode.FAULT,
    (Mode.ENABLED, Event.TRIP): Mode.FAULT,
    (Mode.TRACKING, Event.HOLD): Mode.ENABLED,
    (Mode.TRACKING, Event.DISABLE): Mode.LANDING,
    (Mode.TRACKING, Event.LAND): Mode.LANDING,
    (Mode.TRACKING, Event.NODE_LOST): Mode.FAULT,
    (Mode.TRACKING, Event.TRIP): Mode.FAULT,
    (Mode.LANDING, Event.LANDED): Mode.IDLE,
    (Mode.LANDING, Event.NODE_LOST): Mode.FAULT,
    (Mode.LANDING, Event.TRIP): Mode.FAULT,
    (Mode.FAULT, Event.CLEAR): Mode.BOOT,
}

REFUSED: Final = -1


def _transition_table() -> NDArray[np.int8]:
    table = np.full((len(Mode), len(Event)), REFUSED, dtype=np.int8)
    for (mode, event), target in TRANSITIONS.items():
        table[mode, event] = target
    table.setflags(write=False)
    return table


def _fact_array(facts: list[bool]) -> NDArray[np.int8]:
    array = np.array(facts, dtype=np.int8)
    array.setflags(write=False)
    return array


# (8, 17) int8: the target, or REFUSED. Compiled callers freeze this and the three arrays below as constants.
TRANSITION_TABLE: Final = _transition_table()
# (8,) int8, 0 or 1, by mode.
MAY_ENERGISE: Final = _fact_array([MODE_FACTS[mode].may_energise for mode in Mode])
LOOP_CLOSED: Final = _fact_array([MODE_FACTS[mode].loop_closed for mode in Mode])
NODE_EXPECTED: Final = _fact_array([MODE_FACTS[mode].node_expected for mode in Mode])

_MODE_COUNT = len(Mode)
_EVENT_COUNT = len(Event)
_BOOT = int(Mode.BOOT)
_HOMING = int(Mode.HOMING)
_FAULT = int(Mode.FAULT)
_HOMED = int(Event.HOMED)
_ENABLE = int(Event.ENABLE)
_ENABLE_UNHOMED = int(Event.ENABLE_UNHOMED)
_ENABLE_UNSETTLED = int(Event.ENABLE_UNSETTLED)
_CLEAR = int(Event.CLEAR)
_CLEAR_UNSETTLED = int(Event.CLEAR_UNSETTLED)
_ENOUGH = 1 << 30  # counting further would only overflow


@kernel
def next_mode(mode: int, event: int) -> int:
    """The mode after ``event``. An undefined pair, NONE or an unknown event: the same mode; an unknown mode: FAULT."""
    if mode < 0 or mode >= _MODE_COUNT:
        return _FAULT
    if event < 0 or event >= _EVENT_COUNT:
        return mode
    target = int(TRANSITION_TABLE[mode, event])
    return mode if target < 0 else target


@kernel
def next_safe_cycles(cycles: int, mode: int, is_usable: bool, is_discharged: bool) -> int:
    """Safe cycles in a row, this one included: 0 V commanded, and a usable sense frame where one is owed.

    Entering an active mode and clearing a fault both ask for some of them. So after an active mode was left, however
    it was left, the combs are at 0 V for as many cycles before anything else is done with them.
    """
    is_owed = mode < 0 or mode >= _MODE_COUNT or NODE_EXPECTED[mode] != 0
    if not is_discharged or (is_owed and not is_usable):
        return 0
    return cycles + 1 if cycles < _ENOUGH else cycles


@kernel
def enable_event(homed: bool, settled: bool) -> int:
    """The event that a wish to close the loop amounts to: ENABLE, or one that no mode accepts and that says why.

    ``settled``: there have been enough safe cycles.
    """
    if not homed:
        return _ENABLE_UNHOMED
    return _ENABLE if settled else _ENABLE_UNSETTLED


@kernel
def clear_event(settled: bool) -> int:
    """The event that a wish to clear the fault amounts to: CLEAR, or CLEAR_UNSETTLED, which no mode accepts."""
    return _CLEAR if settled else _CLEAR_UNSETTLED


@kernel
def next_homed(homed: bool, mode: int, event: int) -> bool:
    """Whether the sense offsets are known after ``event`` in ``mode``.

    They become known when homing ends well. They are forgotten in BOOT, since a node that was away, or a fault, may
    have changed what they correct, and in HOMING, which begins with none: broken off, it leaves none.
    """
    target = next_mode(mode, event)
    if target in (_BOOT, _HOMING):
        return False
    return homed or (mode == _HOMING and event == _HOMED)


def refusal(mode: Mode, event: Event) -> str | None:
    """Why ``event`` is refused in ``mode``, for a person; None if the table accepts it (or nothing was asked)."""
    if event == Event.NONE or (mode, event) in TRANSITIONS:
        return None
    if event == Event.ENABLE_UNHOMED:
        return "the sense offsets are not known yet: home first (needs IDLE), then enable"
    if event in (Event.ENABLE_UNSETTLED, Event.CLEAR_UNSETTLED):
        return "the combs have not been at 0 V, with good sense frames, for enough cycles yet: ask again"
    accepting = ", ".join(source.name for source, accepted in TRANSITIONS if accepted == event)
    return f"{event.name} is not possible in {mode.name} ({MODE_FACTS[mode].meaning}); it is in: {accepting}"
