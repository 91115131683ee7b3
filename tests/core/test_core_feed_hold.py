"""The row of a path whose speed changes, against derivatives of the composed polynomial x(p(t))."""

import numpy as np
import pytest
from numpy.polynomial import Polynomial

from pkxyz_ctrl.core.feed_hold import SLOWING, STARTING, advance, sample
from pkxyz_ctrl.loop.reference import reference_rows

PERIOD_S = 200e-6
RAMP_TICKS = 20
SPEED = Polynomial([1.0, 0.0, -3.0, 2.0])  # over u, the share of the ramp that has passed
PATH_M = [1e-6 * Polynomial(c) for c in ([0.3, 1.0, -0.07, 0.002], [-1.0, 0.2, 0.05, -0.004], [2.0, -0.6, 0.0, 0.003])]
"""x, y, z over ticks of the path: cubic, so that between two rows the jerk is what ``sample`` takes it for."""


def phase_of(direction):
    """Ticks of the path over ticks of the ramp."""
    speed = SPEED if direction == SLOWING else 1.0 - SPEED
    return speed(Polynomial([0.0, 1.0 / RAMP_TICKS])).integ()


def rows_of_the_path(ticks):
    motion = [p.deriv(order)(ticks) / PERIOD_S**order for order in range(3) for p in PATH_M]
    return reference_rows(np.column_stack(motion))


@pytest.mark.parametrize("direction", [SLOWING, STARTING])
@pytest.mark.parametrize("from_phase", [0.0, 3.4])
def test_velocity_and_acceleration_are_the_derivatives_of_what_the_position_does(direction, from_phase):
    """Both parts of the chain rule s^2 x'' + s' x' count here, and most phases lie between rows."""
    rows = rows_of_the_path(np.arange(20.0))
    phase = phase_of(direction) + from_phase
    for age in range(RAMP_TICKS + 1):
        covered, speed, change = advance(direction, age, RAMP_TICKS)
        row = np.empty(9)
        sample(rows, from_phase + covered, speed, change, PERIOD_S, row)
        exact = [p(phase).deriv(order)(age) / PERIOD_S**order for order in range(3) for p in PATH_M]
        for part, size in ((slice(0, 3), 1e-6), (slice(3, 6), 1e-6 / PERIOD_S), (slice(6, 9), 1e-7 / PERIOD_S**2)):
            assert row[part] == pytest.approx(exact[part], rel=0, abs=1e-9 * size), age


@pytest.mark.parametrize(("direction", "speed"), [(SLOWING, 0.0), (STARTING, 1.0)])
def test_past_the_end_of_the_ramp_the_speed_stays(direction, speed):
    for age in (RAMP_TICKS, RAMP_TICKS + 7):
        assert advance(direction, age, RAMP_TICKS) == (RAMP_TICKS / 2 + speed * (age - RAMP_TICKS), speed, 0.0)
