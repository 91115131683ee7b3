"""The coordinates of the sample: stage = origin + turn . scale . sample. Targets come, and positions go out, in these.

The stage's own are kept in every record of the loop; whoever stands between the loop and people turns them.
"""

import math
from functools import lru_cache
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pkxyz_ctrl.config.files import FrozenModel

Array = NDArray[np.float64]

_ORIGIN_MOST_M, _SLOPE_MOST = 100e-6, 0.5
_THIN = 1e-3  # least height of a triangle over its longest side, from which a plane is told

Slope = Annotated[float, Field(ge=-_SLOPE_MOST, le=_SLOPE_MOST)]
Scale = Annotated[float, Field(ge=0.5, le=2.0)]
Metres = Annotated[float, Field(ge=-_ORIGIN_MOST_M, le=_ORIGIN_MOST_M)]


class SampleAxes(FrozenModel):
    """Where the sample lies on the stage."""

    origin_m: tuple[Metres, Metres, Metres] = (0.0, 0.0, 0.0)
    """of the sample, in the stage's coordinates"""
    rotation_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0
    """of the sample about its normal, from the stage's x towards its y"""
    slope_x: Slope = 0.0
    """tilt: how far the sample's plane rises along the stage's x, m/m"""
    slope_y: Slope = 0.0
    """the same along y"""
    scale: tuple[Scale, Scale, Scale] = (1.0, 1.0, 1.0)
    """metres of the stage for each metre of the sample"""

    def matrix(self) -> Array:
        """(3, 4): turn and scale, and the origin."""
        turned = _tilted(self.slope_x, self.slope_y) @ _about_z(math.radians(self.rotation_deg)) @ np.diag(self.scale)
        return np.concatenate([turned, np.array(self.origin_m)[:, None]], axis=1)

    def through(self, points_m: Array) -> "SampleAxes":
        """With the sample's plane z = 0 through three points (3, 3) of the stage, the origin moved along z into it.
        Raises ``ValueError`` for points that tell no plane, or one that is too steep.
        """
        a, b, c = points_m
        sides = [b - a, c - a, c - b]
        normal = np.cross(sides[0], sides[1])
        longest = max(float(np.linalg.norm(side)) for side in sides)
        if not np.isfinite(points_m).all() or not np.linalg.norm(normal) > _THIN * longest**2:
            raise ValueError("three points that lie in a line tell no plane: take them further apart")
        if not abs(normal[2]) * _SLOPE_MOST >= float(np.abs(normal[:2]).max()):
            raise ValueError(f"the plane through these points is steeper than {_SLOPE_MOST:g} m/m")
        slope = -normal[:2] / normal[2]
        x, y, _ = self.origin_m
        z = float(a[2] + slope @ (np.array([x, y]) - a[:2]))
        if not abs(z) <= _ORIGIN_MOST_M:
            raise ValueError(f"that plane meets the origin's x and y at z = {z * 1e6:.4g} um: move the origin first")
        return self.model_copy(update={"slope_x": float(slope[0]), "slope_y": float(slope[1]), "origin_m": (x, y, z)})


class Turn:
    """Axes at work, from their ``matrix``."""

    def __init__(self, matrix: Array) -> None:
        """Raises ``ValueError`` for one that can't be undone."""
        self.matrix = np.array(matrix, np.float64)
        self._forth, self._origin = np.ascontiguousarray(self.matrix[:, 0:3]), self.matrix[:, 3].copy()
        if not np.isfinite(self.matrix).all() or not 0.1 <= abs(np.linalg.det(self._forth)) <= 10.0:
            raise ValueError("axes are a turn, a scale near 1 and an origin")
        self._back = np.linalg.inv(self._forth)
        self.is_plain = bool((self.matrix == PLAIN).all())
        """whether stage and sample have the same coordinates, to the last bit"""

    def to_stage(self, position_m: Array) -> Array:
        """Positions (..., 3) of the sample, as of the stage."""
        return position_m if self.is_plain else position_m @ self._forth.T + self._origin

    def way_to_stage(self, way: Array) -> Array:
        """Ways, velocities, accelerations (..., 3)."""
        return way if self.is_plain else way @ self._forth.T

    def to_sample(self, position_m: Array) -> Array:
        """Positions (..., 3) of the stage, as of the sample."""
        return position_m if self.is_plain else (position_m - self._origin) @ self._back.T

    def way_to_sample(self, way: Array) -> Array:
        """Ways, velocities (..., 3)."""
        return way if self.is_plain else way @ self._back.T


def turn_of(matrix: Array) -> Turn:
    """``Turn`` of a matrix (3, 4) that was most likely asked for before. Raises ``ValueError``."""
    return _turn(np.ascontiguousarray(matrix, np.float64).tobytes())


@lru_cache(maxsize=4)
def _turn(matrix: bytes) -> Turn:
    return Turn(np.frombuffer(matrix).reshape(3, 4))


def _about_z(angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _tilted(slope_x: float, slope_y: float) -> Array:
    """The smallest turn that takes the stage's z to the normal of a plane."""
    normal = np.array([-slope_x, -slope_y, 1.0]) / math.sqrt(1.0 + slope_x**2 + slope_y**2)
    cross = np.array([[0.0, 0.0, normal[0]], [0.0, 0.0, normal[1]], [-normal[0], -normal[1], 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + normal[2])


PLAIN: Array = SampleAxes().matrix()
"""The sample's coordinates are the stage's."""
