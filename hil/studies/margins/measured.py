"""Sensitivity of the running loop, measured: the loop is excited, and what it makes of the excitation is recorded.

The excitation n is added to the measurement, so the law sees m = y + n with y = -T n, hence m = S n: S column by column
from the discrete Fourier transforms of whole periods, an axis after the other; T = I - S and L = S^-1 - I. Periods
differ by noise alone, and their spread says how well S is known.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.interpolate
from numpy.typing import NDArray

from hil.lanes import in_process as lanes
from hil.lanes.excitation import Excitation
from hil.lanes.lane import Lane
from hil.lanes.setup import Setup
from pkxyz_ctrl.design.margins.margins import LoopResponse, Margins, margins_of_response
from pkxyz_ctrl.stage import Stage
from pkxyz_ctrl.trajectory import Hold, Move, Trajectory

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

REACH_S = 0.5
"""Time to get to the point and come to rest there."""


class MeasurementError(RuntimeError):
    """The loop did not stay closed while it was measured; the message says what happened."""


@dataclass(frozen=True)
class MeasuredLoop:
    """S at the tones of the excitation, and the standard error of each entry (of its distance in the plane)."""

    frequency_hz: Array
    """(k,)"""
    s: Complex
    """(k, 3, 3)"""
    standard_error: Array
    """(k, 3, 3)"""
    ticks: int

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


def at_point(setup: Setup, strokes_m: Array, excitation: Excitation) -> Setup:
    """The setup that goes to the position of ``strokes_m`` (3,), and is excited there; its own trajectory is dropped.
    ``excitation.first_tick`` is put to when it has come to rest.
    """
    position = Stage(setup.stage).forward_kinematics(strokes_m)
    to = (float(position[0]), float(position[1]), float(position[2]))
    first = round(REACH_S / setup.bus.period_s)
    placed = replace(excitation, first_tick=first)
    there = Move(kind="move", to_m=to, velocity_max_m_per_s=1e-3, acceleration_max_m_per_s2=1.0, jerk_max_m_per_s3=1e3)
    rest = Hold(kind="hold", duration_s=(placed.ticks + 1) * setup.bus.period_s)
    started_s = setup.controller.homing_s + 0.1  # the amplifier, homing, and some ticks to enable and track
    return replace(
        setup,
        trajectory=Trajectory([there, rest]),
        duration_s=started_s + (placed.ticks + 1) * setup.bus.period_s,
        excitation=placed,
    )


def measure(
    setup: Setup, lane: Lane, on_progress: Callable[[int, int], None] = lambda done, total: None
) -> MeasuredLoop:
    """Run a setup of ``at_point`` in a lane and take S from it. Raises ``MeasurementError`` where the loop did not
    stay closed to the end.
    """
    excitation = setup.excitation
    if excitation is None:
        raise ValueError("there is nothing to measure without an excitation")
    seen = np.full((excitation.ticks, 3), np.nan)
    last = [0]

    def on_block(block: NDArray[np.void]) -> None:
        tick = block["reference_tick"]
        tracked = (tick >= 0) & (tick < len(seen))
        seen[tick[tracked]] = block["measurement_m"][tracked]
        last[0] = int(block["mode"][-1])

    result = lanes.run(setup, lane, on_block=on_block, on_progress=on_progress)
    if result.faults:
        raise MeasurementError(f"the loop opened while it was measured: {result.faults[0]}")
    if not np.isfinite(seen).all():
        raise MeasurementError(f"the loop was closed for {np.isfinite(seen[:, 0]).sum()} of {len(seen)} ticks only")
    return _from_periods(excitation, seen, setup.bus.period_s)


def _from_periods(excitation: Excitation, seen_m: Array, period_s: float) -> MeasuredLoop:
    n, m = excitation.period_ticks, excitation.periods
    bins = np.unique(np.concatenate([p.bins for p in excitation.passages]))
    s = np.zeros((len(bins), 3, 3), np.complex128)
    standard_error = np.zeros((len(bins), 3, 3))
    for k, passage in enumerate(excitation.passages):
        rows = slice(excitation.measured_from(k), excitation.measured_from(k) + n * m)
        spectrum = np.fft.rfft(seen_m[rows].reshape(m, n, 3), axis=1)[:, passage.bins]  # (m, tones, 3)
        added = np.fft.rfft(excitation.sample(rows.start, n)[:, passage.axis])[passage.bins]
        ratio = spectrum / added[None, :, None]
        at = np.searchsorted(bins, passage.bins)
        s[at, :, passage.axis] = ratio.mean(axis=0)
        spread = np.abs(ratio - ratio.mean(axis=0)) ** 2
        standard_error[at, :, passage.axis] = np.sqrt(spread.sum(axis=0) / (m - 1) / m)
    return MeasuredLoop(bins / (n * period_s), s, standard_error, len(seen_m))
