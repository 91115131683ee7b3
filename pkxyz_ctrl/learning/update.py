"""What one window teaches: pure, from the harmonics of the error to those of the next correction.

A shift of the reference in position, velocity and acceleration moves the stage by itself, E = D + M C with M near 1:
feed-forward and feedback both ask for it, and what the model doesn't know is only S times its error. So the harmonics
that are still seen are taken off, C+ = C - E, each as far as it is known: of the variance P of what is left and R of
the noise, the share P / (P + R), as a Kalman filter would. P begins with what stands out of the noise (Wiener's share),
shrinks with every look, and grows by what an imperfect M leaves of a change.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

BAND = 2.5
"""Noise in the loop's band over that in the upper half of the spectrum: |S|^2 at its peak, Ms = 1.6."""
MISMATCH = 0.2
"""|1 - M| that is reckoned with: stiffness and combs 10 % off, times |S|."""
SURPRISE = 12.0
"""An error with more than so many times the expected square (1 in 10^5 by chance) means that the device has changed."""
DRIFT = 0.01
"""Of R: what may change from window to window by itself, such as combs that charge."""
WORSE_SIGMA = 4.0
WORSE_NOISE = 12.0
"""A harmonic is worse than the best if its square, over the axes, has grown by
more than so many sigma and by so many R."""


@dataclass(frozen=True)
class Knowledge:
    """What is known after a window. Arrays over harmonics and axes (K, 3), or harmonics (K,)."""

    correction: Complex
    """m, what acts next"""
    variance_m2: Array
    """P of what will be left under it"""
    best: Complex
    """the correction that is known to have done no harm"""
    best_square_m2: Array
    """(K,) the smallest square seen under it, over the axes; infinite before the first window"""
    gain: Array
    """(K,)"""
    gain_full: float


def beginning(correction: Complex, gain: float) -> Knowledge:
    """Before the first window, with a correction of zeros or a stored one."""
    count = len(correction)
    return Knowledge(
        correction, np.full((count, 3), np.inf), correction, np.full(count, np.inf), np.full(count, gain), gain
    )


@dataclass(frozen=True)
class Lesson:
    """What became of a window, for people."""

    learnt: int
    """harmonics that were changed by more than their noise"""
    reverted: int
    """harmonics that had become worse, and went back"""


def learn(known: Knowledge, error: Complex, noise_m2: Array) -> tuple[Knowledge, Lesson]:
    """From harmonics (K, 3) in m seen under ``known.correction`` and the ``noise`` (3,) of each."""
    r = np.broadcast_to(np.maximum(BAND * noise_m2, 1e-30), error.shape)
    square = np.abs(error) ** 2
    # -- never worse: harmonics that have become worse go back, and become cautious; what is worse under the best itself
    # is another device
    total, quiet = square.sum(axis=1), r.sum(axis=1)
    bound = known.best_square_m2 + WORSE_SIGMA * np.sqrt(2.0 * known.best_square_m2 * quiet) + WORSE_NOISE * quiet
    worse, moved = total > bound, (known.correction != known.best).any(axis=1)
    back, changed = worse & moved, worse & ~moved
    best = np.where(back[:, None], known.best, known.correction)
    best_square = np.where(changed, total, np.minimum(known.best_square_m2, total))
    gain = np.where(back, 0.5 * known.gain, np.where(changed, known.gain_full, known.gain))
    # -- the share that is known
    surprised = ~(square <= SURPRISE * (known.variance_m2 + r)) | changed[:, None] | np.isinf(known.variance_m2)
    variance = np.where(surprised, np.maximum(square - r, 0.1 * r), known.variance_m2)
    share = variance / (variance + r)
    step = -gain[:, None] * share * error
    left = (share + DRIFT) * r + (MISMATCH * np.abs(step)) ** 2 + ((1.0 - gain[:, None]) * share) ** 2 * square
    correction = np.where(back[:, None], best, known.correction + step)
    step, left = np.where(back[:, None], 0.0, step), np.where(back[:, None], np.inf, left)
    lesson = Lesson(int(np.count_nonzero((np.abs(step) ** 2 > r).any(axis=1))), int(np.count_nonzero(back)))
    return Knowledge(correction, left, best, best_square, gain, known.gain_full), lesson


def with_correction(known: Knowledge, correction: Complex) -> Knowledge:
    """With another correction than was learnt, because limits did not allow that."""
    return replace(known, correction=correction)
