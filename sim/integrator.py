"""One step of the table's motion: Dormand and Prince's method of order 8, the amplifier's transient taken out first.

Between two switches of a channel V_i - V_c = b + s t + e E with E = exp(-t / tau), so the comb forces hold terms in E
and E^2 that die within a few microseconds, far below a sensible step. Their response
xi(t) = xi_1 E + xi_2 E^2 is known in closed form to leading orders in tau, from xi'' + D xi' + K/m xi = A E:

    xi_1 = tau^2 (A + tau D A - tau^2 K A / m),   xi_2 likewise with tau / 2.

Substituting x = y + xi is exact, whatever xi is; y'' = a(y + xi, y' + xi', t) - xi'' is smooth, and y is what is
integrated. What stays rough is the turn of the Jacobian while a transient lasts."""

import math

import numpy as np
from numba import njit

from sim.amplifier import pass_time
from sim.dop853 import A, B, C
from sim.mechanics import acceleration, comb_acceleration, stiffness

LONGEST_S = 205e-6
"""Longest step: a sixth of the fastest rigid mode's period, at which the order-8 method is exact to 1e-14 m in a
scan."""
CONTACT_S = 4e-6
"""Step while a stop or a snapped comb touches."""


@njit(cache=True, error_model="numpy")
def _tabulate_decay(p: np.void, s: np.void, h: float) -> None:
    """E at the stages and at the end of a step of h s, kept until h changes."""
    if s["decay_h_s"] == h:
        return
    s["decay_h_s"] = h
    tau = p["amplifier_s"]
    for i in range(12):
        s["decay"][i] = math.exp(-C[i] * h / tau) if tau > 0.0 else 0.0
    s["decay"][12] = math.exp(-h / tau) if tau > 0.0 else 0.0


@njit(cache=True, error_model="numpy")
def _fast_response(p: np.void, s: np.void) -> None:
    """Set xi_1 and xi_2, s["fast_1"] and s["fast_2"], m, at the pose where the step starts; zero if no channel is in
    transient."""
    one, two, volt2 = s["fast_1"], s["fast_2"], s["volt2"]
    if s["error_v"][0] == 0.0 and s["error_v"][1] == 0.0 and s["error_v"][2] == 0.0:
        for j in range(3):
            one[j], two[j] = 0.0, 0.0
        return
    x, y, z = s["motion"][0], s["motion"][1], s["motion"][2]
    k = stiffness(p, x, y, z)
    tau = p["amplifier_s"]
    for i in range(3):
        volt2[i] = 2.0 * (s["base_v"][i] - s["charge_v"][i]) * s["error_v"][i]
    _respond(p, k, tau, comb_acceleration(p, volt2, x, y, z), one)
    for i in range(3):
        volt2[i] = s["error_v"][i] ** 2
    _respond(p, k, 0.5 * tau, comb_acceleration(p, volt2, x, y, z), two)


@njit(cache=True, error_model="numpy")
def _respond(
    p: np.void, k: tuple[float, ...], tau: float, amplitude: tuple[float, float, float], out: np.ndarray
) -> None:
    """Displacement amplitude ``out`` (3,), m, under an acceleration ``amplitude`` (3 floats, m/s^2) times exp(-t /
    tau)."""
    ax, ay, az = amplitude
    d = p["damping_per_s"]
    stiff = tau * tau / p["mass_kg"]
    t2 = tau * tau
    damped_x = d[0, 0] * ax + d[0, 1] * ay + d[0, 2] * az
    damped_y = d[1, 0] * ax + d[1, 1] * ay + d[1, 2] * az
    damped_z = d[2, 0] * ax + d[2, 1] * ay + d[2, 2] * az
    out[0] = t2 * (ax + tau * damped_x - stiff * (k[0] * ax + k[1] * ay + k[2] * az))
    out[1] = t2 * (ay + tau * damped_y - stiff * (k[1] * ax + k[3] * ay + k[4] * az))
    out[2] = t2 * (az + tau * damped_z - stiff * (k[2] * ax + k[4] * ay + k[5] * az))


