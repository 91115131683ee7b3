"""A periodic shift of the reference as harmonics, and as the rows that the law is handed.

Harmonics are rfft / N, counted from the first tick of the scan: ``(K, 3)`` complex, in m, of k = 1 ... K. There is no
constant part: constant errors are the law's affair.
"""

import math

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.learning.timetable import FADE_TICKS

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


def harmonics(error_m: Array, phase_ticks: int, count: int) -> Complex:
    """(count, 3) of a period (N, 3) whose row 0 lies ``phase_ticks`` after a beginning of the scan's period."""
    spectrum = np.fft.rfft(error_m, axis=0)[1 : count + 1] / len(error_m)
    k = np.arange(1, count + 1)[:, None]
    turned: Complex = spectrum * np.exp(-2j * math.pi * ((k * phase_ticks) % len(error_m)) / len(error_m))
    return turned


def count_up_to(cutoff_hz: float, period_ticks: int, tick_s: float) -> int:
    """K: harmonics up to the cutoff, all of them below a quarter of the sampling rate; at least one."""
    return max(1, min(math.floor(cutoff_hz * period_ticks * tick_s + 1e-9), (period_ticks - 1) // 4))


def noise(error_m: Array) -> Array:
    """Mean square (3,) of a harmonic that only noise makes, in m2, from the upper half of the spectrum of (N, 3).

    By the median, which for squares of noise is ln 2 of the mean, so single lines (a parasitic mode) count for nothing.
    """
    power = np.abs(np.fft.rfft(error_m, axis=0) / len(error_m)) ** 2
    upper = power[len(error_m) // 4 + 1 : (len(error_m) + 1) // 2]
    return np.asarray(np.median(upper, axis=0) / math.log(2.0))


def period_rows(correction: Complex, period_ticks: int, tick_s: float) -> Array:
    """(N, 9): shift of position (m), and its exact first and second derivative."""
    omega = 2.0 * math.pi * np.arange(1, len(correction) + 1)[:, None] / (period_ticks * tick_s)
    spectrum = np.zeros((period_ticks // 2 + 1, 9), np.complex128)
    for order in range(3):
        spectrum[1 : len(correction) + 1, 3 * order : 3 * order + 3] = correction * (1j * omega) ** order
    rows: Array = np.fft.irfft(spectrum * period_ticks, period_ticks, axis=0)
    return rows


def fade(tick: NDArray[np.int64], first_tick: int, tick_s: float) -> tuple[Array, Array, Array]:
    """Weight (n,) that goes from 0 to 1 in ``FADE_TICKS``, with its derivatives in 1/s and 1/s2.

    The quintic without slope and curvature at its ends.
    """
    total_s = FADE_TICKS * tick_s
    s = np.clip((tick - first_tick) / FADE_TICKS, 0.0, 1.0)
    value = s * s * s * (10.0 + s * (6.0 * s - 15.0))
    return value, 30.0 * s * s * (1.0 - s) ** 2 / total_s, 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / total_s**2


def weighted(rows: Array, weight: tuple[Array, Array, Array]) -> Array:
    """(n, 9) of weight times rows, by the product rule."""
    w, w1, w2 = (v[:, None] for v in weight)
    p, v, a = rows[:, 0:3], rows[:, 3:6], rows[:, 6:9]
    return np.concatenate([w * p, w1 * p + w * v, w2 * p + 2.0 * w1 * v + w * a], axis=1)
