"""Words that several commands take: where a loop runs, and with what it is excited."""

from enum import StrEnum


class Lane(StrEnum):
    """Over the simulated bus, or composed in one compiled loop; both have the same bits."""

    LOCKSTEP = "lockstep"
    FAST = "fast"


class Tones(StrEnum):
    """What is added to the measurement: all tones at once, or one after another."""

    MULTISINE = "multisine"
    STEPPED = "stepped"
