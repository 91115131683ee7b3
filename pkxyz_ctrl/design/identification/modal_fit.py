"""Modes of the stage from its measured response: three pairs of poles that all nine entries share, all else free.

    P(z) = z^-n [sum over i of (B_i + C_i z^-1) / (1 - 2 Re(p_i) z^-1 + |p_i|^2 z^-2)  +  D  +  E / (1 - a z^-1)]

p_i = exp(s_i T), n = d + 1: what is asked for at a sample acts d periods later and is seen at the sample after that.
B_i, C_i, D and E (3, 3) are free real matrices: whatever amplifier, delays within a period and faster modes do to the
stage's own modes is in them, and nothing needs to be assumed of it. The fit is of y to P u, output by output, each tone
with the weight of the noise there; for given poles it is linear, so only poles are searched for (variable projection).

a = exp(-2 pi f_c T) is the sense chain, a pole of first order at f_c that the three share. It is left out where it
explains no more than it would of noise. Where there is one, it takes (1 + s_i / 2 pi f_c) off each mode's numerator.

Two modes may coincide, as x and y of a stage as drawn do at mid-workspace: they move the chains in
two patterns with one pair of poles, and a third pair would only fit noise. So two pairs are tried as
well, and taken where a third explains nothing.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.optimize
import scipy.stats
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

MODES = 3

STARTS = ((0.97, 1.03, 1.0), (0.9, 1.1, 1.05), (0.97, 1.0, 0.95), (1.1, 1.2, 1.1))
"""What the drawing's modes are multiplied with to begin the search; the next is tried where more than noise is left."""

NOISE_ALONE = 1.5
"""Mean square of the weighted residual up to which noise explains it."""

_NO_CORNER = np.zeros(0)
_CORNER, _FASTEST_CORNER = 0.3, 2.0  # of the sampling rate: where the search for the sense chain's begins, and ends

CONFIDENCE = 0.999
"""With which two modes that coincide are found as one pair of poles, and the sense chain as a pole."""


class FitError(ValueError):
    """A response that doesn't tell the modes; the message says what to change."""


@dataclass(frozen=True)
class ModalFit:
    """Natural frequencies |s| / 2 pi in ascending order, damping ratios, and the response at frequency 0."""

    frequency_hz: Array
    """(3,) two alike where modes coincide as far as noise tells: they share a pair of poles"""
    damping: Array
    """(3,) -Re(s) / |s| = 1 / 2Q"""
    static_gain: Array
    """(3, 3) in counts per V^2: P(z = 1), chains' counts down, combs across"""
    acceleration_gain: Array
    """(3, 3) in counts/s^2 per V^2: how fast a step of V^2 sets the chains in motion, springs aside. The modes'
    numerators add up to M^-1, so that is the sense gains times J J^T over the mass times the comb gains.
    """
    frequency_standard_error_hz: Array
    damping_standard_error: Array
    static_gain_standard_error: Array
    acceleration_gain_standard_error: Array
    """shapes as above"""
    lag_s: float
    """of the response beyond whole periods: amplifier and sense chain together, from all modes"""
    lag_standard_error_s: float
    gains_covariance: Array
    """(18, 18) of static and acceleration gain, row by row: both come from the same poles and residues"""
    chi_square: float
    """weighted residual's mean square, 1 where noise alone is left"""
    used_hz: tuple[float, float]
    """lowest and highest tone that was fitted"""
    _coefficients: Array
    _period_s: float
    _delay_periods: int
    sense_corner_hz: float | None = None
    """of the sense chain; None where it is too fast to tell"""
    sense_corner_standard_error_hz: float | None = None
    resonances_covariance: Array | None = None
    """(18 + n, 18 + n) of the gains and of the frequencies of n pairs of poles, where there is a sense chain's too"""

    @property
    def noise_alone(self) -> bool:
        """Whether the fit leaves nothing but noise."""
        return self.chi_square < NOISE_ALONE

    @property
    def apart(self) -> NDArray[np.bool_]:
        """(3,) one for each pair of poles: False for a mode that shares those of the one before."""
        return np.asarray(np.diff(self.frequency_hz, prepend=0.0) > 0.0)

    def response(self, frequency_hz: Array) -> Complex:
        """P (k, 3, 3) in counts per V^2 at frequencies (k,)."""
        corner = [] if self.sense_corner_hz is None else [self.sense_corner_hz]
        poles = np.concatenate([self.frequency_hz[self.apart], self.damping[self.apart], corner])
        basis = _basis(frequency_hz, poles, self._period_s, self._delay_periods)
        return np.asarray(np.einsum("kb,bij->kij", basis, self._coefficients))


