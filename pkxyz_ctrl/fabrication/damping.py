"""Quality factor from the pressure of the gas: sheared films between fingers, squeezed films between leaves, the rest.

    Q = m w / c,   c = c_slide + c_squeeze + c_rest + m w / Q_vacuum

- Slide film (Couette, with slip): eta / (1 + 2 Kn + 0.2 Kn^0.788 exp(-Kn / 10)) A / g (Veijola, Turowski: J. MEMS 10
  (2001) 263).
- Squeeze film: a long strip of height h at a gap g, eta / (1 + 9.638 Kn^1.159) h^3 / g^3 per length (Veijola et al.:
  Sensors and Actuators A 48 (1995) 239). Valid without compression: squeeze number 12 eta w h^2 / (p g^2) below 1.
- The rest (plates, links, trenches) is not in the drawing: it is what the stage file's quality factor leaves at the
  reference pressure, and thins out with the slide film's law over a gap of its own.

Kn is the mean free path over the gap, the path 66 nm at an atmosphere (Jennings: J. Aerosol Science 19 (1988) 159) and
inverse to the pressure. The fits hold up to Kn = 880. At 0 Pa only Q_vacuum is left.
"""

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.elements.flexures import crank_hinge_stiffness, folded_spring_stiffness
from pkxyz_ctrl.fabrication.process import MadeOfConfig

Array = NDArray[np.float64]

VISCOSITY_PA_S = 18.3e-6
"""Air at 20 C; it does not depend on the pressure."""
ATMOSPHERE_PA = 101325.0
FREE_PATH_M = 66.0e-9
"""at an atmosphere"""
KNUDSEN_MAX = 880.0
SQUEEZE_MAX = 1.0

_IN_PLANE = 1.5
"""sum of the squares of e_i along any direction in the plane"""
_LEAVES = 8.0
"""of each length on a slider: four folded springs with two each"""


def knudsen(pressure_pa: Array, gap_m: float | Array) -> Array:
    """Mean free path over a gap; infinite without gas."""
    with np.errstate(divide="ignore"):
        return np.asarray(FREE_PATH_M * ATMOSPHERE_PA / (pressure_pa * gap_m))


def sliding_viscosity_pa_s(kn: Array) -> Array:
    """Effective viscosity of a sheared film."""
    between = np.where(np.isinf(kn), 0.0, kn)  # without gas there is nothing of the second term
    return np.asarray(VISCOSITY_PA_S / (1.0 + 2.0 * kn + 0.2 * between**0.788 * np.exp(-between / 10.0)))


def squeezed_viscosity_pa_s(kn: Array) -> Array:
    """Effective viscosity of a squeezed film."""
    return np.asarray(VISCOSITY_PA_S / (1.0 + 9.638 * kn**1.159))


def quality_factor(
    stage: StageConfig,
    made_of: MadeOfConfig,
    pressure_pa: Array,
    mass_kg: Array,
    slider_n_per_m: Array,
    crank_n_m_per_rad: Array,
    leaf_height_m: Array,
    sheared_m: tuple[Array, Array],
) -> tuple[Array, NDArray[np.bool_]]:
    """Quality factor (n,) of the in-plane modes, and whether the formulas hold. ``sheared_m`` (n, 3): area over gap of
    drive and sense combs at rest; they are taken at mid-stroke.

    Raises ``ValueError`` where the films alone damp the drawing more than its stage file says.
    """
    f, l1 = stage.flexures, stage.geometry.crank_length_m
    inner, outer = _leaf_lengths(stage)
    drawn_k = 6.0 * (folded_spring_stiffness(f) + crank_hinge_stiffness(f) / l1**2)
    drawn_m, reference = stage.dynamics.mass_kg, np.array(made_of.reference_pressure_pa)
    drawn_total = np.sqrt(drawn_m * drawn_k) * (
        1.0 / stage.dynamics.quality_factor - 1.0 / made_of.vacuum_quality_factor
    )
    combs = (stage.drive_comb, stage.sense_comb)
    longer = [1.0 + 0.5 * (stage.limits.stroke_min_m + stage.limits.stroke_max_m) / c.overlap_rest_m for c in combs]

    def films(pressure: Array, sheared: list[Array], height: Array) -> Array:
        slide = sum(
            sliding_viscosity_pa_s(knudsen(pressure, c.finger_gap_m)) * s * longer[k]
            for k, (c, s) in enumerate(zip(combs, sheared, strict=True))
        )
        ratio = (height / made_of.leaf_gap_m) ** 3
        squeeze = squeezed_viscosity_pa_s(knudsen(pressure, made_of.leaf_gap_m)) * _LEAVES * (inner + outer) * ratio
        return np.asarray(_IN_PLANE * (slide + squeeze))

    drawn_sheared = [
        np.array(2.0 * c.finger_count * c.finger_height_m * c.overlap_rest_m / c.finger_gap_m) for c in combs
    ]
    rest = drawn_total - films(reference, drawn_sheared, np.array(f.leaf_height_m))
    if not rest > 0.0:
        raise ValueError(
            "the films alone damp more than the stage file's quality factor says: widen made_of.leaf_gap_m"
        )
    tie = sliding_viscosity_pa_s(knudsen(pressure_pa, made_of.drag_gap_m)) / sliding_viscosity_pa_s(
        knudsen(reference, made_of.drag_gap_m)
    )
    stiffness = _IN_PLANE * (slider_n_per_m + crank_n_m_per_rad / l1**2).mean(axis=1)
    impedance = np.sqrt(mass_kg * stiffness)
    total = films(pressure_pa, [s.mean(axis=1) for s in sheared_m], leaf_height_m.mean(axis=1)) + rest * tie
    w = np.sqrt(stiffness / mass_kg)
    with np.errstate(divide="ignore"):
        squeeze_number = (
            12.0 * VISCOSITY_PA_S * w * (leaf_height_m.mean(axis=1) / made_of.leaf_gap_m) ** 2 / pressure_pa
        )
    gap = min(c.finger_gap_m for c in combs)
    valid = (squeeze_number < SQUEEZE_MAX) & (knudsen(pressure_pa, gap) < KNUDSEN_MAX)
    return np.asarray(impedance / (total + impedance / made_of.vacuum_quality_factor)), np.asarray(valid)


def _leaf_lengths(stage: StageConfig) -> tuple[float, float]:
    """Lengths of the leaves times the mean square of their speed over the slider's, ends clamped: s = 3 x^2 - 2 x^3 has
    13/35 in the square and 1/2 in the mean.
    """
    f = stage.flexures
    inner, outer = f.leaf_inner_length_m, f.leaf_outer_length_m
    truss = inner**3 / (inner**3 + outer**3)
    rest = 1.0 - truss
    return inner * truss**2 * 13.0 / 35.0, outer * (truss**2 + truss * rest + rest**2 * 13.0 / 35.0)
