"""The floor of a hold, against the covariance of the loop that reaches it, found by plain iteration."""

import numpy as np
import pytest
from loop_rig import MIDDLE, bus, stage

from pkxyz_ctrl.design.hold_floor import hold_floor_m, rounding_floor_m
from pkxyz_ctrl.design.hold_noise import rounding_force_n
from pkxyz_ctrl.design.laws.estimator_gain import measurement_noise, shaken_covariance
from pkxyz_ctrl.design.model.loop_plant import loop_plant
from pkxyz_ctrl.design.model.plant_model import linearise


def least_nm(axis, density):
    """Filter and regulator by iterating their equations, then the whole loop's covariance by iterating that."""
    model, one = linearise(stage(), MIDDLE), loop_plant(stage(), bus(), MIDDLE).axis(axis)
    n, k = len(one.a), one.stiffness_n_per_m[0, 0]
    unit = np.r_[1e9, 1e9 * one.period_s, np.full(n - 2, 1e9 / k)]
    a, b, c = unit[:, None] * one.a / unit, unit[:, None] * one.b * k * 1e-9, one.c / unit * 1e9
    shaken = np.zeros((n, n))
    shaken[:2, :2] = (
        np.outer(unit[:2], unit[:2]) * shaken_covariance(model, model.mass_kg * density, one.period_s)[axis::3, axis::3]
    )
    noise = 1e18 * measurement_noise(stage(), model, bus())[axis, axis]
    p, x = np.eye(n), np.eye(n)
    for _ in range(4000):
        gain = p @ c.T / (c @ p @ c.T + noise)
        p = a @ (p - gain @ c @ p) @ a.T + shaken
        back = b.T @ x @ a / (b.T @ x @ b + 1e-8)
        x = a.T @ x @ (a - b @ back)
        x[0, 0] += 1.0
    # states: the stage, and what the filter predicts of it
    loop = np.block([[a - b @ back @ gain @ c, -b @ back @ (np.eye(n) - gain @ c)],
                     [a @ gain @ c - b @ back @ gain @ c, (a - b @ back) @ (np.eye(n) - gain @ c)]])  # fmt: skip
    enters = np.vstack([-b @ back @ gain, (a - b @ back) @ gain])
    added, whole = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, 2 * n))
    added[:n, :n] = shaken
    added += noise * enters @ enters.T
    for _ in range(4000):
        whole = loop @ whole @ loop.T + added
    return float(np.sqrt(whole[0, 0]))


@pytest.mark.parametrize("density", [98.1e-6, 981e-6])
def test_the_floor_is_what_the_best_loop_leaves(density):
    floor_nm = 1e9 * hold_floor_m(stage(), bus(), MIDDLE, density)
    assert floor_nm[0] == pytest.approx(least_nm(0, density), rel=2e-3)
    assert floor_nm[2] == pytest.approx(least_nm(2, density), rel=2e-3)
    assert floor_nm[0] == pytest.approx(floor_nm[1], rel=1e-9)
    if density == 98.1e-6:
        assert floor_nm == pytest.approx([0.595, 0.595, 0.488], abs=2e-3)


def test_the_floor_of_rounding_is_the_stage_s_first_sample_and_its_zero_outside_the_circle():
    """Nothing undoes what a force does before the next can act; a zero z outside the circle makes it |z| times more."""
    rounded_n = rounding_force_n(stage(), bus(), linearise(stage(), MIDDLE))
    floor_m = rounding_floor_m(stage(), bus(), MIDDLE)
    for index in range(3):
        axis = loop_plant(stage(), bus(), MIDDLE).axis(index)
        samples = [(axis.c @ np.linalg.matrix_power(axis.a, k) @ axis.b).item() for k in range(len(axis.a))]
        zeros = np.roots(np.convolve(np.poly(axis.a), samples)[1 : len(axis.a)])
        first = samples[1] * np.abs(zeros[np.abs(zeros) > 1.0]).prod()
        assert floor_m[index] == pytest.approx(first * rounded_n[index], rel=1e-4)
    assert 1e9 * floor_m == pytest.approx([0.147, 0.147, 0.136], abs=1e-3)
