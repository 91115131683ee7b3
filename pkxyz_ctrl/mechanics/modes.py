"""Modes, natural frequencies and sag of the lumped platform (paper, Eq. 13, 14 and 37 to 40)."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pkxyz_ctrl.elements.errors import require_positive

Array = NDArray[np.float64]

GRAVITY_M_PER_S2 = 9.80665
"""Standard acceleration of free fall, 3rd CGPM 1901."""


class Modes(NamedTuple):
    """Undamped modes, slowest first."""

    frequency_hz: Array
    """(3,)"""
    shape: Array
    """(3, 3): column i is the unit direction of mode i at the platform."""


def modes(stiffness_n_per_m: ArrayLike, mass_kg: float) -> Modes:
    """Eq. 38 and 39: f_i = sqrt(Lambda_i / m) / 2 pi with the eigenvalues and vectors of K (3, 3).

    Raises ``ValueError`` for a stiffness that is not positive definite: such a platform does not stay where it is.
    """
    require_positive(mass_kg=mass_kg)
    eigenvalues, vectors = np.linalg.eigh(np.asarray(stiffness_n_per_m, dtype=np.float64))
    if eigenvalues[0] <= 0:
        raise ValueError(f"stiffness is not positive definite: smallest eigenvalue {eigenvalues[0]:g} N/m")
    return Modes(np.sqrt(eigenvalues / mass_kg) / (2 * math.pi), vectors)


def effective_mass_kg(stiffness_n_per_m: float, frequency_hz: float) -> float:
    """k / (2 pi f)^2: the mass that a published stiffness and frequency imply (Eq. 38 turned round)."""
    require_positive(stiffness_n_per_m=stiffness_n_per_m, frequency_hz=frequency_hz)
    return stiffness_n_per_m / (2 * math.pi * frequency_hz) ** 2


def sag_m(stiffness_n_per_m: ArrayLike, mass_kg: float, up: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """Displacement (3,) in m under the platform's own weight, ``up`` (3,) being the unit vector against gravity.

    All of the mass is taken to hang on the platform, as the paper does for its modes; its finite elements spread
    the mass over the structure and find eight times less.
    """
    require_positive(mass_kg=mass_kg)
    return np.asarray(
        np.linalg.solve(np.asarray(stiffness_n_per_m, float), -mass_kg * GRAVITY_M_PER_S2 * np.asarray(up, float))
    )
