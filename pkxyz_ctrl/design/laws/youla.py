"""Taps of the Youla filter for one axis: the least noise at hold among all that keep rejection and margins, by cones.

The state feedback alone closes a loop that is stable on every plant j. Beside it the filter Q joins the innovation nu
to the force f = Q nu that is taken from the demand. With the closed loop's transfers from n (added to what is
measured) and f to y, nu and w::

    S_j = N_j / D_j,   D_j = 1 - G_j Q,   N_j = S_j0 D_j + Y_j Q V_j

G_j is what f does to nu, Y_j to y, V_j what n does to nu. On the plant as drawn the filter knows f, so G_0 = 0 and all
is affine in the taps: bounds of |S|, |S - 1/2| and |K S| are second-order cones, noise is a quadratic. On the others
|N| <= Ms |D| is not convex; Re(D conj(D') / |D'|) in place of |D|, D' that of the last taps, is, and is stricter. It
keeps D within a half-plane about D', so D winds about zero as often as D' does, and what was stable stays so. A few
programmes (Clarabel) in a row, the grids completed about the closed loops' poles, find the taps.

To the Kalman filter, a filter of the sense chain is x - tau v. Behind one the plant as drawn has a G_0, too: its bounds
are asked as those of the others, and Q / D is linear about the last taps in what noise leaves.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import clarabel
import numpy as np
import scipy.linalg
import scipy.sparse
from numpy.typing import NDArray

from pkxyz_ctrl.design.model.discrete_law import DiscreteLaw, LawError, response
from pkxyz_ctrl.design.model.loop_plant import LoopPlant

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

PROGRAMMES = 16
"""At most so many in a row; four or five do."""
_TURN = 0.1
"""Least part of D along what it was, so that it keeps its turns about zero where a bound is conceded."""
_DEAR = 3.0
"""Price of a concession of 1 in |S|, in variances about as they are without a filter."""
_FAR = 0.5
"""Where |S| of a changed plant has never been more of its bound, the next programme leaves it out; what then passes the
bound is found by ``_refine``."""
_CLOSE = 1.005
"""How far beyond its bound a peak between two points of the grid may reach."""
_SETTLED = 2e-3
"""Change of the noise from one programme to the next that is none any more."""
_FORESEEN = 1e-9
"""|G| over the stage's compliance that is rounding alone."""


@dataclass(frozen=True)
class Bounds:
    """What is asked of an axis."""

    edge_hz: float
    """|S| stays below ``edge`` (f / edge_hz)^slope up to here, as drawn"""
    edge: float
    slope: float
    peak_s: float
    disk_margin: float
    effort: float
    """|K S| over the stage's stiffness, as drawn: a mode that folds back from beyond the model meets this gain"""
    below: tuple[tuple[float, float], ...] = ()
    """(Hz, |S|) besides, as drawn: lines that have to be rejected further"""


@dataclass(frozen=True)
class Noise:
    """What disturbs a hold: standard deviations of white noise."""

    sense_m: float
    """of a measured position"""
    rounding_n: float
    """of the force at the platform that is rounded away; its difference acts, and the filter is told"""
    shaken: Array = field(default_factory=lambda: np.zeros((2, 2)))
    """(2,2) factor L of the covariance L L^T that white forces on the stage add to position and velocity in a period"""


