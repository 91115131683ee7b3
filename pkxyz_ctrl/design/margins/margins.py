"""How far a loop is from instability, and what it rejects: exact at the sampling instants, delays included.

With the plant P of ``loop_plant`` and a law w = -K(z) (y - r), z = exp(i 2 pi f T)::

    L = P K,   S = (I + L)^-1,   T = I - S

Per axis the loop is cut at that axis's measurement while the others stay closed, L_i = 1 / S_ii - 1; as a MIMO system
all three are changed at once. The disk margin has skew 0 (Seiler, Packard, Gahinet: An Introduction to Disk Margins,
2020): alpha = 1 / max ||S - I/2||, the loop bears every factor (1 + d/2) / (1 - d/2) with |d| < alpha in each
measurement. For the MIMO system the norm is the structured one, the factors of the axes being independent.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pkxyz_ctrl.design.margins.refine import crossings, first_above, peak
from pkxyz_ctrl.design.margins.sensitivity import Sensitivity, closed_loop
from pkxyz_ctrl.design.margins.tapped import TappedSensitivity
from pkxyz_ctrl.design.model.discrete_law import DiscreteLaw, TappedLaw, response
from pkxyz_ctrl.design.model.loop_plant import LoopPlant

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

HALF_POWER = 1.0 / math.sqrt(2.0)


@dataclass(frozen=True)
class Sensitivities:
    """Worst over frequency of an axis or of the MIMO system (largest singular value)."""

    peak_s: float
    """Ms"""
    peak_t: float
    disk_margin: float
    """0..2"""
    bandwidth_hz: float
    """up to which |S| < -3 dB from 0 on; 0 if constant errors stay"""


@dataclass(frozen=True)
class AxisMargins(Sensitivities):
    """What one axis bears alone."""

    gain_margin: float
    """factor by which the loop may grow, > 1; inf if by any"""
    gain_reduction: float
    """factor to which the loop may fall, < 1; 0 if to any"""
    phase_margin_rad: float
    delay_margin_s: float
    """additional delay, taken as a phase at the frequencies where |L| = 1"""


@dataclass(frozen=True)
class Margins:
    """Of one loop. For an unstable loop all margins are 0 and all peaks infinite."""

    stable: bool
    spectral_radius: float
    axes: tuple[AxisMargins, AxisMargins, AxisMargins]
    mimo: Sensitivities


@dataclass(frozen=True)
class LoopResponse:
    """Frequencies (m,) in Hz and L, S and T (m,3,3) at them."""

    frequency_hz: Array
    loop: Complex
    s: Complex
    t: Complex


def spectral_radius(plant: LoopPlant, law: DiscreteLaw) -> float:
    """Largest magnitude of the closed loop's eigenvalues: below 1 it is stable."""
    return float(np.abs(np.linalg.eigvals(closed_loop(plant, law))).max())


def loop_response(plant: LoopPlant, law: DiscreteLaw, frequency_hz: Array) -> LoopResponse:
    """L, S and T at frequencies (m,) above 0, up to half the sampling rate."""
    frequency = np.asarray(frequency_hz, dtype=np.float64)
    z = np.exp(2j * math.pi * frequency * plant.period_s)
    outputs = len(plant.c)
    loop = response(plant.a, plant.b, plant.c, np.zeros((outputs, plant.b.shape[1])), z)
    loop = loop @ response(law.a, law.b, law.c, law.d, z)
    s = np.asarray(np.linalg.inv(np.eye(outputs) + loop), dtype=np.complex128)
    return LoopResponse(frequency, loop, s, np.asarray(np.eye(outputs) - s))


def frequency_grid_hz(plant: LoopPlant, law: DiscreteLaw, points: int = 600) -> Array:
    """From 0.5 Hz to half the sampling rate, evenly by ratio, with more points around every pole, so that none of
    their peaks is missed.
    """
    matrices = (plant.a, law.a, closed_loop(plant, law))
    return _grid_hz(
        [np.linalg.eigvals(m).astype(np.complex128) for m in matrices if len(m)], plant.period_s, points, 12
    )


def _grid_hz(poles: Sequence[Complex], period_s: float, points: int, about: int) -> Array:
    """... with so many points on either side of each pole, out to 10 times its distance from the circle."""
    nyquist = 0.5 / period_s
    near = np.concatenate(poles)
    near = np.asarray(np.log(near[np.abs(near) > 1e-9]) / period_s / (2.0 * math.pi), dtype=np.complex128)
    near = near[near.imag > 1.0]
    around = near.imag[:, None] + np.abs(near.real)[:, None] * _about(about)
    grid = np.concatenate([_by_ratio(0.5, nyquist, points), around.ravel()])
    grid = np.unique(grid[(grid >= 0.5) & (grid <= nyquist)])
    return grid[np.diff(grid, prepend=0.0) > 1e-6 * grid]  # poles that are the same twice are one


@lru_cache(maxsize=8)
def _by_ratio(low: float, high: float, points: int) -> Array:
    return np.geomspace(low, high, points)


