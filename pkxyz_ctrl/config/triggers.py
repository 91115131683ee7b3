"""What goes to the node's digital outputs: bits of a scan, positions that are passed, in position."""

from typing import Annotated, Final, Literal

from pydantic import Field

from pkxyz_ctrl.can.codec import OUTPUT_NAMES
from pkxyz_ctrl.config.files import FrozenModel

LINE, PIXEL, FRAME, POSITION, IN_POSITION = 1, 2, 4, 8, 16
"""On a line; in the first half of a pixel of it; on the first line of a frame; passed a position; in position."""
BITS: Final = {name: 1 << bit for bit, name in enumerate(OUTPUT_NAMES)}

Direction = Literal[-1, 0, 1]


class PositionTrigger(FrozenModel):
    """A pulse of one period at each of ``count`` positions along an axis."""

    axis: Literal["x", "y", "z"]
    start_m: Annotated[float, Field(ge=-1e-3, le=1e-3)]
    """the first position; the others follow towards larger coordinates"""
    pitch_m: Annotated[float, Field(ge=1e-10, le=1e-3)]
    """between two: more than the way of two periods, or two passages become one pulse"""
    count: Annotated[int, Field(ge=1, le=1_000_000)]
    direction: Direction = 0
    """1: on the way to larger coordinates only, -1: to smaller ones, 0: both"""


class TriggersConfig(FrozenModel):
    """Triggers of a run."""

    pixels: Annotated[int, Field(ge=0, le=1_000_000)] = 0
    """of each line of a scan; 0: none. Lines and frames are told in any case"""
    position: PositionTrigger | None = None
    window_m: Annotated[float, Field(ge=0.1e-9, le=10e-6)] | None = None
    """in position is: each axis so near its set-point, which stands ...; absent: not told"""
    sigmas: Annotated[float, Field(ge=0.0, le=10.0)] = 3.0
    """... with so many standard deviations of its estimate ..."""
    dwell_s: Annotated[float, Field(ge=0.0, le=10.0)] = 2e-3
    """... for so long"""