class InnovationLoop:
    """One axis of a plant with the state feedback closed: inputs n (m), added to what is measured, and f (N), taken
    from the demand; outputs y, the innovation nu (m) and the force w (N).
    """

    def __init__(self, plant: LoopPlant, law: DiscreteLaw, seen: Array, axis: int, peak_s: float) -> None:
        """``law`` is the equivalent of the state feedback alone; ``seen`` (3,9) what a sample shows of the first of its
        states; ``peak_s`` the largest |S| that this plant may have.
        Raises ``LawError`` where the loop is unstable without the filter.
        """
        one, keep = plant.axis(axis), slice(axis, None, 3)
        a, b = law.a[keep, keep], law.b[keep, axis : axis + 1]
        c, d = law.c[axis : axis + 1, keep], law.d[axis : axis + 1, axis : axis + 1]
        shown = np.hstack([seen[axis : axis + 1, keep], np.zeros((1, len(a) - 3))])
        told = np.zeros((len(a), 1))
        told[3] = 1.0  # the newest force that the filter was told
        n = len(one.a)
        self.a = np.block([[one.a - one.b @ d @ one.c, -one.b @ c], [b @ one.c, a]])
        self.b = np.block([[-one.b @ d, -one.b], [b, -told]])
        self.c = np.block([[one.c, np.zeros((1, len(a)))], [one.c, -shown], [-d @ one.c, -c]])
        self.d = np.array([[0.0, 0.0], [1.0, 0.0], [-d[0, 0], -1.0]])
        self.rounded = np.vstack([one.b, told])
        self.shaken = np.eye(n + len(a), 2)  # position and velocity of the stage
        self.position = np.eye(1, n + len(a))
        self.period_s, self.peak_s = plant.period_s, peak_s
        self.stiffness_n_per_m = float(one.stiffness_n_per_m[0, 0])
        self.poles = np.linalg.eigvals(self.a).astype(np.complex128)
        if not np.abs(self.poles).max() < 1.0:
            raise LawError("the state feedback alone has to be stable with every plant that its filter is to bear")
        self.more_hz, self.close_hz = np.empty(0), np.empty(0)

    def grid_hz(self, base_hz: Array) -> Array:
        """``base_hz``, points about the loop's own poles, and what ``refine`` has added."""
        grid = np.unique(np.concatenate([base_hz, about(self.poles, self.period_s, 7), self.more_hz]))
        return grid[(grid > 0.0) & (grid <= 0.5 / self.period_s)]

    def transfers(self, frequency_hz: Array) -> Complex:
        """(m, 3, 2) from n and f to y, nu and w."""
        return response(self.a, self.b, self.c, self.d, np.exp(2j * math.pi * frequency_hz * self.period_s))

    def sensitivity(self, frequency_hz: Array, taps: Array) -> Complex:
        """S (m,) with taps (n,) in N/m."""
        numerator, denominator = self.fraction(frequency_hz, len(taps))
        return (numerator[0] + numerator[1] @ taps) / (denominator[0] + denominator[1] @ taps)

    def fraction(self, frequency_hz: Array, taps: int) -> tuple[tuple[Complex, Complex], tuple[Complex, Complex]]:
        """N and D, each as its value (m,) without taps and its derivatives (m, taps) by them."""
        h, late = self.transfers(frequency_hz), delays(frequency_hz, self.period_s, taps)
        s = 1.0 + h[:, 0, 0]
        by_tap = (h[:, 0, 1] * h[:, 1, 0] - s * h[:, 1, 1])[:, None] * late
        return (s, by_tap), (np.ones(len(s), np.complex128), -self.unforeseen(h)[:, None] * late)

    def unforeseen(self, transfers: Complex) -> Complex:
        """G (m,) of transfers (m, ..., ...) with nu in the second row and f in the second column."""
        g = transfers[:, 1, 1]
        return np.where(np.abs(g) * self.stiffness_n_per_m < _FORESEEN, 0.0, g)

    def poles_with(self, taps: Array) -> Complex:
        """Poles of the loop with the filter."""
        n, late = len(self.a), len(taps) - 1
        a = np.zeros((n + late, n + late))
        a[:n, :n] = self.a + np.outer(self.b[:, 1], taps[0] * self.c[1])
        a[:n, n:] = np.outer(self.b[:, 1], taps[1:])
        if late:
            a[n, :n] = self.c[1]
            a[n + 1 :, n:-1] = np.eye(late - 1)
        return np.asarray(np.linalg.eigvals(a), dtype=np.complex128)


