"""Young's modulus of silicon by direction in the plane of the wafer: what a mechanism of three chains meets on a
crystal of four (Hopcroft, Nix, Kenny: What is the Young's modulus of silicon?, J. MEMS 19 (2010) 229).
"""

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.fabrication.process import SiliconConfig

Array = NDArray[np.float64]

C_11_PA, C_12_PA, C_44_PA = 165.7e9, 63.9e9, 79.6e9
"""Stiffnesses of the cubic crystal at room temperature, lightly doped (Hopcroft et al., after Hall 1967)."""
_DET = (C_11_PA - C_12_PA) * (C_11_PA + 2.0 * C_12_PA)
S_11, S_12, S_44 = (C_11_PA + C_12_PA) / _DET, -C_12_PA / _DET, 1.0 / C_44_PA
"""Compliances in 1/Pa."""

INWARD_RAD = np.radians([90.0, 210.0, 330.0])


def modulus_pa(direction: Array) -> Array:
    """Young's modulus (...) in Pa along unit vectors (..., 3) in the crystal's axes: 1/E = S_11 - 2 (S_11 - S_12 -
    S_44 / 2) (l^2 m^2 + m^2 n^2 + n^2 l^2).
    """
    squares = np.asarray(direction, dtype=np.float64) ** 2
    mixed = squares[..., 0] * squares[..., 1] + squares[..., 1] * squares[..., 2] + squares[..., 2] * squares[..., 0]
    return np.asarray(1.0 / (S_11 - 2.0 * (S_11 - S_12 - 0.5 * S_44) * mixed))


def in_plane_modulus_pa(silicon: SiliconConfig, angle_rad: Array) -> Array:
    """Modulus (...) along directions at angles (...) from x in the wafer's plane."""
    root2, root6 = np.sqrt([2.0, 6.0])
    along = np.array([1.0, -1.0, 0.0]) / root2
    across = np.array([1.0, 1.0, 0.0]) / root2 if silicon.plane == "100" else np.array([1.0, 1.0, -2.0]) / root6
    turned = np.asarray(angle_rad, dtype=np.float64)[..., None] - silicon.flat_rad
    return modulus_pa(np.cos(turned) * along + np.sin(turned) * across)


def modulus_by_drawing(silicon: SiliconConfig, drawn_pa: float) -> tuple[Array, Array]:
    """Modulus (3,) of the chains over the drawing's, along the way of their sliders (cranks, links) and across it
    (leaves).
    """
    if silicon.plane == "drawn":
        return np.ones(3), np.ones(3)
    along, across = (in_plane_modulus_pa(silicon, INWARD_RAD + turn) / drawn_pa for turn in (0.0, 0.5 * np.pi))
    return along, across
