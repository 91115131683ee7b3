"""What a stage in operation says back: where it stands, what became of a command, and what went wrong."""

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray


class StageError(Exception):
    """Something with a stage in operation went wrong; the message says what to do."""


class RefusedError(StageError):
    """The stage did not do what was asked, and nothing moved; the message says why."""


class AbortedError(StageError):
    """What was asked was begun and did not come to its end; the message says why."""


class NoStageError(StageError):
    """No server, or one that does not let us in."""


@dataclass(frozen=True)
class Status:
    """Where the stage stood a tenth of a second ago at most. Lengths in m, voltages in V, time in s."""

    activity: str
    """in a word: off, homing, holding, moving, jogging, scanning, paused, stopping, fault, starting"""
    words: str
    """the same in a sentence"""
    mode: str
    homed: bool
    driven: bool
    """whether the loop is closed"""
    in_position: bool
    t_s: float
    """since the loop's first tick"""
    position_m: NDArray[np.float64]
    """(3,), as estimated"""
    setpoint_m: NDArray[np.float64]
    """(3,)"""
    uncertainty_m: NDArray[np.float64]
    """(3,), standard deviation of the estimate"""
    target_m: NDArray[np.float64]
    """(3,), where the present motion ends"""
    range_m: NDArray[np.float64]
    """(3, 2), least and greatest target of each axis that the combs can hold with the others at theirs"""
    voltage_v: NDArray[np.float64]
    """(3,), of the combs"""
    headroom_v: float
    outputs: tuple[str, ...]
    """of the node's digital outputs those that are 1: line, pixel, frame, position, in position"""
    progress: float
    """0 to 1 of a path"""
    law: str
    quiet: bool
    """whether quiet holds are asked for"""
    in_sample_axes: bool
    """whether lengths are along the sample's axes, and those are not the stage's"""
    missed_ticks: int
    """since the loop began; not while the amplifier is off or in a fault, when nothing waits for a tick"""
    stood_still_s: float
    """for how long the time of a simulated stage has waited for the computer; with hardware always 0"""
    bus_load: float
    """0 to 1"""
    last_fault: str
    """what happened and what to check; empty if nothing did"""
    saved: str
    """the folder in which the 2 s before the last fault are kept, on the machine of the server"""

    @classmethod
    def of(cls, data: Mapping[str, Any]) -> Self:
        """From the server's words."""
        values: dict[str, Any] = {name: data.get(name) for name in cls.__dataclass_fields__}
        for name in ("position_m", "setpoint_m", "target_m", "voltage_v", "uncertainty_m"):
            values[name] = np.array([np.nan if v is None else v for v in values[name] or [None] * 3], np.float64)
        low_high = [[np.nan if v is None else v for v in pair] for pair in values["range_m"] or [[None] * 2] * 3]
        values["range_m"] = np.array(low_high, np.float64)
        values["outputs"] = tuple(values["outputs"] or ())
        plain: dict[str, Any] = {"homed": False, "driven": False, "in_position": False, "missed_ticks": 0}
        plain |= {"quiet": False, "in_sample_axes": False}
        plain |= dict.fromkeys(("t_s", "headroom_v", "progress", "stood_still_s", "bus_load"), 0.0)
        return cls(**{name: plain.get(name, "") if value is None else value for name, value in values.items()})


@dataclass
class Command:
    """Something that was asked. ``state``: accepted, running, done, refused or aborted."""

    id: int | None
    verb: str
    state: str
    words: str = ""
    answers: "asyncio.Queue[Command] | None" = field(default=None, repr=False, compare=False)
    """where further ones come, of a command whose end was not waited for"""

    def require_done(self) -> "Command":
        """Raise ``RefusedError`` or ``AbortedError`` unless it was done."""
        if self.state == "refused":
            raise RefusedError(self.words)
        if self.state == "aborted":
            raise AbortedError(self.words)
        return self
