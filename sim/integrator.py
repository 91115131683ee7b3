"""One step of the table's motion: Dormand and Prince's 12-stage method of order 8, with the amplifier's transient taken out.

Between two switches of a channel V_i - V_c = b + s t + e E with E = exp(-t / tau), so the comb forces hold terms in E and E^2 that die
within a few microseconds, far below a sensible step. Their response xi(t) = xi_1 E + xi_2 E^2 is known in closed form to leading
orders in tau, from xi'' + D xi' + K/m xi = A E:   xi_1 = tau^2 (A + tau D A - tau^2 K A / m),   xi_2 likewise with tau / 2.
Substituting x = y + xi is exact, whatever xi is; y'' = a(y + xi, y' + xi', t) - xi'' is smooth, and y is what is integrated."""

import math

import numpy as np
from numba import njit
from scipy.integrate import DOP853

from sim.amplifier import pass_time
from sim.mechanics import acceleration, stiffness

A = np.ascontiguousarray(DOP853.A[:12, :12])
B = np.ascontiguousarray(DOP853.B)
C = np.ascontiguousarray(DOP853.C[:12])

LONGEST_S = 105e-6
"""Longest step. One order-8 step of 105 us is a 15th of the fastest rigid mode's period."""
CONTACT_S = 4e-6
"""Step while a stop or a snapped comb touches."""


@njit(cache=True, error_model="numpy")
def _tabulate_decay(p, s, h):
    """E at the stages and at the end of a step of h s, kept until h changes."""
    if s["decay_h_s"] == h:
        return
    s["decay_h_s"] = h
    tau = p["amplifier_s"]
    for i in range(12):
        s["decay"][i] = math.exp(-C[i] * h / tau) if tau > 0.0 else 0.0
    s["decay"][12] = math.exp(-h / tau) if tau > 0.0 else 0.0


@njit(cache=True, error_model="numpy")
def _fast_response(p, s):
    """Set xi_1 and xi_2, s["fast_1"] and s["fast_2"], m, at the pose where the step starts. False if no channel is in transient."""
    if s["error_v"][0] == 0.0 and s["error_v"][1] == 0.0 and s["error_v"][2] == 0.0:
        return False
    m = s["motion"]
    volt2 = s["volt2"]
    volt2[0], volt2[1], volt2[2] = 0.0, 0.0, 0.0
    rest = acceleration(p, s, volt2, m[0], m[1], m[2], 0.0, 0.0, 0.0)
    for i in range(3):
        volt2[i] = 2.0 * (s["base_v"][i] - s["charge_v"][i]) * s["error_v"][i]
    one = acceleration(p, s, volt2, m[0], m[1], m[2], 0.0, 0.0, 0.0)
    for i in range(3):
        volt2[i] = s["error_v"][i] ** 2
    two = acceleration(p, s, volt2, m[0], m[1], m[2], 0.0, 0.0, 0.0)
    k = stiffness(p, m[0], m[1], m[2])
    tau = p["amplifier_s"]
    _respond(p, k, tau, one[0] - rest[0], one[1] - rest[1], one[2] - rest[2], s["fast_1"])
    _respond(p, k, 0.5 * tau, two[0] - rest[0], two[1] - rest[1], two[2] - rest[2], s["fast_2"])
    return True


@njit(cache=True, error_model="numpy")
def _respond(p, k, tau, ax, ay, az, out):
    """Displacement amplitude (3,) to an acceleration (ax, ay, az) exp(-t/tau)."""
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
def _step(p, s, h):
    """Integrate motion and voltages over h s, without a look at stops."""
    _tabulate_decay(p, s, h)
    fast = _fast_response(p, s)
    motion, slope, y = s["motion"], s["slope"], s["trial"]
    xi1, xi2, volt2 = s["fast_1"], s["fast_2"], s["volt2"]
    per_tau = 1.0 / p["amplifier_s"] if fast else 0.0
    if fast:
        for j in range(3):
            motion[j] -= xi1[j] + xi2[j]
            motion[3 + j] += (xi1[j] + 2.0 * xi2[j]) * per_tau
    for i in range(12):
        for j in range(6):
            y[j] = 0.0
        for r in range(i):
            weight = A[i, r]
            if weight != 0.0:
                for j in range(6):
                    y[j] += weight * slope[r, j]
        for j in range(6):
            y[j] = motion[j] + h * y[j]
        e1 = s["decay"][i]
        for c in range(3):
            volt = s["base_v"][c] - s["charge_v"][c] + s["slope_v_per_s"][c] * (C[i] * h) + s["error_v"][c] * e1
            volt2[c] = volt * volt
        slope[i, 0], slope[i, 1], slope[i, 2] = y[3], y[4], y[5]
        if fast:
            e2 = e1 * e1
            for j in range(3):
                y[j] += xi1[j] * e1 + xi2[j] * e2
                y[3 + j] -= (xi1[j] * e1 + 2.0 * xi2[j] * e2) * per_tau
        a = acceleration(p, s, volt2, y[0], y[1], y[2], y[3], y[4], y[5])
        slope[i, 3], slope[i, 4], slope[i, 5] = a[0], a[1], a[2]
        if fast:
            for j in range(3):
                slope[i, 3 + j] -= (xi1[j] * e1 + 4.0 * xi2[j] * e2) * per_tau * per_tau
    for r in range(12):
        weight = B[r] * h
        if weight != 0.0:
            for j in range(6):
                motion[j] += weight * slope[r, j]
    if fast:
        e1 = s["decay"][12]
        e2 = e1 * e1
        for j in range(3):
            motion[j] += xi1[j] * e1 + xi2[j] * e2
            motion[3 + j] -= (xi1[j] * e1 + 2.0 * xi2[j] * e2) * per_tau
    pass_time(s, h, s["decay"][12])


@njit(cache=True, error_model="numpy")
def step(p, s, h):
    """Integrate motion and voltages over h s, at most LONGEST_S. If any stage met a stop, the step is done again in short ones."""
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
    n = int(math.ceil(h / CONTACT_S))
    for _ in range(n):
        _step(p, s, h / n)
