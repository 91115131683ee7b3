"""How far any linear law could reject: closed forms, and cones over the taps of a law on the sampled plant itself."""

import math

import clarabel
import numpy as np
import pytest
import scipy.optimize
import scipy.sparse
from loop_rig import MIDDLE, bus, stage

from pkxyz_ctrl.design.margins.margins import HALF_POWER
from pkxyz_ctrl.design.margins.rejection_limit import bode_limit_hz, delay_limit_hz, nature_of
from pkxyz_ctrl.design.model.loop_plant import LoopPlant, loop_plant

PEAK_S = 1.9
PERIOD_S = 2e-4


def late_plant(samples, pole=0.5):
    """One pole, and so many samples until a force is seen."""
    a = np.diag([pole] + [0.0] * (samples - 1)) + np.eye(samples, k=1)
    return LoopPlant(PERIOD_S, a, np.eye(samples)[:, -1:], np.eye(1, samples), MIDDLE, np.eye(1))


def numerator(axis):
    """Of the plant, by rising powers of 1/z."""
    n = len(axis.a)
    samples = [(axis.c @ np.linalg.matrix_power(axis.a, k) @ axis.b).item() for k in range(n)]
    return np.r_[0.0, np.convolve(np.poly(axis.a), samples)[:n]]


def least_excess(axis, edge_hz, taps, points=400):
    """The least t with |S| <= t / sqrt 2 to the edge and t Ms beyond: a law of taps that takes away the poles."""
    edge = 2.0 * np.pi * edge_hz * axis.period_s
    w = np.unique(np.r_[np.linspace(0.0, np.pi, points), np.linspace(0.98, 1.02, 21) * edge])
    top = numerator(axis)
    seen = np.exp(-1j * np.outer(w, np.arange(len(top)))) @ (top / np.abs(top).max())
    by_tap = seen[:, None] * np.exp(-1j * np.outer(w, np.arange(taps)))
    rows, at = np.zeros((len(w), 3, taps + 1)), np.tile([0.0, 1.0, 0.0], (len(w), 1))
    rows[:, 0, -1] = -np.where(w <= edge, HALF_POWER, PEAK_S)
    rows[:, 1, :-1], rows[:, 2, :-1] = -by_tap.real, -by_tap.imag
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    none, cost = scipy.sparse.csc_matrix((taps + 1, taps + 1)), np.eye(taps + 1)[-1]
    flat = scipy.sparse.csc_matrix(rows.reshape(-1, taps + 1))
    cones = [clarabel.SecondOrderConeT(3)] * len(w)
    solution = clarabel.DefaultSolver(none, cost, flat, at.ravel(), cones, settings).solve()
    assert str(solution.status) == "Solved"
    return solution.x[-1]


def test_one_sample_of_delay_is_bode_s_integral():
    """And there the band holds as much below 1 as above."""
    limit_hz = bode_limit_hz(PERIOD_S, PEAK_S)
    assert delay_limit_hz(late_plant(1), PEAK_S) == pytest.approx(limit_hz, rel=1e-9)
    assert limit_hz * math.log(HALF_POWER) + (2500.0 - limit_hz) * math.log(PEAK_S) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("peak_s", [1.2, 1.9, 3.0])
def test_two_samples_are_schur_s_condition(peak_s):
    """F = a + b / z + ... within 1 needs |b| <= 1 - a^2; in logarithms |c_1| <= 2 sinh c_0."""
    low = math.log(peak_s / HALF_POWER)

    def beyond(edge):
        return 2.0 * low / math.pi * math.sin(edge) - 2.0 * math.sinh(math.log(peak_s) - low * edge / math.pi)

    edge = scipy.optimize.brentq(beyond, 1e-3, 2.0 * math.pi * PERIOD_S * bode_limit_hz(PERIOD_S, peak_s))
    assert delay_limit_hz(late_plant(2), peak_s) == pytest.approx(edge / (2.0 * math.pi * PERIOD_S), rel=1e-9)


def test_what_the_stage_is_in_its_samples():
    """Two samples from force to measurement, and a zero outside the circle that the amplifier's pole makes."""
    for index in range(3):
        axis = loop_plant(stage(), bus(), MIDDLE).axis(index)
        late, outside = nature_of(axis)
        assert late == 2
        assert len(outside) == 1
        assert outside[0].real == pytest.approx(-1.08, abs=0.01)
        assert np.polyval(numerator(axis)[::-1], 1.0 / outside[0]) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("index", [0, 2])
def test_taps_come_as_near_to_the_limit_as_they_are_many(index):
    """Twice the taps, half the distance, so two tell the end: 1 at the limit, less before it, more behind it."""
    axis = loop_plant(stage(), bus(), MIDDLE).axis(index)
    limit_hz = delay_limit_hz(axis, PEAK_S)

    def end(edge_hz):
        return 2.0 * least_excess(axis, edge_hz, 72) - least_excess(axis, edge_hz, 36)

    assert end(limit_hz) == pytest.approx(1.0, abs=0.003)
    assert end(0.97 * limit_hz) < 0.99
    assert end(1.03 * limit_hz) > 1.01


def test_delay_and_lag_only_bring_the_limit_down():
    on_bus = [delay_limit_hz(loop_plant(stage(), bus(delay_periods=n), MIDDLE).axis(0), PEAK_S) for n in (1, 2)]
    behind_filter = delay_limit_hz(loop_plant(stage("lab"), bus(), MIDDLE).axis(0), PEAK_S)
    assert bode_limit_hz(PERIOD_S, PEAK_S) > delay_limit_hz(late_plant(2), PEAK_S) > on_bus[0] > behind_filter
    assert behind_filter > on_bus[1]


def test_the_limits_that_the_page_on_margins_tells():
    assert bode_limit_hz(PERIOD_S, PEAK_S) == pytest.approx(1623, abs=0.5)
    assert delay_limit_hz(late_plant(2), PEAK_S) == pytest.approx(909, abs=0.5)
    plant = loop_plant(stage(), bus(), MIDDLE)
    assert min(delay_limit_hz(plant.axis(i), PEAK_S) for i in range(3)) == pytest.approx(891, abs=0.5)


def test_a_plant_that_is_not_stable_is_refused():
    with pytest.raises(ValueError, match="stable"):
        delay_limit_hz(late_plant(2, pole=1.01), PEAK_S)
