"""What the platform reaches: the image of the box of strokes,
and the part of it that voltages below a limit can hold.

Volumes are integrals of det(dx/dq) over strokes (dx/dq is the inverse of ``Stage.jacobian``), taken
along rays from the stroke nearest to rest: the box is cut into one pyramid for each face, and on every
ray the held part is a set of intervals whose ends are found by bisection. Both volumes come at two
resolutions; their difference is the error estimate.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize

from pkxyz_ctrl.elements.errors import GeometryError
from pkxyz_ctrl.stage import Stage, StageDomainError

Array = NDArray[np.float64]

_HELD_RTOL = 1e-3
_CELLS_MAX = 128
_PUSH_N = 1e-15
"""Forces above minus this count as pulls: at rest rounding decides the sign of 0."""


@dataclass(frozen=True)
class Volume:
    """A volume in m^3 and the difference to the same integral at half the resolution."""

    value_m3: float
    error_m3: float


@dataclass(frozen=True)
class Workspace:
    """The box of strokes as the platform sees it. Positions in m relative to rest."""

    linear_volume_m3: float
    """Parallelepiped of Eq. 35 with the Jacobian at mid-stroke, as the paper takes it."""
    exact_volume: Volume
    linear_low_m: Array
    linear_high_m: Array
    exact_low_m: Array
    exact_high_m: Array
    """Extents (3,) along x, y, z."""


def stroke_box(stage: Stage) -> tuple[float, float]:
    """The stroke limits (low, high) in m of all three sliders;
    a ``GeometryError`` if the links do not close on its corners.
    """
    limits = stage.config.limits
    low, high = limits.stroke_min_m, limits.stroke_max_m
    try:
        corners = stage.forward_kinematics(box_corners(low, high))
    except StageDomainError as error:
        raise GeometryError(f"links cannot close over strokes {low * 1e6:g}..{high * 1e6:g} um: {error}") from None
    if not (np.linalg.det(stage.jacobian(corners)) > 0).all():
        raise GeometryError("0 < alpha is violated: the links pass through the plane within the strokes")
    return low, high


def box_corners(low: float, high: float) -> Array:
    """Corners (8, 3) of the cube [low, high]^3, the last coordinate changing fastest."""
    return np.array([[a, b, c] for a in (low, high) for b in (low, high) for c in (low, high)])


def workspace(stage: Stage) -> Workspace:
    """Volume and extents of the geometric workspace, linear (Eq. 35) and exact."""
    low, high = stroke_box(stage)
    middle = stage.forward_kinematics(np.full(3, (low + high) / 2))
    inverse = np.linalg.inv(stage.jacobian(middle))
    corners = (box_corners(low, high) - (low + high) / 2) @ inverse.T + middle
    linear = abs(np.linalg.det(inverse)) * (high - low) ** 3
    exact_low, exact_high = _exact_extents(stage, low, high)
    return Workspace(
        float(linear), geometric_volume(stage), corners.min(axis=0), corners.max(axis=0), exact_low, exact_high
    )


def geometric_volume(stage: Stage, nodes: int = 6) -> Volume:
    """Exact volume by Gauss-Legendre quadrature of det(dx/dq), ``nodes`` to an axis."""
    low, high = stroke_box(stage)
    fine, coarse = (_gauss_volume(stage, low, high, n) for n in (nodes, max(1, nodes // 2)))
    return Volume(fine, abs(fine - coarse))


def voltage_needed_v(stage: Stage, strokes_m: ArrayLike) -> Array:
    """Highest of the three comb voltages (...) in V that hold strokes (..., 3),
    without limit; NaN where a comb must push.
    """
    force = stage.holding_forces(stage.forward_kinematics(strokes_m))
    pull = np.where(abs(force) < _PUSH_N, 0.0, force)
    return np.asarray(np.sqrt(np.where(pull >= 0, pull, np.nan) / stage.force_gain_n_per_v2).max(axis=-1))


def held_volume(stage: Stage, voltage_max_v: float, cells: int = 32) -> Volume:
    """Volume that voltages up to ``voltage_max_v`` hold (all three combs within
    0..limit), by rays, ``cells``^2 to a pyramid.

    Cells are doubled until the error estimate is below 1e-3; with strokes from 0 the first count gives 1e-6, but
    where strokes below rest are allowed, the limit of no push runs along the rays. An interval of a ray shorter
    than a sixteenth of it can be missed; the shipped stages have one interval to a ray.
    """
    if not (np.isfinite(voltage_max_v) and voltage_max_v > 0):
        raise GeometryError(f"voltage_max_v > 0 is violated: voltage_max_v = {voltage_max_v:g}")
    low, high = stroke_box(stage)
    coarse = _held_volume(stage, low, high, voltage_max_v, max(1, cells // 2))
    while True:
        fine = _held_volume(stage, low, high, voltage_max_v, cells)
        if abs(fine - coarse) <= _HELD_RTOL * fine or cells >= _CELLS_MAX:
            return Volume(fine, abs(fine - coarse))
        coarse, cells = fine, 2 * cells


def _gauss_volume(stage: Stage, low: float, high: float, nodes: int) -> float:
    x, w = np.polynomial.legendre.leggauss(nodes)
    q = low + (high - low) * (x + 1) / 2
    strokes = np.stack(np.meshgrid(q, q, q, indexing="ij"), axis=-1)
    weights = w[:, None, None] * w[None, :, None] * w[None, None, :] * ((high - low) / 2) ** 3
    return float((weights * _expansion(stage, strokes)).sum())


def _expansion(stage: Stage, strokes_m: Array) -> Array:
    """det(dx/dq) (...) at strokes (..., 3)."""
    return np.asarray(1 / np.linalg.det(stage.jacobian(stage.forward_kinematics(strokes_m))))


def _held(stage: Stage, strokes_m: Array, force_max_n: Array) -> NDArray[np.bool_]:
    force = stage.holding_forces(stage.forward_kinematics(strokes_m))
    return np.asarray((force >= -_PUSH_N).all(axis=-1) & (force <= force_max_n).all(axis=-1))


def _held_volume(stage: Stage, low: float, high: float, voltage_max_v: float, cells: int) -> float:
    force_max = stage.force_gain_n_per_v2 * voltage_max_v**2
    apex = np.full(3, min(max(0.0, low), high))
    edge, weight = _composite_gauss(cells, low, high)
    total = 0.0
    for axis in range(3):
        for bound in (low, high):
            height = abs(bound - apex[axis])
            if height == 0:
                continue
            across = np.stack(np.meshgrid(edge, edge, indexing="ij"), axis=-1).reshape(-1, 2)
            rays = np.insert(across, axis, bound, axis=1) - apex
            area = (weight[:, None] * weight[None, :]).ravel()
            total += float((area * height * _held_along(stage, apex, rays, force_max)).sum())
    return total


def _composite_gauss(cells: int, low: float, high: float) -> tuple[Array, Array]:
    """Two-point Gauss rule on ``cells`` equal cells of [low, high]: nodes and weights (2 cells,)."""
    width = (high - low) / cells
    centres = low + width * (np.arange(cells) + 0.5)
    offset = width / (2 * np.sqrt(3))
    return np.sort(np.concatenate([centres - offset, centres + offset])), np.full(2 * cells, width / 2)


def _held_along(stage: Stage, apex: Array, rays: Array, force_max_n: Array) -> Array:
    """Integral of u^2 det(dx/dq) over the held u in (0, 1] along each ray apex + u d (n, 3): (n,)."""
    stations = np.linspace(0, 1, 17)
    held = np.stack([_held(stage, apex + u * rays, force_max_n) for u in stations], axis=1)
    ray, cell = np.nonzero(held[:, 1:] != held[:, :-1])
    below, above = stations[cell].copy(), stations[cell + 1].copy()
    inner = held[ray, cell]
    for _ in range(30):
        middle = (below + above) / 2
        same = _held(stage, apex + middle[:, None] * rays[ray], force_max_n) == inner
        below, above = np.where(same, middle, below), np.where(same, above, middle)
    # signed sum: the held set's upper ends count plus, its lower ends minus, and a ray held at its tip ends at 1
    upto = np.zeros(len(rays))
    np.add.at(upto, ray, np.where(inner, 1.0, -1.0) * _integral_to(stage, apex, rays[ray], (below + above) / 2))
    tip = held[:, -1]
    upto[tip] += _integral_to(stage, apex, rays[tip], np.ones(int(tip.sum())))
    return upto


def _integral_to(stage: Stage, apex: Array, rays: Array, end: Array) -> Array:
    """Integral of u^2 det(dx/dq) from 0 to ``end`` (n,) along each ray, by five Gauss nodes."""
    x, w = np.polynomial.legendre.leggauss(5)
    u = end[:, None] * (x + 1) / 2
    values = u**2 * _expansion(stage, apex + u[..., None] * rays[:, None, :])
    return np.asarray((values * w).sum(axis=1) * end / 2)


def _exact_extents(stage: Stage, low: float, high: float) -> tuple[Array, Array]:
    """Lowest and highest x, y, z (3,) each over the box: bounded descent from every corner, as no axis is monotone
    in all strokes.
    """
    scale = high - low
    found = np.empty((2, 3))
    for axis in range(3):
        for row, sign in enumerate((1.0, -1.0)):

            def signed(u: Array, axis: int = axis, sign: float = sign) -> tuple[float, Array]:
                position = stage.forward_kinematics(low + scale * u)
                slope = np.linalg.inv(stage.jacobian(position))[axis] * scale
                return sign * position[axis] / scale, sign * slope / scale

            best = min(
                (minimize(signed, c, jac=True, bounds=[(0, 1)] * 3).fun for c in box_corners(0.0, 1.0)), default=0.0
            )
            found[row, axis] = sign * best * scale
    return found[0], found[1]
