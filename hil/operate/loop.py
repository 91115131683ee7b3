"""What a session needs of the loop beside it: Python's controller, or a native loop that is read and given orders."""

from collections.abc import Iterable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.safety.modes import Event

Records = NDArray[np.void]


class Loop(Protocol):
    """Everything is as the last tick left it; what is asked for acts in the next."""

    faults: list[str]
    """a sentence for each fault decision"""
    period_us: int

    @property
    def law(self) -> Records:
        """(1,) of ``cycle.LAW``."""

    @property
    def memory(self) -> Records:
        """(1,) of ``cycle.MEMORY``."""

    @property
    def outputs(self) -> Records:
        """(1,) of ``outputs.OUTPUTS``."""

    @property
    def mode(self) -> int:
        """A ``Mode``."""

    @property
    def missed_ticks(self) -> int:
        """Skipped, late on the wire, or without the sample that the node owed."""

    @property
    def has_outputs(self) -> bool:
        """Whether the amplifier has digital outputs."""

    @property
    def is_obeyed(self) -> bool:
        """Whether the change of law that was asked for last was not too late."""

    def passed(self) -> Iterable[Records]:
        """The memory (1,) of each tick since the session's last step, the newest last, as far as they are known."""

    def request(self, event: Event) -> None: ...

    def clear(self) -> None:
        """Ask to forget the fault."""

    def release(self) -> None:
        """Ask for 0 V."""

    def hold_quietly(self, quiet: bool) -> None: ...

    def settle(self, window_m: float, sigmas: float, dwell_s: float) -> None:
        """When the stage is in position."""

    def aim(self, axis: int, direction: int, start_m: float, pitch_m: float, count: int) -> None:
        """Which positions are told."""

    def change_law(self, change: Records) -> None:
        """Another law, (1,) of ``law_change.CHANGE``."""
