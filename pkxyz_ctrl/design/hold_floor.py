"""The least that any linear law can leave of a hold, shaken or not: two Riccati equations, no robustness asked."""

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.design.hold_noise import rounding_force_n
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


def rounding_floor_m(stage: Stage, bus: BusConfig, strokes_m: Array) -> Array:
    """(3,) the same on a base at rest, where what rounding takes from the force is all that disturbs: white, and told.

    The sample noise costs nothing there, as a law that knows each force need not look.
    """
    plant = loop_plant(stage, bus, strokes_m)
    rounded_n = rounding_force_n(stage, bus, linearise(stage, strokes_m))
    return np.array([_rounded(plant.axis(i), float(rounded_n[i])) for i in range(3)])


def _rounded(one: LoopPlant, rounded_n: float) -> float:
    a, b, _, unit = _in_nm(one)
    enters = unit[:, None] * one.b * rounded_n
    return float(np.sqrt((enters.T @ _to_go(a, b) @ enters).item())) * 1e-9


def _in_nm(one: LoopPlant) -> tuple[Array, Array, Array, Array]:
    """A, B and C in these units, and the units: nm, nm a period, what holds a nanometre."""
    n, k = len(one.a), float(one.stiffness_n_per_m[0, 0])
    unit = np.r_[1e9, 1e9 * one.period_s, np.full(n - 2, 1e9 / k)]
    return unit[:, None] * one.a / unit, unit[:, None] * one.b * k * 1e-9, one.c / unit * 1e9, unit


def _to_go(a: Array, b: Array) -> Array:
    """What a state costs from here on, in nm^2, under the regulator that makes it least."""
    weight, cheap = np.zeros_like(a), np.array([[_CHEAP]])
    weight[0, 0] = 1.0
    return np.asarray(scipy.linalg.solve_discrete_are(a, b, weight + 1e-12 * np.eye(len(a)), cheap))


def _floor(one: LoopPlant, shaken: Array, sense_m2: float) -> float:
    a, b, c, unit = _in_nm(one)
    n = len(a)
    disturbed, noise = np.zeros((n, n)), np.array([[sense_m2 * 1e18]])
    disturbed[:2, :2] = unit[:2, None] * shaken * unit[:2]
    predicted = scipy.linalg.solve_discrete_are(a.T, c.T, disturbed + 1e-14 * np.eye(n), noise)
    updated = predicted @ c.T @ np.linalg.solve(c @ predicted @ c.T + noise, c @ predicted)
    return float(np.sqrt(np.trace(_to_go(a, b) @ updated) + (predicted - updated)[0, 0])) * 1e-9