@lru_cache(maxsize=8)
def _about(points: int) -> Array:
    """Places by the distance from a pole (2 points + 1,)."""
    spread = np.geomspace(0.02, 10.0, points)
    return np.r_[-spread, 0.0, spread]


def margins(plant: LoopPlant, law: DiscreteLaw) -> Margins:
    """All margins of a law on a plant. Raises ``LawError`` where their periods differ."""
    sensitivity = Sensitivity(plant, law)
    radius = sensitivity.spectral_radius
    if not radius < 1.0:
        axis = AxisMargins(math.inf, math.inf, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0)
        return Margins(False, radius, (axis, axis, axis), Sensitivities(math.inf, math.inf, 0.0, 0.0))
    grid = frequency_grid_hz(plant, law)
    return replace(margins_of_response(grid, sensitivity(grid), sensitivity), spectral_radius=radius)


def margins_of_response(grid_hz: Array, s: Complex, sensitivity: Callable[[Array], Complex]) -> Margins:
    """Margins of a stable loop from its S (m,3,3) on a grid (m,), and S as a function of frequencies in Hz, with which
    what the grid shows is refined. The spectral radius is left open (NaN).
    """

    def of_axis(i: int) -> AxisMargins:
        return axis_margins(grid_hz, s[:, i, i], lambda f: sensitivity(f)[:, i, i])

    return Margins(True, math.nan, (of_axis(0), of_axis(1), of_axis(2)), _mimo(grid_hz, s, sensitivity))


def peak_sensitivity(plant: LoopPlant, law: DiscreteLaw | TappedLaw) -> float:
    """Ms of the MIMO system alone, as ``margins`` has it to 1e-4 of it; infinite for an unstable loop. For searches
    over many: a filter of taps that is given apart costs a tenth.
    """
    seen = _seen(plant, law)
    return math.inf if seen is None else _peak_sensitivity(*seen)


def peak_and_rejection(plant: LoopPlant, law: DiscreteLaw | TappedLaw) -> tuple[float, float]:
    """``peak_sensitivity``, and up to how many Hz the MIMO system's |S| < -3 dB; 0 for an unstable loop."""
    seen = _seen(plant, law)
    if seen is None:
        return math.inf, 0.0
    grid, size, size_at = seen
    return _peak_sensitivity(*seen), first_above(grid, size, size_at, HALF_POWER)


_Size = tuple[Array, Array, Callable[[Array], Array]]


def _seen(plant: LoopPlant, law: DiscreteLaw | TappedLaw) -> _Size | None:
    """Frequencies (m,), |S| there, and as a function of frequencies; None for an unstable loop."""
    if isinstance(law, TappedLaw):
        tapped = TappedSensitivity(plant, law)
        stable, grid, s = tapped.resolved(_grid_hz([tapped.base_poles], plant.period_s, 200, 6))
        return (grid, largest_singular_value(s), lambda f: largest_singular_value(tapped(f))) if stable else None
    sensitivity = Sensitivity(plant, law)
    if not sensitivity.spectral_radius < 1.0:
        return None
    grid = _grid_hz([sensitivity.poles], plant.period_s, 200, 6)
    return grid, largest_singular_value(sensitivity(grid)), lambda f: largest_singular_value(sensitivity(f))


def _peak_sensitivity(grid_hz: Array, size: Array, size_at: Callable[[Array], Array]) -> float:
    return peak(grid_hz, size, size_at, rounds=3)


def axis_margins(grid_hz: Array, s: Complex, sensitivity: Callable[[Array], Complex]) -> AxisMargins:
    """Margins of a stable loop from its sensitivity: values ``s`` (m,) on a grid, and the function itself, with which
    what the grid shows is refined.
    """
    loop = 1.0 / s - 1.0

    def loop_at(frequency_hz: Array) -> Complex:
        return np.asarray(1.0 / sensitivity(frequency_hz) - 1.0)

    real = loop_at(crossings(grid_hz, loop.imag, lambda f: loop_at(f).imag)).real
    at_end = loop[-1].real if abs(loop[-1].imag) < 1e-6 * abs(loop[-1]) else 0.0  # z = -1
    factors = [-1.0 / float(value) for value in np.append(real, at_end) if value < 0.0]
    unity = crossings(grid_hz, _log_size(loop), lambda f: _log_size(loop_at(f)))
    lags = (np.angle(loop_at(unity)) + math.pi).tolist()  # 0..2 pi, to -1
    return AxisMargins(
        peak_s=peak(grid_hz, np.abs(s), lambda f: np.abs(sensitivity(f))),
        peak_t=peak(grid_hz, np.abs(1.0 - s), lambda f: np.abs(1.0 - sensitivity(f))),
        disk_margin=1.0 / peak(grid_hz, np.abs(s - 0.5), lambda f: np.abs(sensitivity(f) - 0.5)),
        bandwidth_hz=first_above(grid_hz, np.abs(s), lambda f: np.abs(sensitivity(f)), HALF_POWER),
        gain_margin=min((f for f in factors if f > 1.0), default=math.inf),
        gain_reduction=max((f for f in factors if f < 1.0), default=0.0),
        phase_margin_rad=min((min(lag, 2.0 * math.pi - lag) for lag in lags), default=math.inf),
        delay_margin_s=min(
            (lag / (2.0 * math.pi * f) for f, lag in zip(unity.tolist(), lags, strict=True) if f > 0), default=math.inf
        ),
    )


