"""The ways in which a loop is closed, by name."""

from enum import StrEnum


class Lane(StrEnum):
    """Over the simulated bus in lockstep, composed in one compiled loop, or at the machine's clock. The first two have
    the same bits.
    """

    LOCKSTEP = "lockstep"
    FAST = "fast"
    WALL = "wall"
