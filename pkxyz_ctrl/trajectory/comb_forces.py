"""Comb forces that a motion takes, B^-T (grad V + C v + m a), compiled: for what is asked before anything moves, and
between two ticks.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pkxyz_ctrl.core import elasticity, kinematics
from pkxyz_ctrl.core.linear3 import inverse3, multiply3_transposed
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]
Records = NDArray[np.void]

ROUNDING_M = 1e-12
"""Far below anything measurable; a reference that goes to a limit exactly is allowed."""
ROUNDING_N = 1e-12

INERTIA = np.dtype([("damping_n_s_per_m", "f8", (3, 3)), ("mass_kg", "f8")], align=True)


def inertia_of(stage: Stage) -> Records:
    """(1,) of ``INERTIA``. Damping is that of the stage file, modal about rest: C = sqrt(m) K(0)^(1/2) / Q."""
    inertia = np.zeros(1, INERTIA)
    eigenvalue, mode = np.linalg.eigh(stage.stiffness(np.zeros(3)))
    inertia["damping_n_s_per_m"] = (
        math.sqrt(stage.mass_kg) / stage.quality_factor * (mode * np.sqrt(eigenvalue)) @ mode.T
    )
    inertia["mass_kg"] = stage.mass_kg
    return inertia


def comb_forces(stage: Stage, rows: Array) -> Array:
    """Comb forces (n, 3) in N that let the platform follow rows (n, 9) of a trajectory; negative where that is a push.

    Raises ``StageDomainError`` where a link can't reach.
    """
    stage.inverse_kinematics(rows[:, 0:3])
    force = np.empty((len(rows), 3))
    _forces_each(stage.geometry, stage.elasticity, inertia_of(stage), np.ascontiguousarray(rows), force)
    return force


@njit(cache=True)
def forces_of(geometry: np.void, elastic: np.void, inertia: np.void, row: Array, force_n: Array) -> None:
    """Comb forces (3,) for a row (9,) of a reference, whose position the links reach."""
    position, demand = row[0:3], np.empty(3)
    pulls, inverse = np.empty((3, 3)), np.empty((3, 3))
    elasticity.energy_gradient(geometry, elastic, position, demand)
    damping = inertia["damping_n_s_per_m"]
    for i in range(3):
        demand[i] += inertia["mass_kg"] * row[6 + i]
        for k in range(3):
            demand[i] += damping[i, k] * row[3 + k]
    kinematics.pulls(geometry, position, pulls)
    inverse3(pulls, inverse)
    multiply3_transposed(inverse, demand, force_n)


@njit(cache=True)
def _forces_each(geometry: Records, elastic: Records, inertia: Records, rows: Array, force_n: Array) -> None:
    for n in range(len(rows)):
        forces_of(geometry[0], elastic[0], inertia[0], rows[n], force_n[n])