def _log_size(values: Complex) -> Array:
    """Logarithm of magnitudes; a loop may be 0 at half the sampling rate."""
    return np.asarray(np.log(np.maximum(np.abs(values), 1e-300)))


def structured_norm(matrices: Complex) -> Array:
    """Structured singular values (...) of matrices (..., 3, 3) for three independent complex factors: min over D of
    ||D M D^-1||, which is exact for up to three of them (Doyle 1982).

    The norm is convex in the logarithms of D (Sezginer and Overton 1990), of which two are free: a pattern of points
    about the best so far goes on or gets finer.
    """
    m = np.asarray(matrices, dtype=np.complex128)
    flat = m.reshape(-1, 3, 3)
    pattern = np.stack(np.meshgrid([-1.0, -0.5, 0.0, 0.5, 1.0], [-1.0, -0.5, 0.0, 0.5, 1.0]), axis=-1).reshape(-1, 2)
    rows, at, size = np.arange(len(flat)), np.zeros((len(flat), 2)), np.full(len(flat), 1.0)
    best = largest_singular_value(flat)
    while len(flat) and size.max() > 1e-5:
        tried = at[:, None] + size[:, None, None] * pattern
        d = np.exp(np.concatenate([tried, np.zeros((*tried.shape[:2], 1))], axis=2))
        norms = largest_singular_value(flat[:, None] * (d[..., :, None] / d[..., None, :]))
        k = norms.argmin(axis=1)
        at, best = tried[rows, k], np.minimum(best, norms[rows, k])
        size = np.where(np.abs(pattern[k]).max(axis=1) < 1.0, 0.5 * size, size)
    return np.asarray(best.reshape(m.shape[:-2]))


def largest_singular_value(matrices: Complex) -> Array:
    """Of (..., 3, 3), in closed form to 1e-8, for thousands at once: the largest root of M^H M's characteristic
    polynomial by the cosine of a third of an angle.
    """
    m = np.asarray(matrices, dtype=np.complex128)
    out = np.empty(m.shape[:-2])
    _largest_singular_values(m.reshape(-1, 3, 3), out.reshape(-1))
    return out


@njit(cache=True, error_model="numpy")
def _largest_singular_values(matrices: Complex, out: Array) -> None:
    for n in range(len(out)):
        m = matrices[n]
        xx, yy, zz, xy, yz, zx = 0.0, 0.0, 0.0, 0j, 0j, 0j
        for i in range(3):
            x, y, z = m[i, 0], m[i, 1], m[i, 2]
            xx += x.real * x.real + x.imag * x.imag
            yy += y.real * y.real + y.imag * y.imag
            zz += z.real * z.real + z.imag * z.imag
            xy += x.conjugate() * y
            yz += y.conjugate() * z
            zx += z.conjugate() * x
        mean = (xx + yy + zz) / 3.0
        a, b, c = xx - mean, yy - mean, zz - mean
        ab, bc, ca = _square(xy), _square(yz), _square(zx)
        size = math.sqrt((a * a + b * b + c * c + 2.0 * (ab + bc + ca)) / 6.0)
        determinant = a * b * c + 2.0 * (xy * yz * zx).real - a * bc - b * ca - c * ab
        cosine = min(max(determinant / (2.0 * max(size, 1e-100) ** 3), -1.0), 1.0)
        out[n] = math.sqrt(mean + 2.0 * size * math.cos(math.acos(cosine) / 3.0))


@njit(cache=True)
def _square(value: complex) -> float:
    """Its magnitude's."""
    return float(value.real * value.real + value.imag * value.imag)


def _mimo(grid_hz: Array, s: Complex, sensitivity: Callable[[Array], Complex]) -> Sensitivities:
    size_s = largest_singular_value(s)
    return Sensitivities(
        peak_s=peak(grid_hz, size_s, lambda f: largest_singular_value(sensitivity(f))),
        peak_t=peak(
            grid_hz, largest_singular_value(np.eye(3) - s), lambda f: largest_singular_value(np.eye(3) - sensitivity(f))
        ),
        disk_margin=1.0 / _structured_peak(grid_hz, s - 0.5 * np.eye(3), lambda f: sensitivity(f) - 0.5 * np.eye(3)),
        bandwidth_hz=first_above(grid_hz, size_s, lambda f: largest_singular_value(sensitivity(f)), HALF_POWER),
    )


def _structured_peak(grid_hz: Array, matrices: Complex, function: Callable[[Array], Complex]) -> float:
    """Largest structured norm: looked for where the plain norm, which is never
    below, could still pass the largest so far.
    """
    plain = largest_singular_value(matrices)
    order = np.argsort(plain)[::-1]
    values = np.zeros(len(plain))
    for some in np.array_split(order, max(1, len(order) // 8)):
        if plain[some[0]] <= values.max():
            break
        values[some] = structured_norm(matrices[some])
    return peak(grid_hz, values, lambda f: structured_norm(function(f)), maxima=1, rounds=2)
