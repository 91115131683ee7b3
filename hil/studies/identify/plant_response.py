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

from hil.lanes import in_process as lanes
from hil.lanes.excitation import Excitation, Passage
from hil.lanes.lane import Lane
from hil.lanes.setup import Setup
from hil.studies.margins.measured import MeasurementError
from pkxyz_ctrl.safety.modes import Mode

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
    setup: Setup, lane: Lane, on_progress: Callable[[int, int], None] = lambda done, total: None
) -> PlantResponse:
    """Run a setup of ``at_point`` in a lane and take P from it. Raises ``MeasurementError`` where the loop did not stay
    closed to the end.
    """
    excitation = setup.excitation
    if excitation is None:
        raise ValueError("there is nothing to measure without an excitation")
    seen, asked = np.full((excitation.ticks, 3), np.nan), np.zeros((excitation.ticks, 3))
    homing: list[NDArray[np.int32]] = []
    zero_f, stroke_per_f = np.zeros(3), setup.law[0]["tick"]["sense"]["metre_per_farad"]
    scale, offset = setup.bus.analog.sense_farad_per_count, setup.bus.analog.sense_offset_f

    def on_block(block: NDArray[np.void]) -> None:
        tick = block["reference_tick"]
        tracked = (tick >= 0) & (tick < len(seen))
        seen[tick[tracked]] = block["sense_count"][tracked]
        asked[tick[tracked]] = block["drive_count"][tracked]
        homing.append(block["sense_count"][block["mode"] == Mode.HOMING])
        if tracked.any():
            last = block[tracked][-1]
            zero_f[:] = offset + scale * last["sense_count"] - last["sense_f"]

    result = lanes.run(setup, lane, on_block=on_block, on_progress=on_progress)
    if result.faults:
        raise MeasurementError(f"the loop opened while it was measured: {result.faults[0]}")
    if not np.isfinite(seen).all():
        raise MeasurementError(f"the loop was closed for {np.isfinite(seen[:, 0]).sum()} of {len(seen)} ticks only")
    at_rest = np.concatenate(homing)
    error_f = scale * at_rest.std(axis=0, ddof=1) / np.sqrt(len(at_rest))
    zero = SenseZero(zero_f, zero_f / scale, error_f, len(at_rest))
    squared = (setup.bus.analog.drive_volt_per_count * asked) ** 2
    rest_f = float(setup.law[0]["tick"]["sense"]["rest_f"])
    first = excitation.measured_from(0)
    mean_f = offset + scale * seen[first:].mean(axis=0) - zero_f - rest_f
    return _from_periods(setup, excitation, squared, seen, mean_f * stroke_per_f, zero)


def _from_periods(
    setup: Setup, excitation: Excitation, squared_v2: Array, seen: Array, strokes_m: Array, zero: SenseZero
) -> PlantResponse:
    n, m = excitation.period_ticks, excitation.periods
    bins = np.unique(np.concatenate([p.bins for p in excitation.passages]))
    u, y = (np.zeros((m, len(bins), 3, 3), np.complex128) for _ in range(2))
    for k, passage in enumerate(excitation.passages):
        rows = slice(excitation.measured_from(k), excitation.measured_from(k) + n * m)
        at = np.searchsorted(bins, passage.bins)
        u[..., passage.axis][:, at] = _spectra(squared_v2[rows], passage, m)
        y[..., passage.axis][:, at] = _spectra(seen[rows], passage, m)
    mean_u, mean_y = u.mean(axis=0), y.mean(axis=0)
    p = mean_y @ np.linalg.inv(mean_u)
    unexplained = y - p @ u  # (m, k, 3, 3); its mean is 0
    power = (np.abs(unexplained) ** 2).sum(axis=(0, 3)) / (3 * (m - 1))  # of one period, (k, 3)
    explained = (np.abs(p @ mean_u) ** 2).mean(axis=2)
    first = excitation.measured_from(0)
    return PlantResponse(
        frequency_hz=bins / (n * setup.bus.period_s),
        drive_v2=mean_u,
        sense_count=mean_y,
        noise_count=np.sqrt(power / m),
        coherence=explained / (explained + power),
        period_s=setup.bus.period_s,
        delay_periods=setup.bus.delay_periods,
        mean_v2=squared_v2[first:].mean(axis=0),
        strokes_m=strokes_m,
        measured_s=(0.5 * (first + excitation.ticks) - excitation.first_tick) * setup.bus.period_s,
        zero=zero,
    )


def _spectra(samples: Array, passage: Passage, periods: int) -> Complex:
    """(m, tones, 3) at the tones of a passage, of m periods (m N, 3) less their trend."""
    n = len(samples) // periods
    trend = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, len(samples)), TREND_DEGREE)[:, 1:]
    split = (periods, n, -1)
    apart = (trend.reshape(split) - trend.reshape(split).mean(axis=0)).reshape(len(samples), -1)
    changing = (samples.reshape(split) - samples.reshape(split).mean(axis=0)).reshape(len(samples), -1)
    weight = np.linalg.lstsq(apart, changing, rcond=None)[0]
    steady = (samples - trend @ weight).reshape(split)
    return np.asarray(2.0 / n * np.fft.rfft(steady, axis=1)[:, passage.bins])
