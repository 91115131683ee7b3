"""What the software plant really is about a point: its own equations, differentiated numerically. Nothing of the
identification is in it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.motion.geometry import strokes
from sim.motion.mechanics import acceleration, stiffness
from sim.motion.parasitic import rest
from sim.parameters import equilibrium
from sim.plant import Plant

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Truth:
    """Modes |s| / 2 pi and -Re s / |s| in ascending order, and counts per V^2 asked for, slower than the modes and
    faster than charging."""

    frequency_hz: Array
    damping: Array
    static_gain: Array
    acceleration_gain: Array
    """counts/s^2 per V^2 asked for, at once: what the table's acceleration does to the strokes"""


def truth_about(plant: Plant, squared_v2: Array, held_s: float) -> Truth:
    """About squared voltages asked for (3,), which charged the combs for ``held_s``; drift and weight are at work."""
    p, state = plant.params[0], plant.state.copy()
    s = state[0]
    s["force_n"] = p["weight_n"]
    scale = p["volt_per_count"] / nominal_v_per_count(plant)
    held_v = np.sqrt(squared_v2) * scale + p["amplifier_offset_v"]
    grown = 1.0 - np.exp(-held_s / p["charging_s"]) if p["charging_on"] else 0.0
    charge_v = p["charging_fraction"] * held_v * grown

    def counts(asked_v2: Array) -> Array:
        volt = np.sqrt(asked_v2) * scale + p["amplifier_offset_v"]
        acting = (volt - charge_v) ** 2
        q = np.empty(3)
        strokes(p, np.concatenate([equilibrium(plant.params, state, acting), np.zeros(3)]), q)
        if p["parasitic_on"]:
            q += p["parasitic_comb"] * rest(p, acting * (1 + p["fringe_per_m"] * q))
        farad = p["sense_f_per_m"] * q * (1 + 0.5 * p["sense_curvature_per_m"] * q) + p["feedthrough_f_per_v"] * volt
        return np.asarray(farad / p["count_f"])

    static, step_v2 = np.empty((3, 3)), 1.0
    for j in range(3):
        change = np.eye(3)[j] * step_v2
        static[:, j] = (counts(squared_v2 + change) - counts(squared_v2 - change)) / (2 * step_v2)
    acting = (held_v - charge_v) ** 2
    at = np.concatenate([equilibrium(plant.params, state, acting), np.zeros(3)])
    a = np.zeros((6, 6))
    a[:3, 3:] = np.eye(3)
    for k, step in enumerate([1e-9] * 3 + [1e-6] * 3):
        move = np.eye(6)[k] * step
        a[3:, k] = (
            np.array(acceleration(p, s, acting, *(at + move))) - np.array(acceleration(p, s, acting, *(at - move)))
        ) / (2 * step)
    rows, gain = np.empty((3, 3)), np.empty((3, 3))
    for k in range(3):
        ends = np.empty((2, 3))
        for end, sign in zip(ends, (1, -1), strict=True):
            strokes(p, at + sign * 1e-8 * np.eye(6)[k], end)
        rows[:, k] = (ends[0] - ends[1]) / 2e-8
        ahead, back = (
            (np.sqrt(squared_v2 + sign * step_v2 * np.eye(3)[k]) * scale + p["amplifier_offset_v"] - charge_v) ** 2
            for sign in (1, -1)
        )
        gain[:, k] = (np.array(acceleration(p, s, ahead, *at)) - np.array(acceleration(p, s, back, *at))) / (
            2 * step_v2
        )
    q = np.empty(3)
    strokes(p, at, q)
    slope = p["sense_f_per_m"] * (1 + p["sense_curvature_per_m"] * q) / p["count_f"]
    poles = np.linalg.eigvals(a)
    poles = poles[poles.imag > 0]
    poles = poles[np.argsort(np.abs(poles))]
    return Truth(np.abs(poles) / (2 * np.pi), -poles.real / np.abs(poles), static, slope[:, None] * (rows @ gain))


def nominal_v_per_count(plant: Plant) -> float:
    """What the bus calls a count: 200 V over 32767 of them."""
    return 200.0 / 32767


def stiffness_at(p: np.void, position_m: Array) -> Array:
    """Hessian of the elastic energy at a position (3,), (3, 3), N/m."""
    xx, xy, xz, yy, yz, zz = stiffness(p, *position_m)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
