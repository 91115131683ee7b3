"""What a linear model of the kinematics costs: position error over the workspace against the exact solution.

The paper uses one constant Jacobian everywhere (Eq. 35, with ``d lambda = J_1^-1 dx``: the text prints it the
wrong way round). The alternatives are to linearise anew at each set-point, as the controller's law does, and to
follow the constant Jacobian by one Newton step on the exact one, as a cold start would do.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.elements.errors import require_positive
from pkxyz_ctrl.mechanics.workspace import stroke_box
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LinearisationStudy:
    """Errors (n, 3) in m, estimate minus truth along x, y, z, at the positions (n,
    3) of a regular grid of strokes (n, 3).
    """

    strokes_m: Array
    position_m: Array
    at_rest_m: Array
    """One constant Jacobian, taken at rest."""
    at_middle_m: Array
    """One constant Jacobian, taken where all sliders are at mid-stroke (the paper's choice, Eq. 36)."""
    newton_m: Array
    """The estimate of ``at_rest_m`` followed by one Newton step."""
    relinearised_m: Array
    """Jacobian at the set-point: the worst error along each axis over moves of up to
    ``move_m`` on each axis away from it.
    """
    move_m: float


def linearisation_study(stage: Stage, points: int = 9, move_m: float = 1e-6) -> LinearisationStudy:
    """The study on a grid of ``points``^3 strokes. Raises ``GeometryError`` where the links do not close."""
    require_positive(move_m=move_m)
    low, high = stroke_box(stage)
    line = np.linspace(low, high, points)
    strokes = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    position = stage.forward_kinematics(strokes)
    rest = constant_jacobian_position_m(stage, strokes, np.zeros(3))
    middle = constant_jacobian_position_m(stage, strokes, np.full(3, (low + high) / 2))
    return LinearisationStudy(
        strokes,
        position,
        rest - position,
        middle - position,
        newton_corrected_m(stage, strokes, rest) - position,
        _worst_of_moves(stage, position, move_m),
        move_m,
    )


def constant_jacobian_position_m(stage: Stage, strokes_m: Array, about_strokes_m: Array) -> Array:
    """x_0 + J(x_0)^-1 (q - q_0) (..., 3) in m for strokes (..., 3),
    x_0 being the position of ``about_strokes_m`` (3,).
    """
    about = stage.forward_kinematics(about_strokes_m)
    inverse = np.linalg.inv(stage.jacobian(about))
    return np.asarray(about + (strokes_m - about_strokes_m) @ inverse.T)


def newton_corrected_m(stage: Stage, strokes_m: Array, estimate_m: Array) -> Array:
    """``estimate_m`` (..., 3) after one Newton step towards the position of ``strokes_m`` (..., 3)."""
    miss = strokes_m - stage.inverse_kinematics(estimate_m)
    return np.asarray(estimate_m + np.linalg.solve(stage.jacobian(estimate_m), miss[..., None])[..., 0])


def _worst_of_moves(stage: Stage, set_point_m: Array, move_m: float) -> Array:
    steps = np.array([[a, b, c] for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1)]) * move_m
    there = set_point_m[:, None] + steps
    moved = stage.inverse_kinematics(there) - stage.inverse_kinematics(set_point_m)[:, None]
    estimate = np.linalg.solve(stage.jacobian(set_point_m)[:, None], moved[..., None])[..., 0]
    return np.asarray(np.abs(estimate - steps).max(axis=1))
