"""A law of fixed order for one axis that is as good as it can be on the worst of many plants: minimax over frequency.

K = X / ((1 - 1/z) Y), X and Y polynomials in 1/z with Y = 1 + ..., so an integrator is always in it. With P_j the
plants, of which P_0 is the one as drawn, S_j = 1 / (1 + P_j K), and T_0 = 1 - S_0, minimise the largest of::

    |S_0| sqrt(2) (f_b / f)^slope up to the bandwidth f_b,   |S_0| / Ms,   |S_0 - 1/2| alpha,   |S_j| / Ms_j,
    |K S_0| / (effort k),   noise at hold / its bound,   2 - rate of decay of each pole of the loop / the least rate

so 1 means that every bound is kept (k is the stiffness as drawn). A search uses whatever no bound forbids: without the
bounds of K S_0 and of the poles it found a law with a gain of 62 k near half the sampling rate, where no S tells, and
poles there that rang for 23 ms. The steps are linear programmes in a region of trust (Madsen,
J. Inst. Math. Appl. 16 (1975) 321), and none is taken that leaves any of the plants unstable. Frequencies about
the poles of the closed loops join the grid until no peak hides between its points. It finds a local best
from where it starts: no proof that there is no better one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize
import scipy.signal
from numpy.typing import NDArray

from pkxyz_ctrl.design.margins.margins import HALF_POWER
from pkxyz_ctrl.design.model.discrete_law import DiscreteLaw, LawError, response
from pkxyz_ctrl.design.model.loop_plant import LoopPlant

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class Bounds:
    """What is asked of an axis."""

    bandwidth_hz: float
    """|S| < -3 dB up to here, as drawn"""
    noise_m: float
    """most standard deviation of the position at hold"""
    sense_noise_m: float
    """of a measured position"""
    rounding_n: float
    """of the force at the platform, from rounded voltages; its difference acts, as noise is shaped"""
    slope: float = 0.0
    """... falling below with this power of the frequency; 1: in proportion, as one integrator lets it"""
    peak_s: float = 2.0
    disk_margin: float = 0.6
    peak_s_changed: float = 3.0
    """of each plant that has one thing changed"""
    peak_s_combined: float = 6.0
    """of each plant that has several changed at once: to stay stable"""
    effort: float = math.inf
    """|K S| over the stage's stiffness, as drawn: force for a deviation in what is measured, at any frequency"""
    ring_s: float = math.inf
    """longest time constant of a pole of the loop as drawn"""


@dataclass(frozen=True)
class AxisLaw:
    """Transfer function in N/m, coefficients (n+1,) of falling powers of z; positive against a deviation."""

    numerator: Array
    denominator: Array

    def state_space(self) -> tuple[Array, Array, Array, Array]:
        """A, B, C, D."""
        a, b, c, d = scipy.signal.tf2ss(self.numerator, self.denominator)
        return a, b, c, d


