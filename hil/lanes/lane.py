"""The ways in which a loop is closed, by name."""

from enum import StrEnum
from typing import Self


class Lane(StrEnum):
    """Over the simulated bus in lockstep, composed in one compiled loop, in lockstep with a controller on an emulated
    processor, or at the machine's clock. The first three have the same bits.
    """

    LOCKSTEP = "lockstep"
    FAST = "fast"
    EMULATED = "emulated"
    WALL = "wall"

    @classmethod
    def named(cls, name: str) -> Self:
        """The lane of a name. Raises ``ConfigError`` with those that there are."""
        try:
            return cls(name)
        except ValueError:
            from pkxyz_ctrl.config.files import ConfigError  # slow to load, and rarely needed

            raise ConfigError(f"no lane {name!r}; there are: {', '.join(cls)}") from None
