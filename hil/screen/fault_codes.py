"""What clears each fault, and the usual cause of what an amplifier reports: for ``pkxyz explain`` and the site."""

from typing import NamedTuple

from pkxyz_ctrl.can import emergency
from pkxyz_ctrl.safety.trips import EXPLANATIONS

_FRAMES = "good sense frames again; then clear"
_SENSOR = "a plausible, living reading of that comb at 0 V; then clear"
_LAW = "clear starts anew, but it comes again until law or reference is changed"
_NODE = "the amplifier's start-up, which a clear begins anew"
_CHANNEL = "clear starts anew, but it comes again until the channel or the stage file is mended"
CLEARS: dict[str, str] = {
    "SENSE_STALE": _FRAMES,
    "SENSE_SEQUENCE": _FRAMES,
    "SENSE_CRC": _FRAMES,
    "SENSE_LENGTH": _FRAMES,
    "SENSE_RANGE": _SENSOR,
    "SENSE_FROZEN": _SENSOR,
    "INNOVATION": "clear, once the shock is over",
    "SATURATION": _LAW,
    "SLEW": _LAW,
    "OVERRUN": "clear, once the machine keeps up",
    "SOLVER": _LAW,
    "NOT_FINITE": _LAW,
    "HEARTBEAT_LOST": _NODE,
    "NODE_NOT_OPERATIONAL": _NODE,
    "NODE_REBOOTED": _NODE,
    "NODE_EMERGENCY": "the amplifier's own end of the error (EMCY 0x0000); then clear",
    "GATE_BLOCKED": "clear, once the frames on the bus are what they should be",
    "OPERATOR": "clear",
    "COMB_MISFIT": _CHANNEL,
    "COMB_FORCE": _CHANNEL,
    "FOREIGN_FRAME": "clear, once the other sender is off the bus",
    "SAFETY_OBJECTS": "clear: they are written and read back anew",
}
"""What ends a fault, by its name without the number of a comb or the axis."""

EMERGENCY_CAUSES: dict[int, tuple[str, str]] = {
    0x8110: ("frames come faster than the amplifier takes them", "fewer frames, or a longer period"),
    0x8120: ("termination, bit rate or a broken plug", "mending the wiring"),
    0x8130: ("the controller died, was stopped, or its heartbeat is later than 0x1016 allows", "a start-up"),
    0x8140: ("the wiring was open or shorted for a while", "by itself"),
    0x8150: ("two devices with one node id", "another id for one of them"),
    0x8210: ("a mapping (0x1601) that is not the controller's", "a start-up, which writes the mapping"),
    0x8220: ("a mapping (0x1601) that is not the controller's", "a start-up, which writes the mapping"),
    0x8230: ("a frame that this program does not send", "finding its sender"),
    0x8240: ("another master sends SYNC, or SYNCs came out of step", "one master only; then a start-up"),
    0x8250: ("the controller stopped, or its frames were lost", "drive PDOs again"),
    emergency.PROTECTION_CRC: ("damage on the way, or protection configured differently", "the next good drive PDO"),
    emergency.PROTECTION_COUNTER: ("a frame was lost, doubled or sent by somebody else", "the second good drive PDO"),
    emergency.PROTECTION_LATE: ("the controller's machine was late", "the next drive PDO that is in time"),
    emergency.PROTECTION_STEP: ("frames were lost, or another sends drive PDOs", "a drive PDO within the step"),
}
"""Usual cause, and what ends it, of the codes that the software can say something about."""


class Explained(NamedTuple):
    """A code, in words."""

    name: str
    happened: str
    cause: str
    clears: str


def stem(name: str) -> str:
    """The name of a trip without the number of a comb or the axis."""
    head, _, last = name.rpartition("_")
    return head if last in ("1", "2", "3", "X", "Y", "Z") else name


def trips() -> dict[str, Explained]:
    """Every fault code by name."""
    named = {trip.name or "": words for trip, words in EXPLANATIONS.items()}
    return {name: Explained(name, happened, check, CLEARS[stem(name)]) for name, (happened, check) in named.items()}


def emergency_of(code: int) -> Explained:
    """An emergency code, 0 to 0xFFFF: what is said of it alone, else of its class."""
    cause, ends = EMERGENCY_CAUSES.get(code, (emergency.code_remedy(code), "an EMCY 0x0000 of the amplifier"))
    return Explained(f"0x{code:04X}", emergency.code_text(code), cause, ends)


def explained(code: str) -> list[Explained]:
    """What is known of a code as the screen writes it: SENSE_STALE, COMB_FORCE_2 or COMB_FORCE, 0x8130. Else none."""
    name, known = code.upper(), trips()
    if name in known:
        return [known[name]]
    if name.startswith("0X"):
        try:
            number = int(name, 16)
        except ValueError:
            return []
        return [emergency_of(number)] if number <= 0xFFFF else []
    return [words for trip, words in known.items() if stem(trip) == name]