def about(poles: Complex, period_s: float, points: int) -> Array:
    """Frequencies in Hz about each pole, out to eight times its distance from the circle."""
    near = np.log(poles[np.abs(poles) > 1e-3]) / period_s / (2.0 * math.pi)
    near = near[near.imag > 1.0]
    spread = np.geomspace(0.05, 8.0, points)
    return np.asarray((near.imag[:, None] + np.abs(near.real)[:, None] * np.r_[-spread, 0.0, spread]).ravel())


def delays(frequency_hz: Array, period_s: float, taps: int) -> Complex:
    """(m, taps) of 1, 1/z, 1/z^2, ..."""
    return np.asarray(np.exp(-2j * math.pi * period_s * frequency_hz[:, None] * np.arange(taps)))


def youla_taps(
    drawn: InnovationLoop,
    changed: Sequence[InnovationLoop],
    bounds: Bounds,
    noise: Noise,
    taps: int,
    on_progress: Callable[[str], None] = lambda line: None,
) -> tuple[Array, float]:
    """Taps (n,) in N/m and the standard deviation of the position at hold in m, as drawn.

    Raises ``LawError`` where no filter keeps the bounds, and where the programmes come to no end.
    """
    unit, nyquist_hz = drawn.stiffness_n_per_m, 0.5 / drawn.period_s
    few_hz = np.linspace(0.04, 1.0, 70) * nyquist_hz  # lower down no plant has its peak
    many_hz = np.unique(
        np.r_[np.geomspace(2e-3, 0.1, 30) * nyquist_hz, np.linspace(0.05, 1.0, 40) * bounds.edge_hz, few_hz]
    )
    q, last = np.zeros(taps), math.inf
    for number in range(PROGRAMMES):
        cones = _Cones(taps)
        _ask_as_drawn(cones, drawn, drawn.grid_hz(many_hz), bounds, q)
        for loop in changed:
            _ask_changed(cones, loop, loop.grid_hz(few_hz), q)
        x, beyond = cones.least(_hold_variance(drawn, noise, q), unit)
        found = [
            _refine(drawn, x, bounds.peak_s, many_hz),
            *(_refine(loop, x, loop.peak_s, few_hz) for loop in changed),
        ]
        stable, worst = all(radius < 1.0 for radius, _ in found), max(peak for _, peak in found)
        value = hold_deviation_m(drawn, noise, x)
        on_progress(
            f"programme {number + 1}: {1e9 * value:.3f} nm; largest |S| {worst:.3f} of its bound, {beyond:.3f} conceded"
        )
        if stable:
            if worst < _CLOSE and beyond < 1e-3 and abs(value - last) < _SETTLED * value:
                return x, value
            q, last = x, value
    raise LawError(
        f"after {PROGRAMMES} programmes a changed plant has still {worst:.3f} times the |S| that it may have; lower "
        "edge_hz, or allow more at the changed plants"
    )


def hold_deviation_m(drawn: InnovationLoop, noise: Noise, taps: Array) -> float:
    """Standard deviation of the position at hold in m, as drawn, for taps (n,) in N/m."""
    q, g, c = _hold_variance(drawn, noise, taps)
    return math.sqrt(max(float(taps @ q @ taps + 2.0 * g @ taps + c), 0.0))


