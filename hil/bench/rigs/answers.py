"""How the loop answers to a move, a jump and a sine of the set-point: true position against reference."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.bench.rigs.motions import MIDDLE_M, run, settled_s
from pkxyz_ctrl.trajectory import Hold, Move, Sine, Steps

BAND_M = 10e-9
STEP_M = 1e-6
QUICK = {"velocity_max_m_per_s": 5e-3, "acceleration_max_m_per_s2": 12.0, "jerk_max_m_per_s3": 60e3}
"""Limits of a 1 um step: 0.8 ms on its way, with forces of some 60 uN and 4 V a tick."""


class Settled(NamedTuple):
    """The worst of several steps."""

    s: float
    """from the beginning until it stays within ``BAND_M``; infinite if one never did"""
    beyond: float
    """overshoot, of the step"""


def move_settled(controller: str, place: str = "nominal") -> Settled:
    """Ten moves of 1 um to and fro on each axis."""
    settle_s, beyond = 0.0, 0.0
    for i in range(3):
        way = [float(i == k) * STEP_M for k in range(3)]
        segments: list[Any] = []
        for n in range(10):
            to = np.array([0.0, 0.0, MIDDLE_M]) + (np.array(way) if n % 2 == 0 else 0.0)
            segments += [Move(kind="move", to_m=tuple(to), **QUICK), Hold(kind="hold", duration_s=0.02)]  # type: ignore[arg-type]
        motion = run(segments, controller, place)
        for n in range(10):
            begin, end = motion.segments[2 * n].t_start_us, motion.segments[2 * n + 1].t_end_us
            rows = motion.during((begin, end))
            settle_s = max(settle_s, settled_s(rows, i, BAND_M, motion.period_us * 1e-6))
            sign = 1.0 if n % 2 == 0 else -1.0
            past = sign * (rows["position_m"][:, i] - rows["reference_m"][-1, i])
            beyond = max(beyond, float(past.max()) / STEP_M)
    return Settled(settle_s, beyond)


def jump_settled(controller: str, place: str = "nominal") -> Settled:
    """Jumps of 1 um, there and back three times on each axis."""
    settle_s, beyond = 0.0, 0.0
    for i in range(3):
        by = tuple(float(i == k) * STEP_M for k in range(3))
        motion = run([Steps(kind="steps", by_m=by, count=3, dwell_s=0.02)], controller, place)  # type: ignore[arg-type]
        for at_us in motion.segments[0].jumps_us:
            rows = motion.during((at_us, at_us + 19_000))
            settle_s = max(settle_s, settled_s(rows, i, BAND_M, motion.period_us * 1e-6))
            way = rows["position_m"][:, i] - rows["reference_m"][-1, i]
            beyond = max(beyond, float((-np.sign(way[0]) * way).max()) / STEP_M)
    return Settled(settle_s, beyond)


def sine_response(axis: str, frequency_hz: float, controller: str, place: str = "nominal") -> complex:
    """True position over reference of a 100 nm sine along an axis, 200 periods of it."""
    motion = run(
        [Sine(kind="sine", axis=axis, amplitude_m=100e-9, frequency_hz=frequency_hz, cycles=200.0)],  # type: ignore[arg-type]
        controller,
        place,
    )
    return response_of(motion.scan(0), motion.period_us, axis, frequency_hz)


def response_of(rows: NDArray[np.void], period_us: int, axis: str, frequency_hz: float) -> complex:
    """True position over reference at a frequency, along an axis, by least squares."""
    i = "xyz".index(axis)
    angle = 2 * np.pi * frequency_hz * rows["reference_tick"] * period_us * 1e-6
    basis = np.stack([np.cos(angle), np.sin(angle), np.ones(len(angle))], axis=1)
    true, wanted = (np.linalg.lstsq(basis, rows[name][:, i], rcond=None)[0] for name in ("position_m", "reference_m"))
    return complex((true[0] - 1j * true[1]) / (wanted[0] - 1j * wanted[1]))
