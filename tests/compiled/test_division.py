"""What stands in for a division gives what the division gives."""

import numpy as np
import pytest
from numba import njit

from pkxyz_ctrl.can.driver_rules import NEVER_US
from pkxyz_ctrl.compiled.division import into_period

COUNT = 2_000_000


@njit(error_model="numpy")
def first_apart(times_us: np.ndarray, periods_us: np.ndarray) -> int:
    for k in range(len(times_us)):
        if into_period(times_us[k], periods_us[k]) != times_us[k] % periods_us[k]:
            return k
    return -1


@pytest.mark.parametrize("reach", [2, 5, 1000, "everything"])
def test_it_is_the_remainder_of_every_time(reach):
    """Some periods off, many, and whatever fits into 64 bits."""
    random = np.random.default_rng(7)
    period_us = random.integers(0, 65_536_000, COUNT, endpoint=True) >> random.integers(0, 26, COUNT)
    if reach == "everything":
        time_us = random.integers(-(1 << 63), (1 << 63) - 1, COUNT) >> random.integers(0, 63, COUNT)
    else:
        time_us = random.integers(-reach * period_us, reach * period_us, endpoint=True)
    k = first_apart(time_us, period_us)
    assert k < 0, (time_us[k], period_us[k])


@pytest.mark.parametrize("time_us", [0, 1, NEVER_US, -NEVER_US, 2 * NEVER_US - 1, -2 * NEVER_US])
def test_it_is_the_remainder_at_the_edges_and_ends_however_far_off(time_us):
    periods_us = np.array([0, 1, 2, 1000, 20_000, NEVER_US - 1, NEVER_US, 2 * NEVER_US - 1])
    for edge_us in (*periods_us, *-periods_us):
        for near_us in (-1, 0, 1):
            at_us = np.full(len(periods_us), time_us, np.int64) + edge_us + near_us
            k = first_apart(at_us, periods_us)
            assert k < 0, (at_us[k], periods_us[k])
