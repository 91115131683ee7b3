"""The share of devices that pass, and how well it is known when devices come in wafers.

Devices of a wafer are alike, so a thousand of them say less than a thousand of their own. The variance of the share is
therefore taken between wafers, the devices are counted as so many independent ones as would have that variance, and
Clopper and Pearson's interval is that of this count (Korn, Graubard: Confidence intervals for proportions with small
expected number of positive counts estimated from survey data, Survey Methodology 24 (1998) 193).
"""

from dataclasses import dataclass

import numpy as np
import scipy.stats
from numpy.typing import NDArray

CONFIDENCE = 0.95


@dataclass(frozen=True)
class Share:
    """Of devices that pass, with the interval that holds the process's own with ``CONFIDENCE``."""

    value: float
    low: float
    high: float
    devices: int
    passed: int
    effective: float
    """independent devices that would tell as much"""


def share_of(passed: NDArray[np.bool_], wafer: NDArray[np.int64]) -> Share:
    """Share of ``passed`` (n,), of devices on wafers numbered (n,).

    Where none or all pass nothing shows how alike a wafer's devices are: each wafer counts once. From a single wafer
    nothing is known of others: 0 to 1.
    """
    n, hits = len(passed), int(np.count_nonzero(passed))
    value = hits / n
    _, where = np.unique(wafer, return_inverse=True)
    size = np.bincount(where).astype(np.float64)
    wafers = len(size)
    if wafers < 2:
        return Share(value, 0.0, 1.0, n, hits, 1.0)
    if hits in (0, n):
        effective = float(wafers)
    else:
        rest = np.bincount(where, weights=passed) - value * size
        variance = wafers / (wafers - 1.0) * float(rest @ rest) / n**2
        alone = value * (1.0 - value)
        effective = min(float(n), alone / variance) if variance > 0.0 else float(n)
        quantiles = scipy.stats.t.ppf(0.5 + 0.5 * CONFIDENCE, [n - 1, wafers - 1])
        effective = max(1.0, effective * float(quantiles[0] / quantiles[1]) ** 2)
    low, high = clopper_pearson(value * effective, effective)
    return Share(value, low, high, n, hits, effective)


def clopper_pearson(hits: float, trials: float) -> tuple[float, float]:
    """Interval with ``CONFIDENCE`` for a share of ``hits`` in ``trials``, which need not be whole."""
    tail = 0.5 * (1.0 - CONFIDENCE)
    low = 0.0 if hits <= 0.0 else float(scipy.stats.beta.ppf(tail, hits, trials - hits + 1.0))
    high = 1.0 if hits >= trials else float(scipy.stats.beta.ppf(1.0 - tail, hits + 1.0, trials - hits))
    return low, high