def _hold_variance(drawn: InnovationLoop, noise: Noise, about_taps: Array) -> tuple[Array, Array, float]:
    """Q, g and c of x^T Q x + 2 g^T x + c, m^2: variance of the position for taps x in N/m; a mean over frequency.
    Q / D is its tangent at ``about_taps``: exact there, and everywhere for G = 0.
    """
    points = 4096
    f = (np.arange(points) + 0.5) * 0.5 / drawn.period_s / points
    z, late = np.exp(2j * math.pi * f * drawn.period_s), delays(f, drawn.period_s, len(about_taps))
    inputs = np.hstack([drawn.b, drawn.rounded, drawn.shaken @ noise.shaken])
    outputs = np.vstack([drawn.position, drawn.c[1]])
    through = np.zeros((2, 5))
    through[1, 0] = 1.0
    h = response(drawn.a, inputs, outputs, through, z)
    last = late @ about_taps
    d = 1.0 - drawn.unforeseen(h) * last
    slope = 1.0 / d**2
    offset = last / d - last * slope
    shaped = np.abs(1.0 - 1.0 / z) * noise.rounding_n
    sources = ((0, noise.sense_m), (2, shaped), (3, 1.0), (4, 1.0))
    fixed = np.concatenate([(h[:, 0, k] + h[:, 0, 1] * h[:, 1, k] * offset) * size for k, size in sources])
    by_tap = np.concatenate([(h[:, 0, 1] * h[:, 1, k] * size * slope)[:, None] * late for k, size in sources])
    quadratic = np.real(by_tap.conj().T @ by_tap) / points
    return quadratic, np.real(by_tap.conj().T @ fixed) / points, float(np.sum(np.abs(fixed) ** 2) / points)


def _ask_as_drawn(cones: "_Cones", drawn: InnovationLoop, f: Array, bounds: Bounds, q: Array) -> None:
    (s, by_tap), (one, turned) = drawn.fraction(f, cones.taps)
    below = np.where(f <= bounds.edge_hz, bounds.edge * (f / bounds.edge_hz) ** bounds.slope, math.inf)
    along = _along(one, turned, q)
    cones.add(*_times(np.minimum(below, bounds.peak_s), along), s, by_tap)
    if bounds.below:
        hz, most = np.array(bounds.below).T
        (at, at_by_tap), there = drawn.fraction(hz, cones.taps)
        cones.add(*_times(most, _along(*there, q)), at, at_by_tap)
    disk = np.full(len(f), 1.0 / bounds.disk_margin)
    cones.add(*_times(disk, along), s - 0.5 * one, by_tap - 0.5 * turned)
    h, late = drawn.transfers(f), delays(f, drawn.period_s, cones.taps)
    k = drawn.stiffness_n_per_m
    effort = (h[:, 2, 1] * h[:, 1, 0] / k)[:, None] * late + (h[:, 2, 0] / k)[:, None] * turned
    cones.add(*_times(np.full(len(f), bounds.effort), along), h[:, 2, 0] / k, effort)


def _along(one: Complex, turned: Complex, q: Array) -> tuple[Array, Array]:
    """Re(D conj(D') / |D'|) as its value (m,) without taps and its derivatives (m, taps) by them, D' with taps q."""
    last = one + turned @ q
    towards = np.conj(last) / np.abs(last)
    return np.real(towards * one), np.real(towards[:, None] * turned)


def _times(most: Array, along: tuple[Array, Array]) -> tuple[Array, Array]:
    return most * along[0], most[:, None] * along[1]


def _ask_changed(cones: "_Cones", loop: InnovationLoop, f: Array, q: Array) -> None:
    (s, by_tap), (one, turned) = loop.fraction(f, cones.taps)
    last = np.abs(one + turned @ q)
    along, along_by_tap = _along(one, turned, q)
    cones.keep(along - _TURN * last, along_by_tap)
    near = np.abs(s + by_tap @ q) > _FAR * loop.peak_s * last
    loop.close_hz = np.union1d(loop.close_hz, f[near])
    near = np.isin(f, np.union1d(loop.close_hz, loop.more_hz)) | (not q.any())  # with the first taps everything moves
    bound, bound_by_tap = loop.peak_s * along[near], loop.peak_s * along_by_tap[near]
    cones.add(bound, bound_by_tap, s[near], by_tap[near], may_be_conceded=True)


