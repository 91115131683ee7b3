"""Why the combs went to 0 V, and how: the bits of a trip, and what a person reads."""

from enum import IntFlag
from typing import Final


class Trip(IntFlag):
    """Reasons to go to FAULT. Those with a number or an axis are three neighbouring bits, FIRST << i is the i-th."""

    SENSE_STALE = 1 << 0
    SENSE_SEQUENCE = 1 << 1
    SENSE_CRC = 1 << 2
    SENSE_LENGTH = 1 << 3
    SENSE_RANGE_1 = 1 << 4
    SENSE_RANGE_2 = 1 << 5
    SENSE_RANGE_3 = 1 << 6
    SENSE_FROZEN_1 = 1 << 7
    SENSE_FROZEN_2 = 1 << 8
    SENSE_FROZEN_3 = 1 << 9
    INNOVATION_X = 1 << 10
    INNOVATION_Y = 1 << 11
    INNOVATION_Z = 1 << 12
    SATURATION = 1 << 13
    SLEW = 1 << 14
    OVERRUN = 1 << 15
    SOLVER = 1 << 16
    NOT_FINITE = 1 << 17
    HEARTBEAT_LOST = 1 << 18
    NODE_NOT_OPERATIONAL = 1 << 19
    NODE_REBOOTED = 1 << 20
    NODE_EMERGENCY = 1 << 21
    # Raised by the caller, here so that one mask and one explanation serve all.
    GATE_BLOCKED = 1 << 22
    OPERATOR = 1 << 23
    COMB_MISFIT_1 = 1 << 24
    COMB_MISFIT_2 = 1 << 25
    COMB_MISFIT_3 = 1 << 26
    COMB_FORCE_1 = 1 << 27
    COMB_FORCE_2 = 1 << 28
    COMB_FORCE_3 = 1 << 29
    FOREIGN_FRAME = 1 << 30
    SAFETY_OBJECTS = 1 << 31


LANDS: Final = Trip.SATURATION | Trip.OVERRUN | Trip.SOLVER | Trip.OPERATOR
"""After these, combs, sensors and bus do what they did before: the stage is led down. After all others 0 V at once."""

STOPS: Final[dict[str, str]] = {
    "SENSE_STALE": "who doesn't hear the node doesn't know whether it hears",
    "SENSE_SEQUENCE": "two may be speaking, and nobody knows which is the node",
    "SENSE_CRC": "what damages sense frames damages drive frames",
    "SENSE_LENGTH": "the node isn't configured as was checked",
    "SENSE_RANGE": "a sensor fails, or the stage is against a stop",
    "SENSE_FROZEN": "a sensor fails",
    "INNOVATION": "the stage isn't where the model has it: touched, or snapped",
    "SATURATION": "combs and sensors obey; the reference asks too much",
    "SLEW": "the program does what it can't: its path down is not trusted either",
    "OVERRUN": "combs and sensors obey; only the computer is late. Once more while landing: 0 V",
    "SOLVER": "combs and sensors obey; the path down needs no optimiser",
    "NOT_FINITE": "nothing that is computed is trusted",
    "HEARTBEAT_LOST": "the node may be gone",
    "NODE_NOT_OPERATIONAL": "the node has left its outputs at 0 V already",
    "NODE_REBOOTED": "the node's outputs are at 0 V already",
    "NODE_EMERGENCY": "the amplifier says itself that it fails",
    "GATE_BLOCKED": "the program sent what it must not",
    "OPERATOR": "nothing is wrong",
    "COMB_MISFIT": "a comb or its sensor doesn't obey",
    "COMB_FORCE": "a comb doesn't give the force of its voltage",
    "FOREIGN_FRAME": "somebody else may drive the combs",
    "SAFETY_OBJECTS": "the node may not go to 0 V by itself any longer",
}
"""Why the stage is led down, or not, by the name of a trip without the number of a comb or the axis."""


