"""The least that any linear law can leave of a hold on a shaken base: two Riccati equations, no robustness asked."""

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.design.laws.estimator_gain import measurement_noise, shaken_covariance
from pkxyz_ctrl.design.model.loop_plant import LoopPlant, loop_plant
from pkxyz_ctrl.design.model.plant_model import linearise
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]

_CHEAP = 1e-8
"""Weight of the force over the stage's stiffness beside that of the position: none, but for the solver."""


def hold_floor_m(stage: Stage, bus: BusConfig, strokes_m: Array, base_noise_m_per_s2_per_rt_hz: float) -> Array:
    """(3,) standard deviation in m of the position at the samples under the law that makes it least, each axis alone.

    Disturbed by the sense noise of the stage file and by a white acceleration of the base, of this one-sided density;
    the force acts after the bus's delay. The filter's error is paid in any case, its updates until the force acts.
    """
    model, plant = linearise(stage, strokes_m), loop_plant(stage, bus, strokes_m)
    shaken = shaken_covariance(model, model.mass_kg * base_noise_m_per_s2_per_rt_hz, bus.period_s)
    sense = measurement_noise(stage, model, bus)
    return np.array([_floor(plant.axis(i), shaken[i::3, i::3], float(sense[i, i])) for i in range(3)])


def _floor(one: LoopPlant, shaken: Array, sense_m2: float) -> float:
    n, k = len(one.a), float(one.stiffness_n_per_m[0, 0])
    unit = np.r_[1e9, 1e9 * one.period_s, np.full(n - 2, 1e9 / k)]  # nm, nm a period, what holds a nanometre
    a, b, c = unit[:, None] * one.a / unit, unit[:, None] * one.b * k * 1e-9, one.c / unit * 1e9
    disturbed, noise = np.zeros((n, n)), np.array([[sense_m2 * 1e18]])
    disturbed[:2, :2] = unit[:2, None] * shaken * unit[:2]
    predicted = scipy.linalg.solve_discrete_are(a.T, c.T, disturbed + 1e-14 * np.eye(n), noise)
    updated = predicted @ c.T @ np.linalg.solve(c @ predicted @ c.T + noise, c @ predicted)
    weight, cheap = np.zeros((n, n)), np.array([[_CHEAP]])
    weight[0, 0] = 1.0
    to_go = scipy.linalg.solve_discrete_are(a, b, weight + 1e-12 * np.eye(n), cheap)
    return float(np.sqrt(np.trace(to_go @ updated) + (predicted - updated)[0, 0])) * 1e-9
