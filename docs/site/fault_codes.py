"""The tables of fault and emergency codes for the troubleshooting page: text, what to check, what clears it."""

from pkxyz_ctrl.can import emergency
from pkxyz_ctrl.safety.trips import EXPLANATIONS, LANDS, STOPS, Trip

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
}
"""Usual cause, and what ends it, of the codes that the software can say something about."""


def stem(trip: Trip) -> str:
    """The name without the number of a comb or the axis."""
    head, _, last = (trip.name or "").rpartition("_")
    return head if last in ("1", "2", "3", "X", "Y", "Z") else trip.name or ""


def trips_table() -> str:
    """Every fault code with an anchor of its name."""
    lines = [
        "| code | what a person reads | usual cause, what to check | what clears it |",
        "| --- | --- | --- | --- |",
    ]
    for trip, (happened, check) in EXPLANATIONS.items():
        name = trip.name or ""
        lines.append(f'| <a id="{name.lower()}"></a>{name} | {happened} | {check} | {CLEARS[stem(trip)]} |')
    return "\n".join(lines)


def stops_table() -> str:
    """How each fault stops, and why; faults with one reason in a line."""
    lines = ["| fault | combs | why |", "| --- | --- | --- |"]
    lands = {stem(trip) for trip in Trip if trip & LANDS}
    for name, why in sorted(STOPS.items(), key=lambda item: item[0] not in lands):
        lines.append(f"| {name} | {'led down, then 0 V' if name in lands else '0 V at once'} | {why} |")
    return "\n".join(lines)


def emergencies_table() -> str:
    """Every emergency code that has a text of its own, then the classes."""
    lines = ["| code | meaning | usual cause | what ends it |", "| --- | --- | --- | --- |"]
    for code, text in emergency._EXACT.items():
        cause, ends = EMERGENCY_CAUSES.get(code, ("see the text", "the next good drive PDO"))
        lines.append(f'| <a id="{code:04x}"></a>0x{code:04X} | {text} | {cause} | {ends} |')
    for high, text in emergency._CLASS.items():
        lines.append(f"| 0x{high:02X}xx | {text} | the amplifier's manual | an EMCY 0x0000 |")
    return "\n".join(lines)