def fit_modes(
    frequency_hz: Array,
    drive_v2: Complex,
    sense_count: Complex,
    noise_count: Array,
    *,
    period_s: float,
    delay_periods: int,
    start_hz: Array,
    start_damping: float,
) -> ModalFit:
    """Fit to spectra U, Y (k, 3, 3) (last axis: the excitation) with the standard deviations (k, 3) of Y's distance in
    the plane; ``start_hz`` (3,) is where the search begins, and twice its highest is how far tones count.
    """
    low, high = float(frequency_hz.min()), min(2.0 * float(start_hz.max()), 0.45 / period_s)
    used = frequency_hz <= high
    unknowns = 3 * (2 * MODES + 1)
    if 2 * 3 * int(used.sum()) < 2 * (unknowns + 2 * MODES):
        raise FitError(
            f"{int(used.sum())} tones up to {high:.0f} Hz are too few for {MODES} modes; give more tones or periods"
        )
    f, u, y = frequency_hz[used], drive_v2[used], sense_count[used]
    sigma = noise_count[used] / math.sqrt(2.0)  # of the real and of the imaginary part

    def columns(modes: Array) -> Array:
        """(2 k 3, unknowns): real and imaginary parts of basis times U, per tone and passage."""
        basis = _basis(f, np.exp(modes), period_s, delay_periods)
        regressors = np.einsum("kb,kjp->kpbj", basis, u).reshape(3 * len(f), -1)
        return np.concatenate([regressors.real, regressors.imag])

    weight = np.repeat(1.0 / sigma, 3, axis=0)  # (k passages, chains)
    weight = np.concatenate([weight, weight])
    flat = np.swapaxes(y, 1, 2).reshape(3 * len(f), 3)
    seen = np.concatenate([flat.real, flat.imag])

    def solved(modes: Array) -> tuple[Array, Array]:
        matrix = columns(modes)
        theta = np.stack([_least_squares(matrix * w[:, None], seen[:, i] * w) for i, w in enumerate(weight.T)], axis=1)
        return theta, (seen - matrix @ theta) * weight

    def searched(hz: Array, corner_hz: Array) -> "scipy.optimize.OptimizeResult":
        start = np.log(np.concatenate([hz, np.full(len(hz), start_damping), corner_hz]))
        highest = np.full(len(start), math.log(0.5 / period_s))
        highest[2 * len(hz) :] = math.log(_FASTEST_CORNER / period_s)
        return scipy.optimize.least_squares(
            lambda modes: solved(modes)[1].ravel(), start, x_scale=0.01, bounds=(math.log(1e-5), highest)
        )

    def tells(rich: "scipy.optimize.OptimizeResult", poor: "scipy.optimize.OptimizeResult", more: int) -> bool:
        """Whether ``more`` unknowns explain more than they would of noise."""
        noise = max(1.0, 2.0 * float(rich.cost) / seen.size)
        return bool(2.0 * float(poor.cost - rich.cost) >= scipy.stats.chi2.ppf(CONFIDENCE, more) * noise)

    best = searched(np.array(STARTS[0]) * start_hz, _NO_CORNER)
    for split in STARTS:
        if 2.0 * float(best.cost) < NOISE_ALONE * seen.size:
            break
        tried = [
            searched(np.array(split) * start_hz, corner) for corner in (_NO_CORNER, np.array([_CORNER / period_s]))
        ]
        best = min(best, *tried, key=lambda found: float(found.cost))
    if len(best.x) == 2 * MODES:
        late = searched(np.exp(best.x[:MODES]), np.array([_CORNER / period_s]))
        if tells(late, best, 1 + 9):  # the pole, and E
            best = late
    modes, shared = _ascending(best.x, MODES), np.arange(MODES)
    near = int(np.argmin(np.diff(modes[:MODES])))
    merged = searched(np.exp(np.delete(modes[:MODES], near)), np.exp(modes[2 * MODES :]))
    if not tells(best, merged, 2 + 3 * 2 * 3):  # a frequency, a damping, B and C
        modes, shared = _ascending(merged.x, MODES - 1), np.repeat([0, 1], [2, 1] if near == 0 else [1, 2])
    theta, residual = solved(modes)
    spare = residual.size - theta.size - len(modes)
    chi_square = float((residual**2).sum() / spare)
    covariance = _covariance(modes, theta, columns, weight) * max(1.0, chi_square)
    values, slopes = _propagated(modes, theta, len(covariance), period_s, delay_periods)
    values_covariance = slopes @ covariance @ slopes.T
    pairs = len(modes) // 2
    resonant = np.concatenate([slopes[:18], np.eye(pairs, len(covariance)) * np.exp(modes[:pairs, None])])
    static, acceleration = values[:18].reshape(2, 3, 3)
    gains_covariance = values_covariance[:18, :18]
    lag_s, lag_standard_error_s = combined(values[18:], values_covariance[18:, 18:])
    static_standard_error, acceleration_standard_error = np.sqrt(np.diag(gains_covariance)).reshape(2, 3, 3)
    poles, of_poles = np.exp(modes), np.sqrt(np.diag(covariance))[: len(modes)]
    (*both, corner), (*of_both, of_corner) = _split(poles), _split(of_poles)
    hz, ratio = (half[shared] for half in both)
    of_hz, of_ratio = (half[shared] for half in of_both)
    if not (hz.min() > low and hz.max() < high):
        raise FitError(
            f"modes were found at {hz.min():.0f} to {hz.max():.0f} Hz, the tones lie from {low:.0f} to {high:.0f} Hz; "
            "raise the amplitude or the periods"
        )
    return ModalFit(
        frequency_hz=hz,
        damping=ratio,
        static_gain=static,
        acceleration_gain=acceleration,
        frequency_standard_error_hz=hz * of_hz,
        damping_standard_error=ratio * of_ratio,
        static_gain_standard_error=static_standard_error,
        acceleration_gain_standard_error=acceleration_standard_error,
        lag_s=lag_s,
        lag_standard_error_s=lag_standard_error_s,
        gains_covariance=gains_covariance,
        chi_square=chi_square,
        used_hz=(low, float(f.max())),
        _coefficients=_per_input(theta),
        _period_s=period_s,
        _delay_periods=delay_periods,
        sense_corner_hz=float(corner[0]) if len(corner) else None,
        sense_corner_standard_error_hz=float(corner[0] * of_corner[0]) if len(corner) else None,
        resonances_covariance=resonant @ covariance @ resonant.T if len(corner) else None,
    )


