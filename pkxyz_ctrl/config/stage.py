"""The numbers of one device, as a stage file holds them. Lengths in m, relative to nothing but the drawing."""

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from pkxyz_ctrl.config.calibration import Calibration
from pkxyz_ctrl.config.files import FrozenModel, Name

Positive = Annotated[float, Field(gt=0)]


class GeometryConfig(FrozenModel):
    """Dimensions of the mechanism (paper, Fig. 2 and 3). The out-of-plane link is given either by its projection and
    height at rest or by its length and elevation at rest."""

    base_radius_m: Positive
    """r: centre to base point, after the platform was collapsed to a point."""
    crank_length_m: Positive
    """L1: crank of the in-plane parallelogram."""
    link_projection_rest_m: Positive | None = None
    """delta_0 = L2 cos(alpha_0)."""
    link_height_rest_m: Positive | None = None
    """z_0 = L2 sin(alpha_0)."""
    link_length_m: Positive | None = None
    """L2: out-of-plane link."""
    elevation_rest_rad: Annotated[float, Field(gt=0, lt=math.pi / 2)] | None = None
    """alpha_0: elevation of the links above the plane at rest."""

    @model_validator(mode="after")
    def _one_description_of_the_link(self) -> Self:
        by_legs = self.link_projection_rest_m is not None and self.link_height_rest_m is not None
        by_polar = self.link_length_m is not None and self.elevation_rest_rad is not None
        numbers = sum(
            v is not None
            for v in (self.link_projection_rest_m, self.link_height_rest_m, self.link_length_m, self.elevation_rest_rad)
        )
        if numbers != 2 or by_legs == by_polar:
            raise ValueError(
                "give the link either by link_projection_rest_m and link_height_rest_m "
                "or by link_length_m and elevation_rest_rad"
            )
        if self.base_radius_m - self.projection_rest_m - self.crank_length_m <= 0:
            raise ValueError("links do not close: base_radius_m must exceed link projection at rest + crank_length_m")
        return self

    @property
    def projection_rest_m(self) -> float:
        """delta_0."""
        if self.link_projection_rest_m is not None:
            return self.link_projection_rest_m
        assert self.link_length_m is not None
        assert self.elevation_rest_rad is not None
        return self.link_length_m * math.cos(self.elevation_rest_rad)

    @property
    def height_rest_m(self) -> float:
        """z_0."""
        if self.link_height_rest_m is not None:
            return self.link_height_rest_m
        assert self.link_length_m is not None
        assert self.elevation_rest_rad is not None
        return self.link_length_m * math.sin(self.elevation_rest_rad)


class FlexureConfig(FrozenModel):
    """Flexures (paper IV.A to IV.C)."""

    youngs_modulus_pa: Positive
    fracture_strength_pa: Positive
    leaf_inner_length_m: Positive
    """l_11 of the folded spring."""
    leaf_outer_length_m: Positive
    """l_12 of the folded spring."""
    leaf_thickness_m: Positive
    leaf_height_m: Positive
    crank_hinge_length_m: Positive
    crank_hinge_thickness_m: Positive
    crank_hinge_height_m: Positive
    link_hinge_length_m: Positive
    link_hinge_thickness_m: Positive
    link_hinge_width_m: Positive
    out_of_plane_chains: Literal[1, 3] = 1
    """How many chains' out-of-plane hinges count in the stiffness: 1 as Eq. 19 prints it, 3 as the text describes it.
    """


class CombConfig(FrozenModel):
    """A comb: n fingers of height h with gap g on both sides, overlapping by ``overlap_rest_m`` at rest."""

    finger_count: Annotated[int, Field(gt=0)]
    finger_height_m: Positive
    finger_gap_m: Positive
    overlap_rest_m: Positive


class DynamicsConfig(FrozenModel):
    """Lumped dynamics. Damping is not in the paper: a quality factor, the same for the three modes."""

    mass_kg: Positive
    quality_factor: Annotated[float, Field(ge=1)]


class SenseConfig(FrozenModel):
    """What is known of the sense chain."""

    noise_density_f_per_rthz: Positive
    """White noise of one channel, one-sided density."""
    delay_s: Annotated[float, Field(ge=0, lt=1e-3)] = 0.0
    """Group delay of the sense electronics: a sample shows the stroke this long before."""


class AmplifierConfig(FrozenModel):
    """What is known of the high-voltage amplifier."""

    bandwidth_hz: Positive
    """First-order corner frequency of one channel into its comb."""
    slew_max_v_per_s: Positive


class LimitsConfig(FrozenModel):
    """What the device may be asked for."""

    stroke_min_m: float
    stroke_max_m: float
    voltage_max_v: Annotated[float, Field(gt=0, le=1000)]

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.stroke_min_m >= self.stroke_max_m:
            raise ValueError("stroke_min_m must lie below stroke_max_m")
        return self


class StageConfig(FrozenModel):
    """One device."""

    name: Name
    geometry: GeometryConfig
    flexures: FlexureConfig
    drive_comb: CombConfig
    sense_comb: CombConfig
    dynamics: DynamicsConfig
    sense: SenseConfig
    amplifier: AmplifierConfig
    limits: LimitsConfig
    calibration: Calibration | None = None
    """what was measured of it; None: all as drawn. The plant does not read it."""
