"""An excitation of the running loop: periods of a multisine, or of one sine after the other, on one axis at a time.

Its tones lie on the bins of a period of N ticks, so a period's discrete Fourier transform takes them apart without
leakage, and periods beyond the first show what noise there is.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SETTLE_PERIODS = 1
"""Periods of each passage that are played before those that are measured: the loop's transients are gone by then."""


@dataclass(frozen=True)
class Passage:
    """``SETTLE_PERIODS + periods`` periods of tones on one axis."""

    axis: int
    bins: NDArray[np.int64]
    """(k,) tones, as periods in N ticks"""
    phase_rad: Array
    """(k,)"""


@dataclass(frozen=True)
class Excitation:
    """Passages one after another, all axes in turn; nothing before ``first_tick`` and after the last."""

    period_ticks: int
    """N"""
    periods: int
    """measured in each passage"""
    amplitude_m: float
    """of each tone"""
    first_tick: int
    """of the trajectory"""
    passages: tuple[Passage, ...]

    @property
    def ticks(self) -> int:
        """From the first tick of the trajectory to the end of the excitation."""
        return self.first_tick + len(self.passages) * self.passage_ticks

    @property
    def passage_ticks(self) -> int:
        """Ticks of one passage."""
        return (SETTLE_PERIODS + self.periods) * self.period_ticks

    def measured_from(self, passage: int) -> int:
        """Trajectory tick at which the measured periods of a passage begin."""
        return self.first_tick + passage * self.passage_ticks + SETTLE_PERIODS * self.period_ticks

    def undisturbed(self, passage: int, spoilt: NDArray[np.bool_], settling_ticks: int) -> NDArray[np.int64]:
        """Which of its measured periods, from 0, ran through as played, and so did what is before them while the loop
        settles, whose transients they would show; ``spoilt`` (ticks,) says at which ticks of the trajectory the loop
        did not see what it should.
        """
        begin = self.measured_from(passage) + self.period_ticks * np.arange(self.periods)
        broken = np.concatenate([[0], np.cumsum(spoilt)])
        return np.flatnonzero(broken[begin + self.period_ticks] == broken[np.maximum(begin - settling_ticks, 0)])

    def ticks_of(self, passage: int, periods: NDArray[np.int64]) -> NDArray[np.int64]:
        """(len(periods) N,) ticks of the trajectory of some of its measured periods."""
        first = self.measured_from(passage) + self.period_ticks * periods
        return np.asarray((first[:, None] + np.arange(self.period_ticks)).ravel())

    def sample(self, first_tick: int, count: int) -> Array:
        """(count, 3) in m at ticks first_tick, first_tick + 1, ... of the trajectory."""
        out = np.zeros((count, 3))
        past, length = first_tick - self.first_tick, self.passage_ticks
        for n in range(max(past // length, 0), min((past + count - 1) // length + 1, len(self.passages))):
            begin = self.first_tick + n * length
            low, high = max(begin, first_tick), min(begin + length, first_tick + count)
            rows = slice(low - first_tick, high - first_tick)
            at = np.arange(low - begin, high - begin) % self.period_ticks
            out[rows, self.passages[n].axis] = self._one_period[n][at]
        return out

    @cached_property
    def _one_period(self) -> list[Array]:
        """(N,) of each passage; from the inverse transform, so its bins are exact."""
        spectra = np.zeros((len(self.passages), self.period_ticks // 2 + 1), np.complex128)
        for spectrum, passage in zip(spectra, self.passages, strict=True):
            spectrum[passage.bins] = np.exp(1j * passage.phase_rad)
        scaled = spectra * (0.5 * self.period_ticks)
        return [self.amplitude_m * np.fft.irfft(each, self.period_ticks) for each in scaled]


def tones(period_ticks: int, count: int, lowest: int = 5) -> NDArray[np.int64]:
    """Bins, about ``count`` of them, evenly by ratio from ``lowest`` to just below half the sampling rate."""
    highest = period_ticks // 2 - 1
    return np.unique(np.round(np.geomspace(lowest, highest, count)).astype(np.int64))


def excitation(
    kind: Literal["multisine", "stepped"],
    bins: NDArray[np.int64],
    *,
    period_ticks: int,
    periods: int,
    amplitude_m: float,
    first_tick: int,
    seed: int,
) -> Excitation:
    """x, y, z in turn; "multisine": all tones at once, in phases sampled by the seed; "stepped": one after another."""
    if not (bins.min() > 0 and bins.max() < period_ticks / 2):
        raise ValueError(f"tones must lie between 0 and half the sampling rate, not at bins {bins.min()}..{bins.max()}")
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, (3, len(bins)))
    groups = [np.arange(len(bins))] if kind == "multisine" else [np.array([k]) for k in range(len(bins))]
    passages = tuple(Passage(axis, bins[group], phases[axis, group]) for axis in range(3) for group in groups)
    return Excitation(period_ticks, periods, amplitude_m, first_tick, passages)