def _split(poles: Array) -> tuple[Array, Array, Array]:
    """Of frequencies and of dampings, (n,) each, from (2 n,) or (2 n + 1,); last the corner, (0,) or (1,)."""
    n = len(poles) // 2
    return poles[:n], poles[n : 2 * n], poles[2 * n :]


def _ascending(poles: Array, pairs: int) -> Array:
    hz, damping, corner = _split(poles)
    assert len(hz) == pairs
    order = np.argsort(hz)
    return np.concatenate([hz[order], damping[order], corner])


def _least_squares(matrix: Array, right: Array) -> Array:
    q, r = np.linalg.qr(matrix)
    return np.asarray(scipy.linalg.solve_triangular(r, q.T @ right))


def _basis(f: Array, poles: Array, period_s: float, delay_periods: int) -> Complex:
    """(k, 2 modes + 1) functions of z at frequencies (k,), and one more for the sense chain."""
    hz, damping, corner = _split(poles)
    back = np.exp(-2j * math.pi * f * period_s)
    s = 2.0 * math.pi * hz * (-damping + 1j * np.sqrt(np.maximum(1.0 - damping**2, 0.0)))
    pole = np.exp(s * period_s)
    out = np.empty((len(f), 2 * len(hz) + 1 + len(corner)), np.complex128)
    for i, p in enumerate(pole):
        resonance = back ** (delay_periods + 1) / (1.0 - 2.0 * p.real * back + abs(p) ** 2 * back**2)
        out[:, 2 * i], out[:, 2 * i + 1] = resonance, resonance * back
    out[:, 2 * len(hz)] = back ** (delay_periods + 1)
    if len(corner):
        out[:, -1] = back ** (delay_periods + 1) / (1.0 - math.exp(-2.0 * math.pi * corner[0] * period_s) * back)
    return out


def _per_input(theta: Array) -> Array:
    """(basis, outputs, inputs) from the columns (basis * inputs, outputs) of the fit."""
    return np.ascontiguousarray(np.moveaxis(theta.reshape(-1, 3, 3), 2, 1))


