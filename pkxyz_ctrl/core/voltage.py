"""Comb forces to amplifier counts: limits, the square-root law and noise shaping, compiled.

F = G V^2 (Eq. 33), each comb with its own G; V = scale x count. What a count cannot express is carried into the next
ticks, so the quantisation error of the voltage is pushed to high frequency, where the stage does not follow: its
spectrum gains the factor |1 - z^-1|. A voltage that stands still makes tones of it, and a mode of little damping may
lie on one. Then the factor may be |1 - s_1 z^-1 - s_2 z^-2 - s_3 z^-3|, with zeros at 0 Hz and between the modes.
"""

import math

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel

Array = NDArray[np.float64]
CountVector = NDArray[np.int32]

DRIVE = np.dtype(
    [
        ("force_gain_n_per_v2", "f8", (3,)),  # G of each comb
        ("volt_per_count", "f8"),
        ("count_max", "i4"),
        ("count_slew_max", "i4"),  # most that a count may change in one tick
        ("noise_shaping", "i4"),  # 1: carry the quantisation error
        ("shaping", "f8", (3,)),  # s_1, s_2, s_3 while the set-point stands still
    ],
    align=True,
)


@kernel
def force_limits(drive: np.void, count_last: CountVector, lower_n: Array, upper_n: Array) -> None:
    """Comb forces (3,) reachable in one tick from the last counts (3,): slew limit, no push, voltage limit."""
    slew, most, scale, gain = (
        drive["count_slew_max"],
        drive["count_max"],
        drive["volt_per_count"],
        drive["force_gain_n_per_v2"],
    )
    for i in range(3):
        low = scale * np.int32(max(0, count_last[i] - slew))  # a processor of 32 bits turns 64 into a double by a call
        high = scale * np.int32(min(most, count_last[i] + slew))
        lower_n[i] = gain[i] * low * low
        upper_n[i] = gain[i] * high * high


@kernel
def counts_for_forces(
    drive: np.void, force_n: Array, count_last: CountVector, carry_v: Array, count: CountVector
) -> None:
    """The counts (3,) for forces >= 0; ``carry_v`` (3,) is added to them, and is their error afterwards, at most one
    count of it.

    Whatever the forces are (NaN and infinity too), every count stays within 0..count_max and within the slew limit of
    the last one.
    """
    slew, most, scale = drive["count_slew_max"], drive["count_max"], drive["volt_per_count"]
    gain, per_volt = drive["force_gain_n_per_v2"], 1.0 / scale
    for i in range(3):
        per_gain = 1.0 / gain[i]
        wanted = math.sqrt(force_n[i] * per_gain) if force_n[i] > 0.0 else 0.0  # NaN counts as no force
        if drive["noise_shaping"] != 0 and wanted > 0.0:
            wanted += carry_v[i]
        low, high = max(0, count_last[i] - slew), min(most, count_last[i] + slew)
        above = scale * np.int32(high + 1)
        nearest = np.int32(wanted * per_volt + 0.5) if wanted < above else high  # 0 for the least: -0.5
        count[i] = min(max(nearest, low), high)
        carry_v[i] = min(max(wanted - scale * count[i], -scale), scale)


@kernel
def shape(drive: np.void, stands_still: bool, carry_v: Array, error_v: Array) -> None:
    """What is to be carried into the next tick, in the place of this tick's error (3,); ``error_v`` (2,3) are those of
    the last two."""
    shaping = drive["shaping"]
    for i in range(3):
        error = carry_v[i]
        if stands_still:
            carry_v[i] = shaping[0] * error + shaping[1] * error_v[0, i] + shaping[2] * error_v[1, i]
        error_v[1, i] = error_v[0, i]
        error_v[0, i] = error


@kernel
def forces_of_counts(drive: np.void, count: CountVector, force_n: Array) -> None:
    """Comb forces (3,) in N that counts (3,) give by the law."""
    gain = drive["force_gain_n_per_v2"]
    for i in range(3):
        voltage = drive["volt_per_count"] * count[i]
        force_n[i] = gain[i] * voltage * voltage
