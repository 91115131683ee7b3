"""A process file: how what a wafer gives differs from the drawing, and what a device has to fulfil.

Each quantity is split into what a wafer has as a whole, what changes over the wafer, and what differs within a die::

    v(chain, die, wafer) = mean + wafer w + tilt (t . r) + bowl (|r|^2 - 1/2) + die f(r) + chain c

w, t, f and c are normal deviates, r is the place of the chain on the wafer over the radius of its usable part, and f
is a field whose correlation between two dies falls by 1/e over ``correlation_m``. The bowl is systematic: its edge less
its centre, and 0 on average over the area.
"""

import math
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from pkxyz_ctrl.config.bound import Bound
from pkxyz_ctrl.config.files import FrozenModel, Name

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(ge=0, le=1)]

DIES_MAX = 2000


class Spread(FrozenModel):
    """One quantity, in the unit that its section names. What is not given is 0."""

    mean: float = 0.0
    """of the process, over all wafers"""
    wafer: NotNegative = 0.0
    """standard deviation between wafers"""
    tilt: NotNegative = 0.0
    """standard deviation of what a wafer's slope makes at its edge, along each axis"""
    bowl: float = 0.0
    """edge less centre, the same on every wafer"""
    die: NotNegative = 0.0
    """standard deviation of the field over a wafer"""
    chain: NotNegative = 0.0
    """standard deviation between the chains of a die"""


class WaferConfig(FrozenModel):
    """Where dies lie: whole squares within the usable part, in rows along x."""

    diameter_m: Positive
    edge_m: NotNegative
    """ring that is not used"""
    die_m: Positive
    """pitch of the dies along x and y"""
    correlation_m: Positive
    """distance over which the correlation of fields falls by 1/e"""
    chain_radius_m: NotNegative
    """of a chain's springs from the middle of its die"""

    @model_validator(mode="after")
    def _holds_a_die(self) -> Self:
        if self.usable_radius_m < self.die_m / math.sqrt(2.0):
            raise ValueError("no die fits: diameter_m / 2 - edge_m must exceed die_m / sqrt(2)")
        if math.pi * (self.usable_radius_m / self.die_m) ** 2 > DIES_MAX:
            raise ValueError(f"more than {DIES_MAX} dies on a wafer: too many for a field that correlates them all")
        return self

    @property
    def usable_radius_m(self) -> float:
        """Radius within which dies lie."""
        return self.diameter_m / 2.0 - self.edge_m


class SiliconConfig(FrozenModel):
    """Crystal of the device layer. ``drawn``: the stage file's modulus in all directions."""

    plane: Literal["drawn", "100", "111"] = "drawn"
    flat_rad: float = 0.0
    """direction of a <110> in the wafer's plane, from x counter-clockwise"""


class MadeOfConfig(FrozenModel):
    """What the drawing does not say, or the paper does not print. Shares of the moving mass have to sum up to 1."""

    mass_layer_1: Share
    """springs, sliders, combs and cranks"""
    mass_handle: Share
    """links"""
    mass_layer_2: Share
    """table"""
    handle_m: Positive
    layer_2_m: Positive
    truss_m: Positive
    """width of the trusses that the moving parts are made of"""
    stress_left: Share
    """of the device layer's stress in folded leaves, whose ends are free to move"""
    comb_arm_m: NotNegative
    """from the anchors to the combs: over it a bent wafer lifts the fixed fingers"""
    leaf_gap_m: Positive
    """between a leaf and its neighbour: squeezed air"""
    drag_gap_m: Positive
    """of the flow that the rest of the damping comes from: how rarefied it is at a pressure"""
    reference_pressure_pa: Positive
    """at which the stage file's quality factor holds"""
    vacuum_quality_factor: Positive
    """without air"""

    @model_validator(mode="after")
    def _whole(self) -> Self:
        total = self.mass_layer_1 + self.mass_handle + self.mass_layer_2
        if abs(total - 1.0) > 1e-9:
            raise ValueError(f"mass_layer_1 + mass_handle + mass_layer_2 must be 1, not {total:g}")
        return self


class Process(FrozenModel):
    """A file of configs/processes. Lengths are deviations from the drawing unless said otherwise."""

    name: Name
    sources: Annotated[tuple[str, ...], Field(min_length=1)]
    """where the numbers come from, in the order in which comments cite them"""
    wafer: WaferConfig
    silicon: SiliconConfig = SiliconConfig()
    made_of: MadeOfConfig
    layer_1_m: Spread = Spread()
    """thickness of device layer 1: height of leaves, hinges and fingers"""
    layer_2_m: Spread = Spread()
    """thickness of device layer 2"""
    handle_m: Spread = Spread()
    """thickness of the handle layer: height of the links"""
    wafer_bow_m: Spread = Spread()
    """bow of the wafer over its diameter, itself"""
    etch_bias_m: Spread = Spread()
    """width that a line loses at the top of the layer, both sides together"""
    sidewall_rad: Spread = Spread()
    """lean of each sidewall, positive where lines get narrower downwards"""
    comb_gap_m: Spread = Spread()
    """what narrow gaps open beyond the etch bias, or less"""
    hinge_m: Spread = Spread()
    """thickness of the out-of-plane hinges, which an etch leaves"""
    alignment_x_m: Spread = Spread()
    """device layer 2 against layer 1, along x"""
    alignment_y_m: Spread = Spread()
    """device layer 2 against layer 1, along y"""
    youngs_modulus: Spread = Spread()
    """relative"""
    residual_stress_pa: Spread = Spread()
    """of device layer 1, tension positive"""
    finger_offset_m: Spread = Spread()
    """moving fingers aside of the middle of their gaps"""
    pressure_pa: Spread = Spread()
    """of the gas around the device, itself"""
    requirements: Annotated[dict[str, Bound], Field(min_length=1)]
    """figure by name of ``figures.FIGURES``: where it has to lie"""
    closed_loop: Annotated[dict[str, Bound], Field(default_factory=dict)]
    """figure of a loop, ``"shipped.error_nm"`` and the like: where it has to lie under the law as shipped, and under
    one designed for what an identification finds (``known``)"""


SOURCES: tuple[str, ...] = (
    "layer_1_m", "layer_2_m", "handle_m", "wafer_bow_m", "etch_bias_m", "sidewall_rad", "comb_gap_m", "hinge_m",
    "alignment_x_m", "alignment_y_m", "youngs_modulus", "residual_stress_pa", "finger_offset_m", "pressure_pa",
)  # fmt: skip
"""Fields of ``Process`` that are sampled, in the order in which their random numbers are. New ones go to the end."""