def _static_gain(modes: Array, theta: Array, period_s: float, delay_periods: int) -> Array:
    """P(z = 1), (3, 3)."""
    basis = _basis(np.zeros(1), np.exp(modes), period_s, delay_periods)[0].real
    return np.asarray(np.einsum("b,bij->ij", basis, _per_input(theta)))


def combined(values: Array, covariance: Array) -> tuple[float, float]:
    """The one number that (n,) values with a covariance (n, n) say together, and its standard error."""
    weight = np.linalg.solve(covariance, np.ones(len(values)))
    return float(weight @ values / weight.sum()), float(weight.sum() ** -0.5)


def _sudden(modes: Array, theta: Array, period_s: float, delay_periods: int) -> tuple[Array, Array]:
    """Sum of the modes' numerators, (3, 3), from their residues, and the lag of amplifier and
    sense chain within a period in s as each pair of poles (n,) shows it: it turns a mode's
    numerators by a common angle, which is taken back, as is what the sense chain does to them.
    """
    coefficients, total, lags_s = _per_input(theta), np.zeros((3, 3)), np.zeros(len(modes) // 2)
    frequencies, dampings, corner = _split(np.exp(modes))
    sense_s = 0.5 / (math.pi * float(corner[0])) if len(corner) else 0.0
    for i, (hz, d) in enumerate(zip(frequencies, dampings, strict=True)):
        w = 2.0 * math.pi * hz
        s = w * complex(-d, math.sqrt(1.0 - d * d))
        p = np.exp(s * period_s)
        residue = p ** (1 - delay_periods) * (coefficients[2 * i] + coefficients[2 * i + 1] / p) / (p - p.conjugate())
        numerator = residue * p**delay_periods * s / (p - 1.0) * (s - s.conjugate()) * (1.0 + s * sense_s)
        late_s = -0.5 * float(np.angle((numerator**2).sum())) / s.imag
        total += (numerator * np.exp(s * max(0.0, late_s))).real
        lags_s[i] = late_s + sense_s
    return total, lags_s


def _values(modes: Array, theta: Array, period_s: float, delay_periods: int) -> Array:
    """(18 + n,): static and acceleration gain, row by row, and the lags that n pairs of poles show."""
    acceleration, lags_s = _sudden(modes, theta, period_s, delay_periods)
    static = _static_gain(modes, theta, period_s, delay_periods)
    return np.concatenate([static.ravel(), acceleration.ravel(), lags_s])


def _propagated(modes: Array, theta: Array, unknowns: int, period_s: float, delay_periods: int) -> tuple[Array, Array]:
    """``_values`` and their slopes over all unknowns, by central differences."""
    nonlinear = len(modes)
    slopes = np.zeros((18 + nonlinear // 2, unknowns))
    for n in range(unknowns):
        step = np.zeros(unknowns)
        linear = n - nonlinear
        step[n] = 1e-6 if linear < 0 else 1e-6 * max(1.0, float(np.abs(theta).max()))
        pair = [
            _values(
                modes + sign * step[:nonlinear],
                theta + sign * step[nonlinear:].reshape(3, -1).T,
                period_s,
                delay_periods,
            )
            for sign in (1.0, -1.0)
        ]
        slopes[:, n] = (pair[0] - pair[1]) / (2.0 * step[n])
    return _values(modes, theta, period_s, delay_periods), slopes


def _covariance(modes: Array, theta: Array, columns: Callable[[Array], Array], weight: Array) -> Array:
    """Of log frequencies, log dampings and the linear unknowns of output 1, 2, 3, for unit weights."""
    here, unknowns, nonlinear = columns(modes), len(theta), len(modes)
    jacobian = np.zeros((3 * len(here), nonlinear + 3 * unknowns))
    slopes = []
    for n in range(nonlinear):
        step = np.zeros(nonlinear)
        step[n] = 1e-6
        slopes.append((columns(modes + step) - columns(modes - step)) / 2e-6 @ theta)
    for i in range(3):
        rows = slice(i * len(here), (i + 1) * len(here))
        jacobian[rows, :nonlinear] = np.stack([slope[:, i] for slope in slopes], axis=1) * weight[:, [i]]
        jacobian[rows, nonlinear + i * unknowns : nonlinear + (i + 1) * unknowns] = here * weight[:, [i]]
    scale = np.linalg.norm(jacobian, axis=0)
    inverse = np.linalg.pinv(jacobian / scale)
    return np.asarray(inverse @ inverse.T / np.outer(scale, scale))
