"""The reference: segments planned into one trajectory that is sampled by tick.

    >>> trajectory = Trajectory([Hold(kind="hold", duration_s=0.01), Move(kind="move", to_m=(0.0, 0.0, 1e-6), ...)])
    >>> trajectory.sample(first_tick=0, count=1000, period_us=200)

Positions are relative to the rest pose, where a trajectory starts unless it is told otherwise.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pkxyz_ctrl.trajectory.motion import Array, Motion, TrajectoryError
from pkxyz_ctrl.trajectory.periodic import Circle, Lissajous, Rosette, Sine
from pkxyz_ctrl.trajectory.pieces import Pieces, still
from pkxyz_ctrl.trajectory.raster import Raster
from pkxyz_ctrl.trajectory.scan_bits import scan_bits
from pkxyz_ctrl.trajectory.segments import Hold, Move, Plan
from pkxyz_ctrl.trajectory.spiral import Spiral
from pkxyz_ctrl.trajectory.steps import Staircase, Steps
from pkxyz_ctrl.trajectory.sweep import Sweep
from pkxyz_ctrl.trajectory.table import Table
from pkxyz_ctrl.trajectory.waypoints import Waypoints

__all__ = [
    "Circle", "Hold", "Lissajous", "Move", "Raster", "Rosette", "Segment", "Sine", "Spiral", "Staircase", "Steps",
    "Sweep", "Table", "TimedSegment", "Trajectory", "TrajectoryError", "Waypoints",
]  # fmt: skip

AnySegment = (
    Hold | Move | Raster | Circle | Lissajous | Rosette | Sine | Spiral | Staircase | Steps | Sweep | Table | Waypoints
)
Segment = Annotated[AnySegment, Field(discriminator="kind")]
"""Any segment of a reference, told apart by ``kind``."""

Window = tuple[int, int]

LONGEST_S = 36_000.0
"""The longest trajectory that is planned: ten hours."""
PIECES_MAX = 2_000_000
"""The most pieces of constant jerk, over all segments: 200 MB."""


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
    jumps_us: tuple[int, ...] = ()
    """where the position jumps, on purpose: the first instants at the new places"""
    highest_hz: float = 0.0
    """of a periodic motion; 0 for others"""
    source: str | None = None
    """the file that it was read from, if there is one"""
    source_sha256: str | None = None
    """its digest"""
    period_s: float | None = None
    """after which the scan repeats itself, if it does"""


class Trajectory:
    """Segments one after another, from rest to rest; immutable. Each segment ends on a whole microsecond."""

    def __init__(
        self,
        segments: Sequence[AnySegment],
        pixels: int | None = None,
        start_m: Array | tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        """``pixels`` of each line, for triggers; None: it has none. ``start_m``: (3,), where it begins. Raises
        ``TrajectoryError``, naming the segment, where one can't be planned.
        """
        if not segments:
            raise TrajectoryError("reference: has no segments; give at least one [[reference]]")
        position = np.array(start_m, np.float64)
        if position.shape != (3,) or not np.isfinite(position).all():
            raise TrajectoryError(f"reference: begins at {start_m}; three finite numbers are wanted, x, y and z in m")
        start_us = pieces = 0
        motions: list[Motion] = []
        starts_us: list[float] = []
        timed: list[TimedSegment] = []
        for n, segment in enumerate(segments):
            try:
                plan = segment.plan(position)
            except TrajectoryError as error:
                raise TrajectoryError(f"reference.{n} ({segment.kind}): {error}") from None
            position = plan.end_m
            pieces += _require_bounded(f"reference.{n} ({segment.kind})", plan, start_us * 1e-6, pieces)
            t_s = 0.0
            for motion in plan.motions:
                motions.append(motion)
                starts_us.append(start_us + t_s * 1e6)
                t_s += motion.total_s
            length_us = math.ceil(t_s * 1e6 - 1e-3)
            if (rest_s := length_us * 1e-6 - t_s) > 0:
                motions.append(still(position, rest_s))
                starts_us.append(start_us + t_s * 1e6)
            timed.append(
                TimedSegment(
                    segment.kind,
                    start_us,
                    start_us + length_us,
                    _window(start_us, plan.scan_s),
                    tuple(w for line in plan.lines_s if (w := _window(start_us, line))),
                    _window(start_us, plan.still_s),
                    tuple(start_us + math.ceil(t * 1e6 - 1e-3) for t in plan.jumps_s),
                    plan.highest_hz,
                    plan.source,
                    plan.source_sha256,
                    plan.period_s,
                )
            )
            start_us += length_us
        self.segments = tuple(timed)
        self._pixels = pixels
        self._lines_a_frame = tuple(s.lines if isinstance(s, Raster) else 1 for s in segments)
        self._line_rows: dict[int, NDArray[np.int64]] = {}
        self.duration_us = start_us
        self.end_m = position
        self._motions = (*motions, still(position, 1.0))
        self._start_us = np.array([*starts_us, float(start_us)])

    def sample(self, first_tick: int, count: int, period_us: int) -> Array:
        """(count, 9): position (m), velocity (m/s), acceleration (m/s2) at ticks first_tick, first_tick + 1, ...

        Before 0 and after the end it stands still. The bits of a tick don't depend on which others are asked for.
        """
        t_us = np.maximum(_instants_us(first_tick, count, period_us), 0)
        out = np.empty((count, 9))
        if count == 0:
            return out
        # the motion of each start up to now is on; rows are in order of time, so each motion has a slice of them
        first, last = (int(n) - 1 for n in np.searchsorted(self._start_us, t_us[[0, -1]], side="right"))
        bounds = np.searchsorted(t_us, self._start_us[first + 1 : last + 1], side="left")
        for n, begin, end in zip(range(first, last + 1), [0, *bounds], [*bounds, count], strict=True):
            if end > begin:
                out[begin:end] = self._motions[n].sample((t_us[begin:end] - self._start_us[n]) * 1e-6)
        return out

    def line_rows(self, period_us: int) -> NDArray[np.int64]:
        """Of each line (n, 3): its first row, the row behind its last, and the number of its frame."""
        if period_us not in self._line_rows:
            found, frame = [], 0
            for timed, lines in zip(self.segments, self._lines_a_frame, strict=True):
                for n, (begin_us, end_us) in enumerate(timed.lines_us):
                    found.append((-(-begin_us // period_us), -(-end_us // period_us), frame + n // lines))
                frame = found[-1][2] + 1 if timed.lines_us else frame
            self._line_rows[period_us] = np.array(found, np.int64).reshape(-1, 3)
        return self._line_rows[period_us]

    def outputs(self, first_tick: int, count: int, period_us: int) -> NDArray[np.int64]:
        """Trigger bits (count,) of its rows, of ``config.triggers``."""
        if self._pixels is None:
            return np.zeros(count, np.int64)
        rows = first_tick + np.arange(count, dtype=np.int64)
        return scan_bits(self.line_rows(period_us), self._pixels, rows)


def _require_bounded(where: str, plan: Plan, start_s: float, before: int) -> int:
    """How many pieces a plan has; ``TrajectoryError`` if with it the trajectory has too many or is too long."""
    total_s = sum(motion.total_s for motion in plan.motions)
    if not (start_s + total_s <= LONGEST_S and np.isfinite(plan.end_m).all()):  # not a number, too, is refused
        raise TrajectoryError(
            f"{where}: would end {start_s + total_s:.4g} s after the start; at most {LONGEST_S:g} s are planned"
        )
    pieces = sum(len(motion.duration_s) for motion in plan.motions if isinstance(motion, Pieces))
    if before + pieces > PIECES_MAX:
        raise TrajectoryError(
            f"{where}: up to here the reference has {before + pieces} pieces of constant jerk; at most {PIECES_MAX} "
            "are planned; give fewer lines, steps or points"
        )
    return pieces


def _instants_us(first_tick: int, count: int, period_us: int) -> NDArray[np.int64]:
    return (first_tick + np.arange(count, dtype=np.int64)) * period_us


def _window(start_us: int, window_s: tuple[float, float] | None) -> Window | None:
    """Whole microseconds inside the window, so nothing outside it is measured."""
    if window_s is None:
        return None
    return start_us + math.ceil(window_s[0] * 1e6 - 1e-3), start_us + math.floor(window_s[1] * 1e6 + 1e-3)
