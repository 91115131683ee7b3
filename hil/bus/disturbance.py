"""What may go wrong on the simulated wire: chosen frames, random bits, or whatever a fault's own function decides."""

import random
from collections.abc import Callable
from typing import NamedTuple

from hil.bus.frame_time import frame_bit_counts
from pkxyz_ctrl.can.frame import Frame


class FrameFate(NamedTuple):
    """What a fault makes of a frame: an error frame, or deliveries as (delay_us, frame) in the receivers."""

    corrupt: bool = False
    deliveries: tuple[tuple[int, Frame], ...] = ()


CORRUPTED = FrameFate(corrupt=True)
DROPPED = FrameFate()

FaultTap = Callable[[Frame, str, int], FrameFate | None]
"""Called with frame, sender's name and t_us as each frame ends; None leaves it alone."""


class Disturbance:
    """Judges each frame as it ends. ``armed`` is False while nothing is set; ``on_armed`` hears that something was."""

    def __init__(self, seed: int, on_armed: Callable[[], object]) -> None:
        self.armed = False
        self._on_armed = on_armed
        self._random = random.Random(seed)
        self._tap: FaultTap | None = None
        self._bit_error_rate = 0.0
        self._doomed: list[tuple[Callable[[Frame], bool], int]] = []  # predicate, how many more

    def set_tap(self, tap: FaultTap | None) -> None:
        """``tap(frame, sender, t_us)`` is asked for each frame that nothing else has destroyed; None: nobody is."""
        self._tap = tap
        self._rearm()

    def set_bit_error_rate(self, probability: float) -> None:
        """Probability that a bit of a frame is disturbed, 0..1; a frame with a disturbed bit is destroyed."""
        if not 0.0 <= probability <= 1.0:
            raise ValueError(f"bit error rate {probability} is not within 0..1")
        self._bit_error_rate = probability
        self._rearm()

    def corrupt_next(self, predicate: Callable[[Frame], bool] = lambda frame: True, count: int = 1) -> None:
        """Destroy the next ``count`` frames for which ``predicate`` holds, retransmissions included."""
        self._doomed.append((predicate, count))
        self._rearm()

    def is_only(self, tap: FaultTap | None) -> bool:
        """Whether nobody but ``tap`` may destroy or change a frame."""
        return not (self._doomed or self._bit_error_rate) and self._tap in (None, tap)

    def judge(self, frame: Frame, sender: str, t_us: int) -> FrameFate | None:
        """What becomes of the frame; None: nothing happens to it."""
        for i, (predicate, count) in enumerate(self._doomed):
            if predicate(frame):
                self._doomed[i : i + 1] = [(predicate, count - 1)] if count > 1 else []
                self._rearm()
                return CORRUPTED
        if self._bit_error_rate:
            bits = sum(frame_bit_counts(frame))
            if self._random.random() < 1.0 - (1.0 - self._bit_error_rate) ** bits:
                return CORRUPTED
        return None if self._tap is None else self._tap(frame, sender, t_us)

    def _rearm(self) -> None:
        self.armed = bool(self._doomed or self._bit_error_rate or self._tap)
        if self.armed:
            self._on_armed()
