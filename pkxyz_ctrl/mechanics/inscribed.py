"""The largest cube inside the workspace, with its faces along the axes or turned as it likes.

Every stroke is a convex function of position (``jacobians.stroke_curvature_per_m`` is never negative). So the
upper limits hold throughout a cube as soon as they hold at its corners, and each lower limit asks for the one
smallest stroke of a convex function on a cube, which bounded descent finds. The optimiser sees a grid of points;
at the end the cube is shrunk about its centre by what those exact minima still violate, so the side that is
returned is one that fits.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, root
from scipy.spatial.transform import Rotation

from pkxyz_ctrl.elements.errors import GeometryError
from pkxyz_ctrl.mechanics.workspace import box_corners, stroke_box
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]


@dataclass(frozen=True)
class InscribedCube:
    """A cube inside the workspace: centre (3,) in m relative to rest, side in m,
    edge directions as columns (3, 3).
    """

    centre_m: Array
    side_m: float
    edges: Array

    def corners_m(self) -> Array:
        """Its corners (8, 3) in m."""
        return self.centre_m + self.side_m * box_corners(-0.5, 0.5) @ self.edges.T


def inscribed_cube(stage: Stage, aligned: bool = False) -> InscribedCube:
    """The largest cube within the stroke limits; ``aligned`` keeps its edges along x, y and z.

    A local optimum from the best start we know: the workspace is nearly a cube on its corner, so the turned cube
    starts there. Raises ``GeometryError`` if the strokes enclose nothing.
    """
    low, high = stroke_box(stage)
    span = high - low
    middle = stage.forward_kinematics(np.full(3, (low + high) / 2))
    start_edges = (
        np.eye(3) if aligned else _nearest_rotation(np.asarray(np.linalg.inv(stage.jacobian(middle)), dtype=np.float64))
    )
    grid = _surface_grid(9)

    def cube(v: Array) -> InscribedCube:
        turn = np.eye(3) if aligned else Rotation.from_rotvec(v[4:7]).as_matrix()
        return InscribedCube(middle + span * v[:3], span * v[3], turn @ start_edges)

    def slack(v: Array) -> Array:
        c = cube(v)
        strokes = stage.inverse_kinematics(c.centre_m + c.side_m * grid @ c.edges.T)
        return np.concatenate([(strokes - low).ravel(), (high - strokes[:8]).ravel()]) / span

    start = np.zeros(4 if aligned else 7)
    side, rise = (0.0, 0.0) if aligned else _standing(stage)
    start[2], start[3] = rise / span, side / span or 0.3
    bounds = [(-1, 1)] * 3 + [(0, 1.5)] + [(-1, 1)] * (len(start) - 4)
    found = minimize(
        lambda v: -v[3],
        start,
        bounds=bounds,
        constraints={"type": "ineq", "fun": slack},
        method="SLSQP",
        options={"maxiter": 200, "ftol": 1e-10},
    )
    if not found.x[3] > 0:
        raise GeometryError("side > 0 is violated: no cube fits into the workspace")
    fitting = [_shrunk_to_fit(stage, cube(v), low, high) for v in (found.x, start)]
    return max(fitting, key=lambda c: c.side_m)


def standing_cube_m(stage: Stage) -> float:
    """Side in m of the largest cube that stands on its corner with the mechanism's own symmetry;
    0 where none is found.

    A hundred times faster than ``inscribed_cube``; at most 0.1 % above what fits, as
    it watches the lower limit on a grid.
    """
    return _standing(stage)[0]


def _standing(stage: Stage) -> tuple[float, float]:
    """Side and height above mid-stroke in m: least stroke at the lower limit,
    greatest at the upper; (0, 0) if none.
    """
    low, high = stroke_box(stage)
    span = high - low
    middle = stage.forward_kinematics(np.full(3, (low + high) / 2))
    edges = _nearest_rotation(np.asarray(np.linalg.inv(stage.jacobian(middle)), dtype=np.float64))
    grid = _surface_grid(5) @ edges.T

    def miss(v: Array) -> list[float]:
        points = middle + span * (v[0] * grid + np.array([0.0, 0.0, v[1]]))
        strokes = stage.inverse_kinematics(points)
        return [(float(strokes.min()) - low) / span, (float(strokes[:8].max()) - high) / span]

    found = root(miss, [0.8, 0.0], tol=1e-9)
    return (float(found.x[0]) * span, float(found.x[1]) * span) if found.success and found.x[0] > 0 else (0.0, 0.0)


def _shrunk_to_fit(stage: Stage, cube: InscribedCube, low: float, high: float) -> InscribedCube:
    side = cube.side_m
    for _ in range(40):
        trial = InscribedCube(cube.centre_m, side, cube.edges)
        excess = max(
            0.0, low - _smallest_stroke_m(stage, trial), float(stage.inverse_kinematics(trial.corners_m()).max()) - high
        )
        if excess <= 0:
            return trial
        side -= 2 * excess + 1e-13  # a stroke falls by at least half of what the side does
    raise GeometryError("stroke <= limit is violated by every cube about the optimum")


def _smallest_stroke_m(stage: Stage, cube: InscribedCube) -> float:
    """Least stroke over the cube, by bounded descent of a convex function for each chain."""
    smallest = np.inf
    for chain in range(3):

        def stroke(u: Array, chain: int = chain) -> tuple[float, Array]:
            position = cube.centre_m + cube.side_m * cube.edges @ u
            slope = cube.side_m * stage.jacobian(position)[chain] @ cube.edges
            return float(stage.inverse_kinematics(position)[chain]) * 1e6, slope * 1e6

        corner = np.argmin(stage.inverse_kinematics(cube.corners_m())[:, chain])
        start = box_corners(-0.5, 0.5)[corner]
        found = minimize(stroke, start, jac=True, bounds=[(-0.5, 0.5)] * 3, options={"ftol": 1e-15, "gtol": 1e-12})
        smallest = min(smallest, float(found.fun) * 1e-6)
    return smallest


def _nearest_rotation(matrix: Array) -> Array:
    """The rotation nearest to a matrix (its polar factor): the edges of the workspace, made orthogonal."""
    u, _, vt = np.linalg.svd(matrix)
    turn: Array = u @ vt
    return turn if np.linalg.det(turn) > 0 else -turn


def _surface_grid(count: int) -> Array:
    """Points on the surface of [-1/2, 1/2]^3, the eight corners first."""
    line = np.linspace(-0.5, 0.5, count)
    points = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    outer = (np.abs(points) == 0.5).sum(axis=1)
    return np.concatenate([box_corners(-0.5, 0.5), points[(outer >= 1) & (outer < 3)]])
