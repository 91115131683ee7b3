"""The linear stage at rest: its damping against scipy's square root of a matrix, its balance against its own forces."""

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from sim_truth import stiffness_at

from hil.runs.scenario import load_scenario
from sim.motion.at_rest import _take_root
from sim.motion.mechanics import acceleration
from sim.parameters import equilibrium


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 4.0), st.floats(-6.0, 12.0))
def test_the_root_of_a_matrix_is_scipys(seed, decades, size):
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    values = 10.0**size * 10.0 ** rng.uniform(0.0, decades, 3)
    a = axes * values @ axes.T
    a = 0.5 * (a + a.T)
    root = np.empty((3, 3))
    _take_root(a, root, np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)))
    want = scipy.linalg.sqrtm(a)
    assert root == pytest.approx(want, abs=1e-10 * np.abs(want).max())
    assert root == pytest.approx(root.T, abs=1e-12 * np.abs(want).max())


@pytest.mark.parametrize("plant", ["nominal", "mild", "harsh", "lab"])
def test_every_mode_at_rest_has_the_quality_factor_of_the_plant_file(plant):
    setup = load_scenario("raster", plant=plant).setup()
    p = setup.new_plant().params[0]
    assert p["mass_kg"] * p["stiff_per_s2"] == pytest.approx(stiffness_at(p, np.zeros(3)), rel=1e-4, abs=1e-9)  # warm
    w2, modes = np.linalg.eigh(p["stiff_per_s2"])
    quality = setup.plant.damping.quality_factor or setup.device.dynamics.quality_factor
    damping = modes.T @ p["damping_per_s"] @ modes
    assert np.sqrt(w2) / np.diag(damping) == pytest.approx(quality, rel=1e-12)
    assert damping == pytest.approx(np.diag(np.diag(damping)), abs=1e-9 * damping.max())
    assert p["damping2_per_s2"] == pytest.approx(0.25 * p["damping_per_s"] @ p["damping_per_s"], rel=1e-12)


@pytest.mark.parametrize("volt", [0.0, 40.0, 90.0])
def test_at_the_equilibrium_nothing_pushes(volt):
    plant = load_scenario("raster", plant="harsh").setup().new_plant()
    state, volt2 = plant.state.copy(), np.array([1.0, 0.7, 0.4]) * volt**2
    x = equilibrium(plant.params, state, volt2)
    left = acceleration(plant.params[0], state[0], volt2, *x, 0.0, 0.0, 0.0)
    away = acceleration(plant.params[0], state[0], volt2, *(x + 1e-9), 0.0, 0.0, 0.0)
    assert np.abs(left).max() < 1e-6 * np.abs(away).max()
