"""The reference: segments planned into one trajectory that is sampled by tick.

    >>> trajectory = Trajectory([Hold(kind="hold", duration_s=0.01), Move(kind="move", to_m=(0.0, 0.0, 1e-6), ...)])
    >>> trajectory.sample(first_tick=0, count=1000, period_us=200)

Positions are relative to the rest pose, where every trajectory starts.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pkxyz_ctrl.trajectory.pieces import Array, Pieces, TrajectoryError, joined, still
from pkxyz_ctrl.trajectory.raster import Raster
from pkxyz_ctrl.trajectory.segments import Hold, Move

__all__ = ["Hold", "Move", "Raster", "Segment", "TimedSegment", "Trajectory", "TrajectoryError"]

Segment = Annotated[Hold | Move | Raster, Field(discriminator="kind")]
"""Any segment of a reference, told apart by ``kind``."""

Window = tuple[int, int]


@dataclass(frozen=True)
class TimedSegment:
    """One segment in its place. Times in us since the start of the trajectory; windows are [start, end)."""

    kind: str
    t_start_us: int
    t_end_us: int
    scan_us: Window | None
    """the scan with its turn-arounds, without lead-in and lead-out: what a tracking error is taken over"""
    lines_us: tuple[Window, ...]
    """the parts of the scan at constant velocity"""
    still_us: Window | None
    """where hold noise is taken"""


class Trajectory:
    """Segments one after another from the rest pose; immutable. Each segment ends on a whole microsecond."""

    def __init__(self, segments: Sequence[Hold | Move | Raster]) -> None:
        """Raises ``TrajectoryError``, naming the segment, where one can't be planned."""
        if not segments:
            raise TrajectoryError("reference: has no segments; give at least one [[reference]]")
        position = np.zeros(3)
        start_us = 0
        parts: list[Pieces] = []
        timed: list[TimedSegment] = []
        starts: list[Array] = []
        for n, segment in enumerate(segments):
            try:
                plan = segment.plan(position)
            except TrajectoryError as error:
                raise TrajectoryError(f"reference.{n} ({segment.kind}): {error}") from None
            length_us = math.ceil(plan.pieces.total_s * 1e6 - 1e-3)
            position = plan.end_m
            rest_s = length_us * 1e-6 - plan.pieces.total_s
            pieces = joined([plan.pieces, still(position, rest_s)]) if rest_s > 0 else plan.pieces
            parts.append(pieces)
            starts.append(start_us + np.concatenate([[0.0], np.cumsum(pieces.duration_s[:-1])]) * 1e6)
            timed.append(
                TimedSegment(
                    segment.kind,
                    start_us,
                    start_us + length_us,
                    _window(start_us, plan.scan_s),
                    tuple(w for line in plan.lines_s if (w := _window(start_us, line))),
                    _window(start_us, plan.still_s),
                )
            )
            start_us += length_us
        parts.append(still(position, 1.0))
        starts.append(np.array([float(start_us)]))
        self.segments = tuple(timed)
        self.duration_us = start_us
        self.end_m = position
        every = joined(parts)
        self._start_us = np.concatenate(starts)
        self._state, self._jerk = every.state, every.jerk_m_per_s3
        self._segment_start_us = np.array([s.t_start_us for s in timed])

    def sample(self, first_tick: int, count: int, period_us: int) -> Array:
        """(count, 9): position (m), velocity (m/s), acceleration (m/s2) at ticks first_tick, first_tick + 1, ...

        Before 0 and after the end it stands still. The bits of a tick don't depend on which others are asked for.
        """
        t_us = _instants_us(first_tick, count, period_us)
        piece = np.maximum(np.searchsorted(self._start_us, t_us, side="right") - 1, 0)
        t = (np.maximum(t_us - self._start_us[piece], 0.0) * 1e-6)[:, None]
        p, v, a = np.moveaxis(self._state[piece], 1, 0)
        j = self._jerk[piece]
        out = np.empty((count, 9))
        out[:, 0:3] = p + t * (v + t * (a / 2 + t * (j / 6)))
        out[:, 3:6] = v + t * (a + t * (j / 2))
        out[:, 6:9] = a + t * j
        return out

    def segment_index(self, first_tick: int, count: int, period_us: int) -> NDArray[np.int16]:
        """(count,) index into ``segments`` at each tick, -1 before the start and after the end."""
        t_us = _instants_us(first_tick, count, period_us)
        index = np.searchsorted(self._segment_start_us, t_us, side="right") - 1
        return np.where(t_us < self.duration_us, index, -1).astype(np.int16)


def _instants_us(first_tick: int, count: int, period_us: int) -> NDArray[np.int64]:
    return (first_tick + np.arange(count, dtype=np.int64)) * period_us


def _window(start_us: int, window_s: tuple[float, float] | None) -> Window | None:
    """Whole microseconds inside the window, so nothing outside it is measured."""
    if window_s is None:
        return None
    return start_us + math.ceil(window_s[0] * 1e6 - 1e-3), start_us + math.floor(window_s[1] * 1e6 + 1e-3)
