"""What sense noise and voltage steps leave of a held position: variances of the linear loop, solved, not simulated."""

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.design.laws.estimator_gain import measurement_noise
from pkxyz_ctrl.design.margins.sensitivity import closed_loop
from pkxyz_ctrl.design.model.discrete_law import DiscreteLaw, LawError
from pkxyz_ctrl.design.model.loop_plant import LoopPlant
from pkxyz_ctrl.design.model.plant_model import LinearStage, linearise
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]


def hold_noise_m(
    stage: Stage, bus: BusConfig, plant: LoopPlant, law: DiscreteLaw, *, noise_shaping: bool = True
) -> Array:
    """Standard deviation (3,) in m of the true position at the samples while the law holds the plant's point.

    Sources: noise and quantisation of the sense counts, and the rounding of the drive counts, white or, with noise
    shaping, its difference. Who is told the counts that went out makes up for it: the law's filter, or the model of
    the set-points, whose regulator then does so and of which the law sees nothing. Raises ``LawError`` for an unstable
    loop.
    """
    model = linearise(stage, plant.strokes_m)
    sense = measurement_noise(stage, model, bus)
    per_count = _force_per_count(stage, bus, model)
    rounding = per_count @ per_count.T / 12.0
    loop = closed_loop(plant, law)
    n, plant_n = len(loop), len(plant.a)
    # states: the loop, and the last rounding error, which noise shaping takes back
    a = np.zeros((n + 3, n + 3))
    a[:n, :n] = loop
    seen = np.zeros((n + 3, 3))
    seen[:plant_n], seen[plant_n:n] = -plant.b @ law.d, law.b
    rounded = np.zeros((n + 3, 3))
    rounded[:plant_n] = plant.b
    if law.told_from is not None:  # its filter knows the counts that went out
        rounded[plant_n + law.told_from : plant_n + law.told_from + 3] = np.eye(3)
    sensed = _stationary(a, seen @ sense @ seen.T)
    if law.set_point_gain is not None:
        n = len(plant.a) - 3 * bus.delay_periods  # without the forces that wait: the model is ahead by these
        led, gain = plant.a[:n, :n].copy(), np.hstack([law.set_point_gain, np.zeros((3, n - 6))])
        rounded = np.vstack([plant.a[:n, -3:], np.zeros((3, 3))])
        a = np.zeros((n + 3, n + 3))
        a[:n, :n] = led - rounded[:n] @ gain
    if noise_shaping:
        a[:n, n:] = -rounded[:n]
        rounded[n:] = np.eye(3)
    covariance = sensed[:3, :3] + _stationary(a, rounded @ rounding @ rounded.T)[:3, :3]
    return np.sqrt(np.diag(covariance))


def rounding_force_n(stage: Stage, bus: BusConfig, model: LinearStage) -> Array:
    """Standard deviation (3,) in N of the force at the platform that rounding the voltages leaves, unshaped."""
    per_count = _force_per_count(stage, bus, model)
    return np.sqrt(np.diag(per_count @ per_count.T) / 12.0)


def _force_per_count(stage: Stage, bus: BusConfig, model: LinearStage) -> Array:
    """(3,3) in N: force at the platform for one more count on each comb, about the voltages that hold the point."""
    volts = stage.holding_voltages(model.position_m)
    return stage.pulls(model.position_m).T * (2.0 * stage.force_gain_n_per_v2 * volts * bus.analog.drive_volt_per_count)


def _stationary(a: Array, q: Array) -> Array:
    """P = A P A^T + Q by doubling: P_2k = P_k + A^k P_k A^k^T. Indifferent to the units of the states."""
    p, power = q, a
    for _ in range(40):
        step = power @ p @ power.T
        p = p + step
        if np.diag(step).max(initial=0.0) <= 0.0 or np.all(np.diag(step) <= 1e-12 * np.diag(p)):
            return p
        power = power @ power
        if not np.isfinite(power).all():
            break
    raise LawError("the loop is not stable: its noise grows without bound")
