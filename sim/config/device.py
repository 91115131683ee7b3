"""The device as a stage file gives it, read on its own: the file is shared with the controller, code is not. SI."""

import math
import tomllib
from pathlib import Path
from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Part(BaseModel):
    """A part of a stage file, of which only what the plant needs is read."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class Geometry(_Part):
    """Mechanism at rest. The link either by projection and height or by length and elevation."""

    base_radius_m: Positive
    crank_length_m: Positive
    link_projection_rest_m: Positive | None = None
    link_height_rest_m: Positive | None = None
    link_length_m: Positive | None = None
    elevation_rest_rad: Annotated[float, Field(gt=0, lt=math.pi / 2)] | None = None

    @model_validator(mode="after")
    def _closes(self) -> Self:
        projection_m, _ = self.link_rest_m
        if self.base_radius_m <= projection_m + self.crank_length_m:
            raise ValueError(
                "base_radius_m must exceed the link's projection plus crank_length_m, or no slider has room"
            )
        return self

    @property
    def link_rest_m(self) -> tuple[float, float]:
        """Projection on the plane and height of the link at rest, m."""
        if self.link_projection_rest_m is not None and self.link_height_rest_m is not None:
            return self.link_projection_rest_m, self.link_height_rest_m
        if self.link_length_m is not None and self.elevation_rest_rad is not None:
            return (
                self.link_length_m * math.cos(self.elevation_rest_rad),
                self.link_length_m * math.sin(self.elevation_rest_rad),
            )
        raise ValueError("give link_projection_rest_m and link_height_rest_m, or link_length_m and elevation_rest_rad")


class Flexures(_Part):
    """Hinges and leaf springs (paper IV.A to IV.C)."""

    youngs_modulus_pa: Positive
    leaf_inner_length_m: Positive
    leaf_outer_length_m: Positive
    leaf_thickness_m: Positive
    leaf_height_m: Positive
    crank_hinge_length_m: Positive
    crank_hinge_thickness_m: Positive
    crank_hinge_height_m: Positive
    link_hinge_length_m: Positive
    link_hinge_thickness_m: Positive
    link_hinge_width_m: Positive
    out_of_plane_chains: Annotated[int, Field(ge=1, le=3)] = 1


class Comb(_Part):
    """Interdigitated comb: fingers, their height, the gap on both sides, overlap at rest."""

    finger_count: Annotated[int, Field(gt=0)]
    finger_height_m: Positive
    finger_gap_m: Positive
    overlap_rest_m: Positive


class Dynamics(_Part):
    mass_kg: Positive
    quality_factor: Positive


class Limits(_Part):
    stroke_min_m: Finite
    stroke_max_m: Finite


class Device(_Part):
    """One device as the stage file gives it; everything else in that file is the controller's business."""

    geometry: Geometry
    flexures: Flexures
    drive_comb: Comb
    sense_comb: Comb
    dynamics: Dynamics
    limits: Limits

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read a stage file. Raises OSError, tomllib.TOMLDecodeError or pydantic.ValidationError."""
        return cls.model_validate(tomllib.loads(Path(path).read_text(encoding="utf-8")))