def _refine(loop: InnovationLoop, taps: Array, peak_s: float, base_hz: Array) -> tuple[float, float]:
    """Spectral radius and largest |S| over its bound with these taps; where it is near the bound, or beyond the
    circle, points join the loop's grid.
    """
    poles = loop.poles_with(taps)
    beyond = poles[np.abs(poles) >= 1.0]
    fine = np.unique(np.concatenate([loop.grid_hz(base_hz), about(poles, loop.period_s, 4)]))
    fine = fine[(fine > 0.0) & (fine <= 0.5 / loop.period_s)]
    s = np.abs(loop.sensitivity(fine, taps)) / peak_s
    padded = np.r_[0.0, s, 0.0]
    peaks = fine[(s > 0.985) & (s >= padded[:-2]) & (s >= padded[2:])]
    loop.more_hz = np.unique(np.concatenate([loop.more_hz, peaks, about(beyond, loop.period_s, 4)]))
    return float(np.abs(poles).max()), float(s.max())


@dataclass
class _Cones:
    """Rows of a programme over taps x (N/m) and a concession c >= 0: |v + V x| <= t + T x (+ c), and t + T x >= 0."""

    taps: int
    cones: list[Array] = field(default_factory=list)
    """(m, 3, taps + 1) of what is taken from ``cone_at``"""
    cone_at: list[Array] = field(default_factory=list)
    """(m, 3)"""
    rows: list[Array] = field(default_factory=list)
    row_at: list[Array] = field(default_factory=list)

    def add(
        self,
        bound: Array,
        bound_by_tap: Array,
        value: Complex,
        by_tap: Complex,
        *,
        may_be_conceded: bool = False,
    ) -> None:
        """|value + by_tap x| <= bound + bound_by_tap x at frequencies (m,), and more by the concession."""
        rows = np.zeros((len(bound), 3, self.taps + 1))
        rows[:, 0, :-1], rows[:, 1, :-1], rows[:, 2, :-1] = -bound_by_tap, -by_tap.real, -by_tap.imag
        rows[:, 0, -1] = -1.0 if may_be_conceded else 0.0
        self.cones.append(rows)
        self.cone_at.append(np.stack([bound, value.real, value.imag], axis=1))

    def keep(self, value: Array, by_tap: Array) -> None:
        """value + by_tap x >= 0 at frequencies (m,)."""
        self.rows.append(np.hstack([-by_tap, np.zeros((len(value), 1))]))
        self.row_at.append(value)

    def least(self, quadratic: tuple[Array, Array, float], unit: float) -> tuple[Array, float]:
        """Taps of the least value of a quadratic (of ``_hold_variance``) and a dear concession, and that. Raises
        ``LawError`` where what is asked of the plant as drawn can't be had.
        """
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        scale, units = 1.0 / quadratic[2], np.r_[np.full(self.taps, unit), 1.0]
        hessian = np.zeros((self.taps + 1, self.taps + 1))
        hessian[:-1, :-1] = 2.0 * scale * unit**2 * quadratic[0]
        linear = np.r_[2.0 * scale * unit * quadratic[1], _DEAR]
        conceded = np.r_[np.zeros(self.taps), -1.0][None]
        rows = np.vstack([conceded, *self.rows, np.concatenate(self.cones).reshape(-1, self.taps + 1)]) * units
        at = np.concatenate([[0.0], *self.row_at, np.concatenate(self.cone_at).ravel()])
        linear_rows = 1 + sum(len(part) for part in self.row_at)
        kinds = [clarabel.NonnegativeConeT(linear_rows)]
        kinds += [clarabel.SecondOrderConeT(3)] * ((len(at) - linear_rows) // 3)
        solution = clarabel.DefaultSolver(
            scipy.sparse.csc_matrix(np.triu(hessian)), linear, scipy.sparse.csc_matrix(rows), at, kinds, settings
        ).solve()
        if str(solution.status) not in ("Solved", "AlmostSolved"):
            raise LawError(
                f"no filter of {self.taps} taps keeps the bounds of the plant as drawn ({solution.status}); lower "
                "edge_hz, or allow a larger peak_s"
            )
        return np.asarray(solution.x[:-1]) * unit, float(solution.x[-1])
