"""How far a loop is from instability, and what it rejects: exact at the sampling instants, delays included.

With the plant P of ``loop_plant`` and a law w = -K(z) (y - r), z = exp(i 2 pi f T)::

    L = P K,   S = (I + L)^-1,   T = I - S

Per axis the loop is cut at that axis's measurement while the others stay closed, L_i = 1 / S_ii - 1; as a MIMO system
all three are changed at once. The disk margin has skew 0 (Seiler, Packard, Gahinet: An Introduction to Disk Margins,
2020): alpha = 1 / max ||S - I/2||, the loop bears every factor (1 + d/2) / (1 - d/2) with |d| < alpha in each
measurement. For the MIMO system the norm is the structured one, the factors of the axes being independent.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import scipy.optimize
from numpy.typing import NDArray

from pkxyz_ctrl.design.discrete_law import DiscreteLaw, LawError, response
from pkxyz_ctrl.design.loop_plant import LoopPlant

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


def closed_loop(plant: LoopPlant, law: DiscreteLaw) -> Array:
    """State matrix of plant and law together. Raises ``LawError`` where their periods differ."""
    if not math.isclose(plant.period_s, law.period_s, rel_tol=1e-9):
        raise LawError(f"the law has a period of {law.period_s * 1e6:g} us and the bus {plant.period_s * 1e6:g} us")
    return np.block([[plant.a - plant.b @ law.d @ plant.c, -plant.b @ law.c], [law.b @ plant.c, law.a]])


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
    nyquist = 0.5 / plant.period_s
    around = np.r_[-np.geomspace(0.02, 10.0, 12)[::-1], 0.0, np.geomspace(0.02, 10.0, 12)]
    poles = np.concatenate([np.linalg.eigvals(m) for m in (plant.a, law.a, closed_loop(plant, law)) if len(m)])
    poles = np.log(poles[np.abs(poles) > 1e-9].astype(complex)) / plant.period_s / (2.0 * math.pi)
    poles = poles[poles.imag > 1.0]
    near = (poles.imag[:, None] + np.abs(poles.real)[:, None] * around).ravel()
    grid = np.concatenate([np.geomspace(0.5, nyquist, points), near])
    grid = np.unique(grid[(grid >= 0.5) & (grid <= nyquist)])
    return grid[np.diff(grid, prepend=0.0) > 1e-6 * grid]  # poles that are the same twice are one


def margins(plant: LoopPlant, law: DiscreteLaw) -> Margins:
    """All margins of a law on a plant. Raises ``LawError`` where their periods differ."""
    radius = spectral_radius(plant, law)
    if not radius < 1.0:
        axis = AxisMargins(math.inf, math.inf, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0)
        return Margins(False, radius, (axis, axis, axis), Sensitivities(math.inf, math.inf, 0.0, 0.0))
    grid = loop_response(plant, law, frequency_grid_hz(plant, law))
    found = margins_of_response(grid, lambda f: loop_response(plant, law, np.array([f])).s[0])
    return replace(found, spectral_radius=radius)


def margins_of_response(grid: LoopResponse, sensitivity: Callable[[float], Complex]) -> Margins:
    """Margins of a stable loop from its response on a grid, and S (3,3) as a function of a frequency in Hz, with which
    what the grid shows is refined. The spectral radius is left open (NaN).
    """

    def of_axis(i: int) -> AxisMargins:
        return axis_margins(grid.frequency_hz, grid.s[:, i, i], lambda f: complex(sensitivity(f)[i, i]))

    return Margins(True, math.nan, (of_axis(0), of_axis(1), of_axis(2)), _mimo(grid, sensitivity))


def peak_sensitivity(plant: LoopPlant, law: DiscreteLaw) -> float:
    """Ms of the MIMO system alone, as ``margins`` has it; infinite for an unstable loop. For searches over many."""
    if not spectral_radius(plant, law) < 1.0:
        return math.inf
    grid = loop_response(plant, law, frequency_grid_hz(plant, law, 300))

    def largest(f: float) -> float:
        return float(np.linalg.norm(loop_response(plant, law, np.array([f])).s[0], 2))

    return _peak(grid.frequency_hz, np.linalg.norm(grid.s, 2, axis=(1, 2)), largest)


def axis_margins(grid_hz: Array, s: Complex, sensitivity: Callable[[float], complex]) -> AxisMargins:
    """Margins of a stable loop from its sensitivity: values ``s`` (m,) on a grid, and the function itself, with which
    what the grid shows is refined.
    """
    loop = 1.0 / s - 1.0

    def loop_at(frequency_hz: float) -> complex:
        return 1.0 / sensitivity(frequency_hz) - 1.0

    real = [loop_at(f) for f in _crossings(grid_hz, loop.imag, lambda f: loop_at(f).imag)]
    real.append(complex(loop[-1].real) if abs(loop[-1].imag) < 1e-6 * abs(loop[-1]) else 0j)  # z = -1
    factors = [-1.0 / value.real for value in real if value.real < 0.0]
    unity = _crossings(grid_hz, np.log(np.abs(loop)), lambda f: math.log(abs(loop_at(f))))
    lags = [math.atan2(value.imag, value.real) + math.pi for value in map(loop_at, unity)]  # 0..2 pi, to -1
    return AxisMargins(
        peak_s=_peak(grid_hz, np.abs(s), lambda f: abs(sensitivity(f))),
        peak_t=_peak(grid_hz, np.abs(1.0 - s), lambda f: abs(1.0 - sensitivity(f))),
        disk_margin=1.0 / _peak(grid_hz, np.abs(s - 0.5), lambda f: abs(sensitivity(f) - 0.5)),
        bandwidth_hz=_bandwidth(grid_hz, np.abs(s), lambda f: abs(sensitivity(f))),
        gain_margin=min((f for f in factors if f > 1.0), default=math.inf),
        gain_reduction=max((f for f in factors if f < 1.0), default=0.0),
        phase_margin_rad=min((min(lag, 2.0 * math.pi - lag) for lag in lags), default=math.inf),
        delay_margin_s=min(
            (lag / (2.0 * math.pi * f) for f, lag in zip(unity, lags, strict=True) if f > 0), default=math.inf
        ),
    )


def structured_norm(matrix: Complex) -> float:
    """Structured singular value of a 3 x 3 matrix for three independent complex factors: min over D of
    ||D M D^-1||, which is exact for up to three of them (Doyle 1982).
    """

    def norm(exponents: Array) -> float:
        d = np.exp(np.append(exponents, 0.0))
        return float(np.linalg.norm(matrix * d[:, None] / d[None, :], 2))

    found = scipy.optimize.minimize(norm, np.zeros(2), method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-9})
    return min(float(found.fun), norm(np.zeros(2)))


def _mimo(grid: LoopResponse, sensitivity: Callable[[float], Complex]) -> Sensitivities:
    def largest(f: float) -> float:
        return float(np.linalg.norm(sensitivity(f), 2))

    size_s = np.linalg.norm(grid.s, 2, axis=(1, 2))
    return Sensitivities(
        peak_s=_peak(grid.frequency_hz, size_s, largest),
        peak_t=_peak(
            grid.frequency_hz,
            np.linalg.norm(grid.t, 2, axis=(1, 2)),
            lambda f: float(np.linalg.norm(np.eye(3) - sensitivity(f), 2)),
        ),
        disk_margin=1.0 / _structured_peak(grid, sensitivity),
        bandwidth_hz=_bandwidth(grid.frequency_hz, size_s, largest),
    )


def _structured_peak(grid: LoopResponse, sensitivity: Callable[[float], Complex]) -> float:
    """Largest structured norm of S - I/2: where the plain norm, which is never below, could still pass the largest so
    far.
    """
    half = 0.5 * np.eye(3)
    plain = np.linalg.norm(grid.s - half, 2, axis=(1, 2))
    best, at = 0.0, 0
    for i in np.argsort(plain)[::-1]:
        if plain[i] <= best:
            break
        here = structured_norm(grid.s[i] - half)
        if here > best:
            best, at = here, int(i)
    low, high = grid.frequency_hz[max(at - 1, 0)], grid.frequency_hz[min(at + 1, len(plain) - 1)]
    found = scipy.optimize.minimize_scalar(
        lambda f: -structured_norm(sensitivity(f) - half),
        bounds=(low, high),
        method="bounded",
        options={"xatol": 1e-3 * (high - low)},
    )
    return max(best, -float(found.fun))


def _peak(grid_hz: Array, values: Array, function: Callable[[float], float]) -> float:
    """Largest value, the grid's three largest local maxima refined between their neighbours."""
    padded = np.r_[-np.inf, values, -np.inf]
    local = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:]))
    best = float(values.max())
    for i in local[np.argsort(values[local])[::-1][:3]]:
        low, high = grid_hz[max(i - 1, 0)], grid_hz[min(i + 1, len(grid_hz) - 1)]
        found = scipy.optimize.minimize_scalar(
            lambda f: -function(f), bounds=(low, high), method="bounded", options={"xatol": 1e-3 * (high - low)}
        )
        best = max(best, -float(found.fun))
    return best


def _crossings(grid_hz: Array, values: Array, function: Callable[[float], float]) -> list[float]:
    """Frequencies at which a function that has ``values`` on the grid passes zero."""
    at = np.flatnonzero((values[:-1] < 0) != (values[1:] < 0))
    found = []
    for i in at:
        low, high = float(grid_hz[i]), float(grid_hz[i + 1])
        if (function(low) < 0) != (function(high) < 0):
            found.append(float(scipy.optimize.brentq(function, low, high, xtol=1e-9, rtol=1e-10)))
    return found


def _bandwidth(grid_hz: Array, values: Array, function: Callable[[float], float]) -> float:
    """Where the value first reaches -3 dB, from low frequencies; 0 if it starts above, the last if it never does."""
    above = np.flatnonzero(values >= HALF_POWER)
    if len(above) == 0:
        return float(grid_hz[-1])
    i = int(above[0])
    if i == 0:
        return 0.0
    crossing = scipy.optimize.brentq(lambda f: function(f) - HALF_POWER, grid_hz[i - 1], grid_hz[i])
    return float(crossing)
