"""What is set of a stage in operation, and how that came about."""

import getpass
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Self

Metres = Annotated[float, "m"]
"""Told where a call is completed."""
Point = tuple[Metres, Metres, Metres]


@dataclass(frozen=True)
class SampleCoordinates:
    """Where the sample lies on the stage: stage = origin + turn . scale . sample. All targets and positions are the
    sample's.
    """

    origin_m: Point
    """of the sample, in the stage's coordinates"""
    rotation_deg: float
    """about the sample's normal, from x towards y"""
    slope_x: float
    """how far the sample's plane rises along the stage's x, m/m"""
    slope_y: float
    scale: tuple[float, float, float]
    """metres of the stage for each metre of the sample"""


@dataclass(frozen=True)
class Change:
    """Of the settings."""

    at: str
    """UTC; empty for those that are shipped"""
    who: str
    what: str
    digest: str
    """by which ``restore_settings`` finds back to them"""


@dataclass(frozen=True)
class StageSettings:
    """They outlive the loop and the server."""

    sample: SampleCoordinates
    positions: Mapping[str, Point]
    """m, in the sample's coordinates"""
    velocity_m_per_s: float
    """of moves that name none, as the next two"""
    acceleration_m_per_s2: float
    jerk_m_per_s3: float
    window_m: float
    """in position: each axis so near to its target ..."""
    dwell_s: float
    """... for so long ..."""
    sigmas: float
    """... so many standard deviations of the estimate included"""
    digest: str
    history: tuple[Change, ...]
    """newest first"""

    @classmethod
    def of(cls, data: Mapping[str, Any]) -> Self:
        """From the server's words."""
        sample = data["sample"]
        return cls(
            sample=SampleCoordinates(**sample | {name: tuple(sample[name]) for name in ("origin_m", "scale")}),
            positions={name: (place[0], place[1], place[2]) for name, place in data["positions"].items()},
            **data["limits"], **data["settle"], digest=data["digest"],
            history=tuple(Change(**change) for change in data["history"]),
        )  # fmt: skip


def who() -> str:
    """Who asks, for the history."""
    try:
        return f"{getpass.getuser()}, Python"
    except (KeyError, OSError):
        return f"user {os.getuid()}, Python"
