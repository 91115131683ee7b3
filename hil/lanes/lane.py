"""The ways in which a loop is closed, by name."""

from enum import StrEnum


class Lane(StrEnum):
    """Over the simulated bus in lockstep, composed in one compiled loop, in lockstep with a controller on an emulated
    processor, or at the machine's clock. The first three have the same bits.
    """

    LOCKSTEP = "lockstep"
    FAST = "fast"
    EMULATED = "emulated"
    WALL = "wall"