# What happened, in terms of the instrument; then what to look at, most likely first.
EXPLANATIONS: Final[dict[Trip, tuple[str, str]]] = {
    Trip.SENSE_STALE: (
        "no usable position measurement arrived for several periods",
        "check the node's supply and the bus plug and termination, then whether something else fills the bus",
    ),
    Trip.SENSE_SEQUENCE: (
        "too many position measurements were lost, repeated or out of order",
        "check the bus load and wiring, and that only one device uses this node id",
    ),
    Trip.SENSE_CRC: (
        "position measurements arrived damaged, although the bus itself saw no error",
        "check that controller and node agree on protection (CRC and counter), then suspect the sense electronics",
    ),
    Trip.SENSE_LENGTH: (
        "position measurements arrived with the wrong length",
        "check the node's mapping (0x1A01), and that no other device sends with its identifier",
    ),
    Trip.SENSE_RANGE_1: (
        "sense comb 1 reads a stroke that the stage cannot have",
        "check its cable and preamplifier, and the scale and offset of the bus file; the stage may be against a stop",
    ),
    Trip.SENSE_RANGE_2: (
        "sense comb 2 reads a stroke that the stage cannot have",
        "check its cable and preamplifier, and the scale and offset of the bus file; the stage may be against a stop",
    ),
    Trip.SENSE_RANGE_3: (
        "sense comb 3 reads a stroke that the stage cannot have",
        "check its cable and preamplifier, and the scale and offset of the bus file; the stage may be against a stop",
    ),
    Trip.SENSE_FROZEN_1: (
        "sense comb 1 repeats one value to the last digit, without noise",
        "its converter has stopped or its input is disconnected; restart the node, then check the cable",
    ),
    Trip.SENSE_FROZEN_2: (
        "sense comb 2 repeats one value to the last digit, without noise",
        "its converter has stopped or its input is disconnected; restart the node, then check the cable",
    ),
    Trip.SENSE_FROZEN_3: (
        "sense comb 3 repeats one value to the last digit, without noise",
        "its converter has stopped or its input is disconnected; restart the node, then check the cable",
    ),
    Trip.INNOVATION_X: (
        "the stage moved along x in a way that the voltages do not explain",
        "look for a shock, a touched sample or a comb that snapped; then compare the stage file with the device",
    ),
    Trip.INNOVATION_Y: (
        "the stage moved along y in a way that the voltages do not explain",
        "look for a shock, a touched sample or a comb that snapped; then compare the stage file with the device",
    ),
    Trip.INNOVATION_Z: (
        "the stage moved along z in a way that the voltages do not explain",
        "look for a shock, a touched sample or a comb that snapped; then compare the stage file with the device",
    ),
    Trip.SATURATION: (
        "the combs were at their voltage or slew limit for too long",
        "the reference asks for more than the stage reaches: make the scan smaller, slower or closer to the centre",
    ),
    Trip.SLEW: (
        "the control law asked for a voltage step beyond the limit",
        "this is a defect of the law or its file, not of the stage: keep the recording and report it",
    ),
    Trip.OVERRUN: (
        "the computer missed too many control periods",
        "close other programs, allow real-time priority, or choose a bus with a longer period",
    ),
    Trip.SOLVER: (
        "the control law's optimiser gave no answer for several periods",
        "check the limits and weights of the controller file; choose another law until it is understood",
    ),
    Trip.NOT_FINITE: (
        "the control law computed something that is not a number",
        "this is a defect of the law or its file, not of the stage: keep the recording and report it",
    ),
    Trip.HEARTBEAT_LOST: (
        "the amplifier no longer says that it is alive",
        "check its supply and the bus plug; after it came back, clear the fault",
    ),
    Trip.NODE_NOT_OPERATIONAL: (
        "the amplifier left its operational state",
        "another master may have stopped it, or it has lost the controller's heartbeat; look at its error history",
    ),
    Trip.NODE_REBOOTED: (
        "the amplifier restarted by itself",
        "suspect its supply (brown-out, loose plug) before clearing the fault",
    ),
    Trip.NODE_EMERGENCY: (
        "the amplifier reported a fault of its own",
        "its emergency code says what, and what to do about it",
    ),
    Trip.GATE_BLOCKED: (
        "a frame that may not be sent was held back at the last moment",
        "the gate's reason names frame and rule. Right after a clear, at 0 V, it means that the bus is still disturbed:"
        " see to it and clear again. At any other time it is a defect of the program: keep the recording and report it",
    ),
    Trip.OPERATOR: (
        "stopped by hand",
        "clear the fault when ready",
    ),
    Trip.COMB_MISFIT_1: (
        "the stroke that sense comb 1 reads is not what the voltages can have made, and the other combs see nothing",
        "check sense comb 1's cable, preamplifier and gain, then amplifier channel 1: from inside they look alike",
    ),
    Trip.COMB_MISFIT_2: (
        "the stroke that sense comb 2 reads is not what the voltages can have made, and the other combs see nothing",
        "check sense comb 2's cable, preamplifier and gain, then amplifier channel 2: from inside they look alike",
    ),
    Trip.COMB_MISFIT_3: (
        "the stroke that sense comb 3 reads is not what the voltages can have made, and the other combs see nothing",
        "check sense comb 3's cable, preamplifier and gain, then amplifier channel 3: from inside they look alike",
    ),
    Trip.COMB_FORCE_1: (
        "drive comb 1 pulls with a force that is not that of its voltage",
        "check amplifier channel 1 (stuck, dead, limited, slow), then sense comb 1 (slow), then look for a push",
    ),
    Trip.COMB_FORCE_2: (
        "drive comb 2 pulls with a force that is not that of its voltage",
        "check amplifier channel 2 (stuck, dead, limited, slow), then sense comb 2 (slow), then look for a push",
    ),
    Trip.COMB_FORCE_3: (
        "drive comb 3 pulls with a force that is not that of its voltage",
        "check amplifier channel 3 (stuck, dead, limited, slow), then sense comb 3 (slow), then look for a push",
    ),
    Trip.FOREIGN_FRAME: (
        "somebody else on the bus sends what only this controller may send",
        "look for a second controller, a master or a tool that is connected, and take it off the bus",
    ),
    Trip.SAFETY_OBJECTS: (
        "the amplifier's safety objects are not those that were read back at the start, or it no longer tells them",
        "look for a tool or a master that writes to it; then clear: they are written and read back anew",
    ),
}


def explain(trips: int) -> str:
    """One line per bit of ``trips``: what happened, and what to check. Empty for 0; unknown bits are named as such."""
    lines = []
    for trip, (happened, remedy) in EXPLANATIONS.items():
        if trips & trip:
            lines.append(f"{happened[0].upper()}{happened[1:]} ({trip.name}): {remedy}.")
    unknown = trips & ~int(sum(EXPLANATIONS))
    if unknown:
        lines.append(f"Unknown trip bits {unknown:#x}: the recording is from another version of this program.")
    return "\n".join(lines)
