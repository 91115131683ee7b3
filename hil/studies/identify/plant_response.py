"""What the stage makes of its combs' squared voltages, measured in the running loop: from V^2 to sense counts.

The excitation passes round the loop, so both the squared voltages u and the counts y know of it, and of the noise. At a
tone, the means over the periods of the three passages give U and Y (3, 3), and P = Y U^-1: the noise that the loop
feeds back averages out of both alike (the joint input-output method), where y over u of one record would be biased.

The combs charge and the forces drift within seconds, and a ramp is no multiple of a period: a polynomial over each
passage is fitted beside the periods and taken away, or it would stand in every low tone.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.lanes.excitation import Excitation, Passage
from hil.lanes.lane import Lane
from hil.lanes.setup import Setup
from hil.studies.margins.excited import Excited, excite

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

TREND_DEGREE = 4
"""Of the polynomial over a passage: leaves 4e-5 of an exponential of 5 s over 6 s."""


@dataclass(frozen=True)
class SenseZero:
    """What homing found: the capacitance at rest less its value by the drawing."""

    offset_f: Array
    """(3,)"""
    offset_count: Array
    """(3,) the same in sense counts"""
    standard_error_f: Array
    """(3,) standard error, from the spread of the samples"""
    samples: int


@dataclass(frozen=True)
class PlantResponse:
    """Spectra at k tones of N ticks, the last axis the passage (x, y, z excited)."""

    frequency_hz: Array
    """(k,)"""
    drive_v2: Complex
    """(k, 3, 3) of the squared voltages asked for, combs first"""
    sense_count: Complex
    """(k, 3, 3) of the sense counts, chains first"""
    noise_count: Array
    """(k, 3) standard deviation, of its distance in the plane, of what the stage doesn't explain in a mean spectrum of
    ``sense_count``: noise of sense and of forces
    """
    coherence: Array
    """(k, 3) of each chain, 0..1: share of one period's power there that U explains"""
    period_s: float
    delay_periods: int
    mean_v2: Array
    """(3,) about which it was measured"""
    strokes_m: Array
    """(3,) about which it was measured, as the controller saw them"""
    measured_s: float
    """middle of the measured periods after the arrival at the point"""
    zero: SenseZero
    missed_ticks: int
    """while it was excited; their periods, and those after them, are left out"""

    @property
    def p(self) -> Complex:
        """(k, 3, 3) in counts per V^2, from the squared voltages of one tick to the counts of the same."""
        return np.asarray(self.sense_count @ np.linalg.inv(self.drive_v2))

    @property
    def standard_error(self) -> Array:
        """(k, 3, 3) standard error of the entries of ``p``, of their distance in the plane."""
        inverse = np.linalg.inv(self.drive_v2)
        return np.asarray(self.noise_count[:, :, None] * np.sqrt((np.abs(inverse) ** 2).sum(axis=1))[:, None, :])


def measure_plant(
    setup: Setup,
    lane: Lane,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    say: Callable[[str], object] = lambda words: None,
) -> PlantResponse:
    """Run a setup of ``at_point`` in a lane and take P from it. Raises ``MeasurementError`` where the loop did not stay
    closed to the end.
    """
    excited = excite(setup, lane, ("sense_count", "drive_count"), on_progress, say)
    scale, offset = setup.bus.analog.sense_farad_per_count, setup.bus.analog.sense_offset_f
    zero_f = offset + scale * excited.last["sense_count"] - excited.last["sense_f"]
    at_rest = excited.homing_count
    error_f = scale * at_rest.std(axis=0, ddof=1) / np.sqrt(len(at_rest))
    return _from_periods(setup, excited, SenseZero(zero_f, zero_f / scale, error_f, len(at_rest)))


def _from_periods(setup: Setup, excited: Excited, zero: SenseZero) -> PlantResponse:
    excitation, seen = excited.excitation, excited.seen["sense_count"]
    squared_v2 = (setup.bus.analog.drive_volt_per_count * excited.seen["drive_count"]) ** 2
    n, m = excitation.period_ticks, len(excited.periods[0])
    bins = np.unique(np.concatenate([p.bins for p in excitation.passages]))
    u, y = (np.zeros((m, len(bins), 3, 3), np.complex128) for _ in range(2))
    for k, passage in enumerate(excitation.passages):
        rows, periods = excitation.ticks_of(k, excited.periods[k]), excited.periods[k]
        at, trend = np.searchsorted(bins, passage.bins), _trend(excitation, periods)
        u[..., passage.axis][:, at] = _spectra(squared_v2[rows], passage, trend)
        y[..., passage.axis][:, at] = _spectra(seen[rows], passage, trend)
    mean_u, mean_y = u.mean(axis=0), y.mean(axis=0)
    p = mean_y @ np.linalg.inv(mean_u)
    unexplained = y - p @ u  # (m, k, 3, 3); its mean is 0
    power = (np.abs(unexplained) ** 2).sum(axis=(0, 3)) / (3 * (m - 1))  # of one period, (k, 3)
    explained = (np.abs(p @ mean_u) ** 2).mean(axis=2)
    first = excitation.measured_from(0)
    rest_f = float(setup.law[0]["tick"]["sense"]["rest_f"])
    stroke_per_f = setup.law[0]["tick"]["sense"]["metre_per_farad"]
    analog = setup.bus.analog
    mean_f = analog.sense_offset_f + analog.sense_farad_per_count * seen[first:].mean(axis=0) - zero.offset_f - rest_f
    return PlantResponse(
        frequency_hz=bins / (n * setup.bus.period_s),
        drive_v2=mean_u,
        sense_count=mean_y,
        noise_count=np.sqrt(power / m),
        coherence=explained / (explained + power),
        period_s=setup.bus.period_s,
        delay_periods=setup.bus.delay_periods,
        mean_v2=squared_v2[first:].mean(axis=0),
        strokes_m=mean_f * stroke_per_f,
        measured_s=(0.5 * (first + excitation.ticks) - excitation.first_tick) * setup.bus.period_s,
        zero=zero,
        missed_ticks=excited.missed_ticks,
    )


def _trend(excitation: Excitation, periods: NDArray[np.int64]) -> Array:
    """(m, N, degree) polynomials over the whole passage, at the ticks of some of its periods."""
    whole = np.linspace(-1.0, 1.0, excitation.periods * excitation.period_ticks)
    at = whole.reshape(excitation.periods, -1)[periods]
    return np.asarray(np.polynomial.legendre.legvander(at, TREND_DEGREE)[..., 1:])


def _spectra(samples: Array, passage: Passage, trend: Array) -> Complex:
    """(m, tones, 3) at the tones of a passage, of m periods (m N, 3) less their trend (m, N, degree)."""
    m, n, degree = trend.shape
    split = samples.reshape(m, n, -1)
    apart = (trend - trend.mean(axis=0)).reshape(m * n, degree)
    changing = (split - split.mean(axis=0)).reshape(m * n, -1)
    weight = np.linalg.lstsq(apart, changing, rcond=None)[0]
    steady = split - trend @ weight
    return np.asarray(2.0 / n * np.fft.rfft(steady, axis=1)[:, passage.bins])