def axis_law(law: DiscreteLaw, axis: int, *, extra_poles: Sequence[float] = ()) -> AxisLaw:
    """One axis (0, 1 or 2) of a law whose states come in threes, axis by axis, or in three blocks, one after another.

    ``extra_poles`` are cancelled by zeros at the same places: room for the search. Raises ``LawError`` where the axis
    has no integrator, or the axes are coupled.
    """
    for keep in (slice(axis, None, 3), slice(axis * (law.order // 3), (axis + 1) * (law.order // 3))):
        rest = np.delete(np.arange(law.order), np.arange(law.order)[keep])
        if max(np.abs(law.a[keep][:, rest]).max(initial=0.0), np.abs(law.b[rest, axis]).max(initial=0.0)) < 1e-9:
            break
    else:
        raise LawError("the axes of this law are coupled; take one that was designed at mid-workspace")
    numerator, denominator = scipy.signal.ss2tf(
        law.a[keep, keep], law.b[keep, [axis]].reshape(-1, 1), law.c[[axis], keep].reshape(1, -1),
        law.d[axis, axis].reshape(1, 1),
    )  # fmt: skip
    poles = np.roots(denominator)
    integrator = int(np.argmin(np.abs(poles - 1.0)))
    if abs(poles[integrator] - 1.0) > 1e-6:
        raise LawError("this law has no integrator to start from")
    extra = np.poly(np.array(extra_poles)) if extra_poles else np.ones(1)
    rest_of_it = np.real(np.poly(np.delete(poles, integrator)))
    return AxisLaw(
        np.polymul(numerator[0], extra), np.asarray(np.polymul([1.0, -1.0], np.polymul(rest_of_it, extra)), np.float64)
    )


def minimax(
    drawn_and_changed: Sequence[LoopPlant],
    start: AxisLaw,
    bounds: Bounds,
    *,
    combined: Sequence[LoopPlant] = (),
    enough: float = 0.97,
    steps: int = 200,
) -> tuple[AxisLaw, float]:
    """The law, and the largest value over its bound; stops where that is ``enough``. Plants have
    one input; the first is as drawn, and ``combined`` have a bound of their own. Raises
    ``LawError`` for a start that leaves one of them unstable.
    """
    plants = [*drawn_and_changed, *combined]
    most = [bounds.peak_s_changed] * len(drawn_and_changed) + [bounds.peak_s_combined] * len(combined)
    size, unit = len(start.numerator), float(plants[0].stiffness_n_per_m[0, 0])
    x = np.concatenate([start.numerator / unit, np.polydiv(start.denominator, [1.0, -1.0])[0][1:]])
    extra: list[Array] = [np.empty(0) for _ in plants]
    if not all(_stable(plant, _law(x, size, unit)) for plant in plants):
        raise LawError("the search has to start from a law that all plants are stable with")
    for _ in range(EXCHANGES):
        extra = [
            np.union1d(known, _about_poles(_closed(plant, _law(x, size, unit)), plant.period_s))
            for known, plant in zip(extra, plants, strict=True)
        ]
        problem = _Problem(plants, bounds, extra, most)
        if problem.evaluate(x, size)[0].max() <= enough:
            break
        x = _descend(problem, x, size, enough, steps)
    return _law(x, size, unit), float(problem.evaluate(x, size)[0].max())


EXCHANGES = 8
"""Times that the grid is completed, at most."""


def _descend(problem: "_Problem", x: Array, size: int, enough: float, steps: int) -> Array:
    values, slopes = problem.evaluate(x, size)
    trust = 0.3
    for _ in range(steps):
        worst = float(values.max())
        if worst <= 0.995 * enough or trust < 1e-7:
            break
        step, predicted = _step(values, slopes, trust)
        found, found_slopes = problem.evaluate(x + step, size)
        if found.max() < worst and problem.stable(x + step, size):
            gained = (worst - found.max()) / max(worst - predicted, 1e-12)
            trust *= 2.0 if gained > 0.6 else 0.5 if gained < 0.25 else 1.0
            x, values, slopes = x + step, found, found_slopes
        else:
            trust /= 3.0
    return x


def _law(x: Array, size: int, unit: float) -> AxisLaw:
    return AxisLaw(x[:size] * unit, np.asarray(np.polymul([1.0, -1.0], np.append(1.0, x[size:])), np.float64))


def _closed(plant: LoopPlant, law: AxisLaw) -> Array:
    a, b, c, d = law.state_space()
    return np.block([[plant.a - plant.b @ d @ plant.c, -plant.b @ c], [b @ plant.c, a]])


def _stable(plant: LoopPlant, law: AxisLaw) -> bool:
    return bool(np.abs(np.linalg.eigvals(_closed(plant, law))).max() < 1.0 - 1e-7)


def _step(values: Array, slopes: Array, trust: float) -> tuple[Array, float]:
    """The step that makes the largest linearised value least, and that value. The region of trust is a cube along the
    principal directions of the slopes, shorter where they are steep.
    """
    worst = values.max()
    high = slopes[values > 0.5 * worst]
    _, sizes, directions = np.linalg.svd(high, full_matrices=False)
    along = directions.T / np.maximum(sizes, 1e-2 * sizes[0]) * (0.3 * math.sqrt(len(high)))
    active = values > worst - 6.0 * trust - 0.2
    projected = slopes[active] @ along
    n = projected.shape[1]
    found = scipy.optimize.linprog(
        np.append(np.zeros(n), 1.0),
        A_ub=np.hstack([projected, -np.ones((len(projected), 1))]),
        b_ub=-values[active],
        bounds=[(-trust, trust)] * n + [(None, None)],
        method="highs",
    )
    if found.status != 0:
        return np.zeros(slopes.shape[1]), float(worst)
    return along @ found.x[:n], float(found.x[n])


class _Problem:
    """All bounds on a grid of frequencies, as functions of the coefficients [X / unit, Y without its 1]."""

    def __init__(
        self, plants: Sequence[LoopPlant], bounds: Bounds, extra: Sequence[Array], most: Sequence[float]
    ) -> None:
        self._plants = plants
        self._period_s = plants[0].period_s
        self.unit = float(plants[0].stiffness_n_per_m[0, 0])
        self._noise = bounds.sense_noise_m / bounds.noise_m
        self._effort, self._ring_s, self._drawn = bounds.effort, bounds.ring_s, plants[0]
        nyquist = 0.5 / self._period_s
        base = np.unique(np.r_[np.geomspace(5.0, 0.999 * nyquist, 140), np.linspace(300.0, 1200.0, 120)])
        parts: list[tuple[Array, Complex, Array, Array]] = []  # frequency, plant, centre of S, bound
        for j, plant in enumerate(plants):
            f = np.unique(np.concatenate([base, _about_poles(plant.a, self._period_s), extra[j]]))
            f = f[(f > 1.0) & (f < nyquist)]
            p = self._response(plant, f)
            if j > 0:
                parts.append((f, p, np.zeros(len(f)), np.full(len(f), most[j])))
                continue
            self._drawn_plant, self._drawn_late = p, self._delays(f)
            low = np.append(f[f < bounds.bandwidth_hz], bounds.bandwidth_hz)
            parts += [
                (f, p, np.zeros(len(f)), np.full(len(f), bounds.peak_s)),
                (f, p, np.full(len(f), 0.5), np.full(len(f), 1.0 / bounds.disk_margin)),
                (
                    low,
                    self._response(plant, low),
                    np.zeros(len(low)),
                    HALF_POWER * (low / bounds.bandwidth_hz) ** bounds.slope,
                ),
            ]
        frequency, self._plant, self._centre, self._bound = (
            np.concatenate([part[k] for part in parts]) for k in range(4)
        )
        self._late = self._delays(frequency)
        even = np.asarray((np.arange(1500) + 0.5) / 1500.0 * nyquist, dtype=np.float64)
        self._even_plant, self._even_late = self._response(plants[0], even), self._delays(even)
        force = bounds.rounding_n / bounds.sense_noise_m / self.unit
        self._rounding = force * self._even_plant * (1.0 - self._even_late)

    def _response(self, plant: LoopPlant, frequency_hz: Array) -> Complex:
        z = np.exp(2j * math.pi * frequency_hz * self._period_s)
        return np.asarray(response(plant.a, plant.b, plant.c, np.zeros((1, 1)), z)[:, 0, 0] * self.unit)

    def _delays(self, frequency_hz: Array) -> Complex:
        return np.exp(-2j * math.pi * np.asarray(frequency_hz) * self._period_s)

    def evaluate(self, x: Array, size: int) -> tuple[Array, Array]:
        """Values over bounds (m,) and their slopes (m, n)."""
        s, ds = _sensitivity(x, size, self._late, self._plant)
        v = s - self._centre
        values = np.abs(v) / self._bound
        slopes = _slopes(v, ds, self._bound)
        s, ds = _sensitivity(x, size, self._even_late, self._even_plant)
        seen, pushed = 1.0 - s, self._rounding * s
        noise = math.sqrt(float(np.mean(np.abs(seen) ** 2 + np.abs(pushed) ** 2)))
        along = -np.conj(seen) + np.conj(pushed) * self._rounding
        slope = np.mean(np.real(along[:, None] * ds), axis=0) / noise
        found = [(values, slopes), (np.array([noise * self._noise]), (slope * self._noise)[None])]
        if math.isfinite(self._effort):
            u, du = _effort(x, size, self._drawn_late, self._drawn_plant)
            found.append((np.abs(u) / self._effort, _slopes(u, du, self._effort)))
        if math.isfinite(self._ring_s):
            found.append(self._ringing(x, size))
        return np.concatenate([v for v, _ in found]), np.vstack([d for _, d in found])

    def _ringing(self, x: Array, size: int) -> tuple[Array, Array]:
        """2 - rate / least rate for each pole z of the loop as drawn, (m,) and (m, n); dz / dx = -F_x / F_z, where
        F = Y + P X is zero.
        """
        z = np.linalg.eigvals(_closed(self._drawn, _law(x, size, self.unit)))
        z = z[(np.abs(z) > 0.1) & (z.imag >= 0.0)]

        def at(points: Complex) -> tuple[Complex, Complex]:
            plant = response(self._drawn.a, self._drawn.b, self._drawn.c, np.zeros((1, 1)), points)[:, 0, 0] * self.unit
            numerator, denominator, powers, columns = _polynomials(x, size, 1.0 / points)
            return denominator + plant * numerator, np.hstack([plant[:, None] * powers, columns])

        step = 1e-6 * z
        by_z = (at(z + step)[0] - at(z - step)[0]) / (2.0 * step)
        relative = np.real(-at(z)[1] / (by_z * z)[:, None])
        scale = self._ring_s / self._period_s
        return 2.0 + scale * np.log(np.abs(z)), scale * relative

    def stable(self, x: Array, size: int) -> bool:
        return all(_stable(plant, _law(x, size, self.unit)) for plant in self._plants)


def _slopes(v: Complex, dv: Complex, bound: Array | float) -> Array:
    """Of |v| (m,) over its bound."""
    return np.asarray(np.real((np.conj(v) / (np.abs(v) * bound))[:, None] * dv))


def _sensitivity(x: Array, size: int, late: Complex, plant: Complex) -> tuple[Complex, Complex]:
    """S (m,) and its derivative (m, n) by the coefficients, from S = Y / (Y + P X) with the integrator in Y."""
    numerator, denominator, powers, columns = _polynomials(x, size, late)
    total = denominator + plant * numerator
    by_x = (-denominator * plant / total**2)[:, None] * powers
    by_y = (plant * numerator / total**2)[:, None] * columns
    return np.asarray(denominator / total), np.hstack([by_x, by_y])


def _effort(x: Array, size: int, late: Complex, plant: Complex) -> tuple[Complex, Complex]:
    """K S (m,) over the stiffness and its derivative (m, n), from K S = X / (Y + P X)."""
    numerator, denominator, powers, columns = _polynomials(x, size, late)
    total = denominator + plant * numerator
    by_x = (denominator / total**2)[:, None] * powers
    by_y = (-numerator / total**2)[:, None] * columns
    return np.asarray(numerator / total), np.hstack([by_x, by_y])


def _polynomials(x: Array, size: int, late: Complex) -> tuple[Complex, Complex, Complex, Complex]:
    """X and Y (m,), the integrator in Y, and their derivatives by their coefficients."""
    powers = late[:, None] ** np.arange(size)
    integrator = 1.0 - late
    columns = integrator[:, None] * powers[:, 1 : len(x) - size + 1]
    return powers @ x[:size], integrator + columns @ x[size:], powers, columns


def _about_poles(a: Array, period_s: float) -> Array:
    """Frequencies close about the resonances of a system: a peak of S there must not fall between two points."""
    poles = np.linalg.eigvals(a)
    poles = np.log(poles[np.abs(poles) > 1e-6].astype(complex)) / period_s / (2.0 * math.pi)
    poles = poles[poles.imag > 1.0]
    spread = np.array([-3.0, -1.0, -0.3, 0.0, 0.3, 1.0, 3.0])
    return np.asarray(np.unique((poles.imag[:, None] + np.abs(poles.real)[:, None] * spread).ravel()))
