"""What a stage in operation is told at its start, and may be told otherwise while it runs."""

from dataclasses import dataclass, field
from typing import Literal

from pkxyz_ctrl.trajectory.segments import Limits


@dataclass
class Settings:
    """Changed by verbs only; the loop reads them every tick."""

    limits: Limits = field(default_factory=lambda: Limits(0.5e-3, 0.5, 300.0))
    """of moves that name none, for each axis"""
    window_m: float = 20e-9
    """in position: each axis of the estimate at most so far from its target ..."""
    dwell_s: float = 2e-3
    """... for so long ..."""
    sigmas: float = 3.0
    """... so many standard deviations of the estimate included"""
    settle_s: float = 1.0
    """a move that is not in position so long after its set-point arrived has failed"""
    on_silence: Literal["hold", "park"] = "hold"
    """what becomes of a moving stage when the server falls silent"""
    silence_s: float = 0.06
    """after which a server that says nothing is taken to be gone"""
    lease_s: float = 0.25
    """for which a jog goes on without being said again: with a tick or two and a poll of the server below 0.3 s"""
