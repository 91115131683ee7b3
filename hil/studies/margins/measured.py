"""Sensitivity of the running loop, measured: the loop is excited, and what it makes of the excitation is recorded.

The excitation n is added to the measurement, so the law sees m = y + n with y = -T n, hence m = S n: S column by column
from the discrete Fourier transforms of whole periods, an axis after the other; T = I - S and L = S^-1 - I. Periods
differ by noise alone, and their spread says how well S is known.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.interpolate
from numpy.typing import NDArray

from hil.lanes.lane import Lane
from hil.lanes.setup import Setup
from hil.studies.margins.excited import Excited, excite
from pkxyz_ctrl.design.margins.margins import LoopResponse, Margins, margins_of_response

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class MeasuredLoop:
    """S at the tones of the excitation, and the standard error of each entry (of its distance in the plane)."""

    frequency_hz: Array
    """(k,)"""
    s: Complex
    """(k, 3, 3)"""
    standard_error: Array
    """(k, 3, 3)"""
    periods: int
    """of each passage, from which they are"""
    missed_ticks: int
    """while it was excited; their periods, and those after them, are left out"""

    def response(self) -> LoopResponse:
        """L, S and T."""
        eye = np.eye(3)
        return LoopResponse(
            self.frequency_hz, np.asarray(np.linalg.inv(self.s) - eye), self.s, np.asarray(eye - self.s)
        )

    def margins(self) -> Margins:
        """Margins of the measured response, by a spline through its points. The loop ran, so it is stable; its
        spectral radius can't be measured (NaN).
        """
        return sampled_margins(self.frequency_hz, self.s)


def sampled_margins(frequency_hz: Array, s: Complex) -> Margins:
    """Margins of a stable loop that is known at some frequencies (k,) only, as S (k, 3, 3): between them by a spline
    over the logarithm of frequency.
    """
    spline = scipy.interpolate.CubicSpline(np.log(frequency_hz), s, axis=0)
    return margins_of_response(frequency_hz, s, lambda f: np.asarray(spline(np.log(f)), dtype=np.complex128))


def measure(
    setup: Setup,
    lane: Lane,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    say: Callable[[str], object] = lambda words: None,
) -> MeasuredLoop:
    """Run a setup of ``at_point`` in a lane and take S from it. Raises ``MeasurementError`` where the loop did not
    stay closed to the end.
    """
    excited = excite(setup, lane, ("measurement_m",), on_progress, say)
    return _from_periods(excited, setup.bus.period_s)


def _from_periods(excited: Excited, period_s: float) -> MeasuredLoop:
    excitation, seen_m = excited.excitation, excited.seen["measurement_m"]
    n, m = excitation.period_ticks, len(excited.periods[0])
    bins = np.unique(np.concatenate([p.bins for p in excitation.passages]))
    s = np.zeros((len(bins), 3, 3), np.complex128)
    standard_error = np.zeros((len(bins), 3, 3))
    for k, passage in enumerate(excitation.passages):
        rows = excitation.ticks_of(k, excited.periods[k])
        spectrum = np.fft.rfft(seen_m[rows].reshape(m, n, 3), axis=1)[:, passage.bins]  # (m, tones, 3)
        added = np.fft.rfft(excitation.sample(excitation.measured_from(k), n)[:, passage.axis])[passage.bins]
        ratio = spectrum / added[None, :, None]
        at = np.searchsorted(bins, passage.bins)
        s[at, :, passage.axis] = ratio.mean(axis=0)
        spread = np.abs(ratio - ratio.mean(axis=0)) ** 2
        standard_error[at, :, passage.axis] = np.sqrt(spread.sum(axis=0) / (m - 1) / m)
    return MeasuredLoop(bins / (n * period_s), s, standard_error, m, excited.missed_ticks)
