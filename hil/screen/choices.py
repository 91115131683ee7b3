"""What several commands let one choose."""

from enum import StrEnum


class InProcessLane(StrEnum):
    """Those that one process closes by itself, as a choice at the terminal."""

    LOCKSTEP = "lockstep"
    FAST = "fast"


class Tones(StrEnum):
    """What is added to the measurement: all tones at once, or one after another."""

    MULTISINE = "multisine"
    STEPPED = "stepped"
