"""Devices as they were made: springs, mass, combs and damping from the drawing and what the process left of it.

Everything is an array over n devices, and over their 3 chains where it belongs to a chain. With no deviation at all
each number is that of ``Stage``.

A sidewall that leans by phi makes a line of width w_0 at its top w_0 - 2 phi s wide at the depth s, so over a layer of
height h the width is w = w_0 - phi h in the mean, and w^3 is w^3 + w (phi h)^2 in the mean (I of a leaf that bends in
the plane). Gaps widen by what lines lose.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.config.stage import CombConfig, StageConfig
from pkxyz_ctrl.elements.combs import EPSILON_0_F_PER_M
from pkxyz_ctrl.fabrication.damping import quality_factor
from pkxyz_ctrl.fabrication.process import SOURCES, Process
from pkxyz_ctrl.fabrication.silicon import modulus_by_drawing

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Devices:
    """n devices. SI; (n, 3) by chain, (n,) where nothing is said."""

    crank_m: float
    """L1, the same for all"""
    height_m: Array
    """z_0"""
    projection_m: Array
    """delta_0 (n, 3): an upper layer that is misaligned makes links of unlike length"""
    slider_n_per_m: Array
    """4 K_1 (n, 3)"""
    crank_n_m_per_rad: Array
    """4 K_2 (n, 3)"""
    link_n_m_per_rad: Array
    """4 c K_3, of all chains together"""
    lateral_n_per_m: Array
    """4 K_l1 (n, 3) of a slider at rest"""
    leaf_m: Array
    """width of the leaves, mean over their height (n, 3)"""
    mass_kg: Array
    quality_factor: Array
    comb_n_per_v2: Array
    """force gain (n, 3)"""
    comb_gain: Array
    """the same over the drawing's"""
    sense_gain: Array
    """capacitance per stroke over the drawing's (n, 3)"""
    side_gap_m: Array
    """gap (n, 3) that a comb of straight fingers in their middle would have with the same side stiffness per pull"""
    side_offset: Array
    """how far fingers stand aside of their gaps' middle, in such gaps (n, 3)"""
    overlap_m: float
    film_valid: NDArray[np.bool_]
    """whether the films of air move as the damping's formulas take it"""

    def take(self, rows: NDArray[np.int64]) -> "Devices":
        """Some of them."""
        some: dict[str, Any] = {k: v[rows] if isinstance(v, np.ndarray) else v for k, v in vars(self).items()}
        return Devices(**some)

    def __len__(self) -> int:
        return len(self.mass_kg)


def made(stage: StageConfig, process: Process, size: Mapping[str, Array]) -> Devices:
    """The devices that ``size``, (n, 3) of each of ``SOURCES``, makes of a drawing.

    Raises ``ValueError`` for a drawing of which the process leaves nothing: a width, gap or height not above 0.
    """
    f, g = stage.flexures, stage.geometry
    bias, lean, e = size["etch_bias_m"], size["sidewall_rad"], f.youngs_modulus_pa * (1.0 + size["youngs_modulus"])
    layer = size["layer_1_m"]
    leaf_h, crank_h = f.leaf_height_m + layer, f.crank_hinge_height_m + layer
    leaf, leaf_cubed = _line(f.leaf_thickness_m - bias, lean, leaf_h)
    _, crank_cubed = _line(f.crank_hinge_thickness_m - bias, lean, crank_h)
    hinge = f.link_hinge_thickness_m + size["hinge_m"]
    along, across = modulus_by_drawing(process.silicon, f.youngs_modulus_pa)
    stress = process.made_of.stress_left * size["residual_stress_pa"]
    length = sum(
        part**3 / (1.0 + 1.2 * stress * part**2 / (e * across * leaf**2))
        for part in (f.leaf_inner_length_m, f.leaf_outer_length_m)
    )
    modulus_leaf, modulus_crank = e * across, e * along
    slider = 16.0 * modulus_leaf * leaf_h * leaf_cubed / length
    crank = modulus_crank * crank_h * crank_cubed / (3.0 * f.crank_hinge_length_m)
    link = (e * along * (f.link_hinge_width_m - bias) * hinge**3).mean(axis=1) * (
        f.out_of_plane_chains / (3.0 * f.link_hinge_length_m)
    )
    lateral = 16.0 * modulus_leaf * leaf_h * leaf / (f.leaf_inner_length_m + f.leaf_outer_length_m)
    mass = stage.dynamics.mass_kg * _mass_ratio(process, size, f.leaf_height_m)
    drive, sense = (_Comb(comb, process, size, f.leaf_height_m) for comb in (stage.drive_comb, stage.sense_comb))
    projection, height = _link(stage, process, size)
    _require({"leaf width": leaf, "hinge": hinge, "layer 1": leaf_h, "comb gap": drive.top_m, "mass": mass,
              "comb gap downwards": drive.bottom_m, "sense gap": sense.top_m, "sense gap downwards": sense.bottom_m,
              "handle": height, "slider": slider, "crank hinge": crank_cubed,
              "fingers' common height": drive.height_m, "sense fingers' common height": sense.height_m})  # fmt: skip
    pressure = size["pressure_pa"].mean(axis=1)
    if not (pressure >= 0.0).all():
        raise ValueError(
            f"the process leaves a pressure of {pressure.min():.3g} Pa for some device; its spread is too wide"
        )
    quality, valid = quality_factor(
        stage, process.made_of, pressure, mass, slider, crank, leaf_h,
        (drive.shear_area_m, sense.shear_area_m),
    )  # fmt: skip
    return Devices(
        g.crank_length_m, height, projection, slider, crank, link, lateral, leaf, mass, quality, drive.gain_n_per_v2,
        drive.ratio, sense.ratio, drive.side_gap_m, drive.side_offset, stage.drive_comb.overlap_rest_m, valid,
    )  # fmt: skip