@njit(cache=True, error_model="numpy")
def _weighted(slope: np.ndarray, weights: np.ndarray, n: int) -> tuple[float, float, float, float, float, float]:
    """Sum of the first n rows of ``slope`` (12, 6), each times its weight."""
    d0, d1, d2, d3, d4, d5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for r in range(n):
        w = weights[r]
        d0 += w * slope[r, 0]
        d1 += w * slope[r, 1]
        d2 += w * slope[r, 2]
        d3 += w * slope[r, 3]
        d4 += w * slope[r, 4]
        d5 += w * slope[r, 5]
    return d0, d1, d2, d3, d4, d5


@njit(cache=True, error_model="numpy")
def _step(p: np.void, s: np.void, h: float) -> None:
    """Integrate motion and voltages over h s, without a look at stops."""
    _tabulate_decay(p, s, h)
    _fast_response(p, s)
    motion, slope, volt2, decay = s["motion"], s["slope"], s["volt2"], s["decay"]
    k = 1.0 / p["amplifier_s"] if p["amplifier_s"] > 0.0 else 0.0
    x1, y1, z1 = s["fast_1"][0], s["fast_1"][1], s["fast_1"][2]
    x2, y2, z2 = s["fast_2"][0], s["fast_2"][1], s["fast_2"][2]
    x, y, z = motion[0] - x1 - x2, motion[1] - y1 - y2, motion[2] - z1 - z2
    vx, vy, vz = motion[3] + k * (x1 + 2.0 * x2), motion[4] + k * (y1 + 2.0 * y2), motion[5] + k * (z1 + 2.0 * z2)
    for i in range(12):
        d0, d1, d2, d3, d4, d5 = _weighted(slope, A[i], i)
        d3, d4, d5 = vx + h * d3, vy + h * d4, vz + h * d5
        slope[i, 0], slope[i, 1], slope[i, 2] = d3, d4, d5
        t, e1 = C[i] * h, decay[i]
        for c in range(3):
            volt = s["base_v"][c] - s["charge_v"][c] + s["slope_v_per_s"][c] * t + s["error_v"][c] * e1
            volt2[c] = volt * volt
        e2 = e1 * e1
        g1, g2 = k * e1, 2.0 * k * e2
        ax, ay, az = acceleration(
            p, s, volt2,
            x + h * d0 + x1 * e1 + x2 * e2, y + h * d1 + y1 * e1 + y2 * e2, z + h * d2 + z1 * e1 + z2 * e2,
            d3 - x1 * g1 - x2 * g2, d4 - y1 * g1 - y2 * g2, d5 - z1 * g1 - z2 * g2,
        )  # fmt: skip
        g1, g2 = k * g1, 2.0 * k * g2
        slope[i, 3], slope[i, 4], slope[i, 5] = ax - x1 * g1 - x2 * g2, ay - y1 * g1 - y2 * g2, az - z1 * g1 - z2 * g2
    d0, d1, d2, d3, d4, d5 = _weighted(slope, B, 12)
    e1 = decay[12]
    e2 = e1 * e1
    g1, g2 = k * e1, 2.0 * k * e2
    motion[0], motion[3] = x + h * d0 + x1 * e1 + x2 * e2, vx + h * d3 - x1 * g1 - x2 * g2
    motion[1], motion[4] = y + h * d1 + y1 * e1 + y2 * e2, vy + h * d4 - y1 * g1 - y2 * g2
    motion[2], motion[5] = z + h * d2 + z1 * e1 + z2 * e2, vz + h * d5 - z1 * g1 - z2 * g2
    pass_time(s, h, e1)


@njit(cache=True, error_model="numpy")
def step(p: np.void, s: np.void, h: float) -> None:
    """Integrate motion and voltages over h s, at most LONGEST_S. If any stage met a stop, the step is done again in
    short ones."""
    start = s["start"]
    for j in range(6):
        start[j] = s["motion"][j]
    base0, base1, base2 = s["base_v"][0], s["base_v"][1], s["base_v"][2]
    error0, error1, error2 = s["error_v"][0], s["error_v"][1], s["error_v"][2]
    s["contact"] = 0
    _step(p, s, h)
    if s["contact"] == 0 or h <= CONTACT_S:
        return
    for j in range(6):
        s["motion"][j] = start[j]
    s["base_v"][0], s["base_v"][1], s["base_v"][2] = base0, base1, base2
    s["error_v"][0], s["error_v"][1], s["error_v"][2] = error0, error1, error2
    for i in range(3):
        s["touched"][i] = 0
    n = math.ceil(h / CONTACT_S)
    for _ in range(n):
        _step(p, s, h / n)