def _require(positive: Mapping[str, Array]) -> None:
    for name, values in positive.items():
        if not (values > 0.0).all():
            raise ValueError(
                f"the process leaves no {name}: {values.min():.3g} for some device; its spread is too wide"
            )


def _line(top_m: Array, lean: Array, height_m: Array) -> tuple[Array, Array]:
    """Mean width of lines over their height, and the mean of its cube."""
    taper = lean * height_m
    width = top_m - taper
    return width, width * (width * width + taper * taper)


def _mass_ratio(process: Process, size: Mapping[str, Array], layer_1_m: float) -> Array:
    m = process.made_of
    heights = (
        m.mass_layer_1 * (1.0 + size["layer_1_m"] / layer_1_m)
        + m.mass_handle * (1.0 + size["handle_m"] / m.handle_m)
        + m.mass_layer_2 * (1.0 + size["layer_2_m"] / m.layer_2_m)
    )
    lost = (size["etch_bias_m"] + size["sidewall_rad"] * (layer_1_m + size["layer_1_m"])) / m.truss_m
    return np.asarray((heights * (1.0 - lost)).mean(axis=1))


def _link(stage: StageConfig, process: Process, size: Mapping[str, Array]) -> tuple[Array, Array]:
    """delta_0 (n, 3) and z_0 (n,): the hinges stand half their thickness in the layers on both sides of the handle."""
    g = stage.geometry
    height = g.height_rest_m + (size["handle_m"] + size["hinge_m"]).mean(axis=1)
    x, y = size["alignment_x_m"].mean(axis=1), size["alignment_y_m"].mean(axis=1)
    inward = np.radians([90.0, 210.0, 330.0])
    shift = x[:, None] * np.cos(inward) + y[:, None] * np.sin(inward)
    return g.projection_rest_m + shift, height


class _Comb:
    """Fingers whose gap widens downwards, and which stand aside of its middle."""

    def __init__(self, comb: CombConfig, process: Process, size: Mapping[str, Array], layer_1_m: float) -> None:
        arm = process.made_of.comb_arm_m / process.wafer.diameter_m
        lifted = 4.0 * np.abs(size["wafer_bow_m"]) * arm**2
        made_h = comb.finger_height_m * (1.0 + size["layer_1_m"] / layer_1_m)
        self.height_m = made_h - lifted
        widening = 2.0 * size["sidewall_rad"] * made_h
        top = comb.finger_gap_m + size["etch_bias_m"] + size["comb_gap_m"]
        self.top_m, self.bottom_m = top, top + widening
        per_gap = _mean_inverse(self.top_m, widening)
        aside = (size["finger_offset_m"] * per_gap) ** 2
        self.gain_n_per_v2 = comb.finger_count * EPSILON_0_F_PER_M * self.height_m * per_gap / (1.0 - aside)
        drawn = comb.finger_count * EPSILON_0_F_PER_M * comb.finger_height_m / comb.finger_gap_m
        self.ratio = self.gain_n_per_v2 / drawn
        per_gap_cubed = (self.top_m + self.bottom_m) / (2.0 * (self.top_m * self.bottom_m) ** 2)
        self.side_gap_m = np.sqrt(per_gap / per_gap_cubed)
        self.side_offset = np.abs(size["finger_offset_m"]) / self.side_gap_m
        self.shear_area_m = 2.0 * comb.finger_count * self.height_m * comb.overlap_rest_m * per_gap


def _mean_inverse(top_m: Array, widening_m: Array) -> Array:
    """Mean of 1 / gap over a gap that widens evenly: ln(1 + x) / x over the gap at its top."""
    x = widening_m / top_m
    small = np.abs(x) < 1e-4
    safe = np.where(small, 1.0, x)
    series = 1.0 - x * (0.5 - x * (1.0 / 3.0 - x / 4.0))
    with np.errstate(invalid="ignore", divide="ignore"):  # of no gap at all, which is refused
        return np.asarray(np.where(small, series, np.log1p(safe) / safe) / top_m)


def side_left(offset: Array) -> Array:
    """Share of the lateral stiffness that side pull may reach before fingers snap which stand ``offset`` aside, in
    gaps (0 to 1).

    Pull P (1 / (g - D)^2 - 1 / (g + D)^2) and spring K (D - d) touch where 4 D^3 - 3 d D^2 - d g^2 = 0; there P is
    K g^3 / 4 times (1 - u^2)^3 / (1 + 3 u^2) with u = D / g. Without offset that is 1.
    """
    d = np.asarray(offset, dtype=np.float64)
    u = np.cbrt(d) + d  # above the root, where the cubic is convex: Newton comes down to it
    for _ in range(12):
        value = 4.0 * u**3 - 3.0 * d * u**2 - d
        slope = 12.0 * u**2 - 6.0 * d * u
        u = u - np.where(slope > 0.0, value / np.where(slope > 0.0, slope, 1.0), 0.0)
    u = np.minimum(u, 1.0)
    return np.asarray((1.0 - u * u) ** 3 / (1.0 + 3.0 * u * u))


def as_drawn(stage: StageConfig, process: Process) -> Devices:
    """One device exactly as drawn, at the pressure at which the stage file's quality factor holds."""
    size = {name: np.zeros((1, 3)) for name in SOURCES}
    size["pressure_pa"] = np.full((1, 3), process.made_of.reference_pressure_pa)
    plain = process.model_copy(update={"silicon": process.silicon.model_copy(update={"plane": "drawn"})})
    return made(stage, plain, size)
