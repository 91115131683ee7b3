"""One step of the table's motion: Dormand, El-Mikkawy and Prince's method of order 8 for x'' = f(t, x), after two exact
changes of variables.

The amplifier's transient. Between two switches of a channel V_i - V_c = b + s t + e E with E = exp(-t / tau), so the
comb forces hold terms A_1 E + A_2 E^2 (per mass) that die within a few microseconds, far below a sensible step. With
x = y + xi, xi = R_1 A_1 E + R_2 A_2 E^2, whatever the matrices R,

    y'' + D y' = a(y + xi, t) - (xi'' + D xi'),

and with those of ``sim.motion.at_rest.linearise``, which answer xi'' + D xi' + K xi / m = A E to leading orders in
tau, y is smooth. What stays rough is the turn of the Jacobian while a transient lasts.

Damping. From the start of a step, y = y_0 + exp(-D t / 2) u takes the velocity out of the right-hand side:

    u'' = exp(D t / 2) (a - (xi'' + D xi')) + D^2 u / 4,   u(0) = 0,   u'(0) = y'(0)."""

import math

import numpy as np

from sim.motion.amplifier import pass_time
from sim.motion.kernel import kernel
from sim.motion.mechanics import comb_accelerations, undamped_acceleration
from sim.motion.nystrom import B_RATE, STAGES, A, B, C

LONGEST_S = 205e-6
"""Longest step: a sixth of the fastest rigid mode's period, at which the order-8 method
is exact to 1e-14 m in a scan."""
CONTACT_S = 2.5e-6
"""Step while a stop or a snapped comb touches."""
LAST = STAGES - 1
"""Stage at the end of the step."""


@kernel
def tabulate(p: np.void, s: np.void, h: float) -> None:
    """E, exp(-D t / 2) and exp(D t / 2) at the stages of a step of h s, the last of
    which lies at its end. Kept until h changes."""
    if s["tabulated_h_s"] == h:
        return
    s["tabulated_h_s"] = h
    tau = p["amplifier_s"]
    for i in range(STAGES):
        t = C[i] * h
        s["decay"][i] = math.exp(-t / tau) if tau > 0.0 else 0.0
        _exponentials(p["damping_per_s"], 0.5 * t, s["shrink"][i], s["swell"][i])


@kernel
def _exponentials(d: np.ndarray, t: float, shrink: np.ndarray, swell: np.ndarray) -> None:
    """exp(-d t) and exp(d t) of a (3, 3) for |d t| well below 1, by their series, column by column."""
    for j in range(3):
        a, b, c = (1.0 if j == 0 else 0.0), (1.0 if j == 1 else 0.0), (1.0 if j == 2 else 0.0)
        shrink[0, j], shrink[1, j], shrink[2, j] = a, b, c
        swell[0, j], swell[1, j], swell[2, j] = a, b, c
        n, sign = 0, 1.0
        while max(abs(a), abs(b), abs(c)) > 1e-18:
            n += 1
            sign = -sign
            f = t / n
            a, b, c = (
                f * (d[0, 0] * a + d[0, 1] * b + d[0, 2] * c),
                f * (d[1, 0] * a + d[1, 1] * b + d[1, 2] * c),
                f * (d[2, 0] * a + d[2, 1] * b + d[2, 2] * c),
            )
            shrink[0, j], swell[0, j] = shrink[0, j] + sign * a, swell[0, j] + a
            shrink[1, j], swell[1, j] = shrink[1, j] + sign * b, swell[1, j] + b
            shrink[2, j], swell[2, j] = shrink[2, j] + sign * c, swell[2, j] + c


@kernel
def times(m: np.ndarray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """m (3, 3) times a vector."""
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z,
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z,
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z,
    )


@kernel
def transient(p: np.void, s: np.void) -> None:
    """Amplitudes (3,) of a transient at the pose where the step starts: of xi, s["fast_1_m"] and s["fast_2_m"], and of
    -(xi'' + D xi'), s["fast_1_m_per_s2"] and s["fast_2_m_per_s2"]. Zero if no channel is in one."""
    one, two = s["fast_1_m"], s["fast_2_m"]
    one_push, two_push = s["fast_1_m_per_s2"], s["fast_2_m_per_s2"]
    error = s["error_v"]
    if error[0] == 0.0 and error[1] == 0.0 and error[2] == 0.0:
        for j in range(3):
            one[j], two[j], one_push[j], two_push[j] = 0.0, 0.0, 0.0, 0.0
        return
    for i in range(3):
        s["volt2"][i] = 2.0 * (s["base_v"][i] - s["charge_v"][i]) * error[i]
        s["error_volt2"][i] = error[i] * error[i]
    ax, ay, az, bx, by, bz = comb_accelerations(p, s, s["volt2"], s["error_volt2"], s["motion"])
    one[0], one[1], one[2] = times(p["response_1_s2"], ax, ay, az)
    one_push[0], one_push[1], one_push[2] = times(p["response_1"], ax, ay, az)
    two[0], two[1], two[2] = times(p["response_2_s2"], bx, by, bz)
    two_push[0], two_push[1], two_push[2] = times(p["response_2"], bx, by, bz)


@kernel
def _weighted(slopes: np.ndarray, weights: np.ndarray, n: int) -> tuple[float, float, float]:
    """Sum of the first n rows of ``slopes`` (8, 3), each times its weight."""
    x, y, z = 0.0, 0.0, 0.0
    for r in range(n):
        w = weights[r]
        x += w * slopes[r, 0]
        y += w * slopes[r, 1]
        z += w * slopes[r, 2]
    return x, y, z


@kernel
def _step(p: np.void, s: np.void, h: float) -> None:
    """Integrate motion and voltages over h s, without a look at stops."""
    tabulate(p, s, h)
    transient(p, s)
    motion, slopes, volt2, decay = s["motion"], s["slopes"], s["volt2"], s["decay"]
    k, h2 = 1.0 / p["amplifier_s"] if p["amplifier_s"] > 0.0 else 0.0, h * h
    x1, y1, z1 = s["fast_1_m"][0], s["fast_1_m"][1], s["fast_1_m"][2]
    x2, y2, z2 = s["fast_2_m"][0], s["fast_2_m"][1], s["fast_2_m"][2]
    one, two = s["fast_1_m_per_s2"], s["fast_2_m_per_s2"]
    x, y, z = motion[0] - x1 - x2, motion[1] - y1 - y2, motion[2] - z1 - z2
    vx, vy, vz = motion[3] + k * (x1 + 2.0 * x2), motion[4] + k * (y1 + 2.0 * y2), motion[5] + k * (z1 + 2.0 * z2)
    for i in range(STAGES):
        t, e1 = C[i] * h, decay[i]
        e2 = e1 * e1
        gx, gy, gz = _weighted(slopes, A[i], i)
        ux, uy, uz = t * vx + h2 * gx, t * vy + h2 * gy, t * vz + h2 * gz
        px, py, pz = times(s["shrink"][i], ux, uy, uz)
        for c in range(3):
            volt = s["base_v"][c] - s["charge_v"][c] + s["slope_v_per_s"][c] * t + s["error_v"][c] * e1
            volt2[c] = volt * volt
        mean = 2.0 * h2 / t if i > 0 else 0.0  # of the velocity's change: stops alone ask for it, in short steps
        g1, g2 = k * e1, 2.0 * k * e2
        ax, ay, az = undamped_acceleration(
            p, s, volt2,
            x + px + x1 * e1 + x2 * e2, y + py + y1 * e1 + y2 * e2, z + pz + z1 * e1 + z2 * e2,
            vx + mean * gx - x1 * g1 - x2 * g2, vy + mean * gy - y1 * g1 - y2 * g2, vz + mean * gz - z1 * g1 - z2 * g2,
        )  # fmt: skip
        ax, ay, az = ax + one[0] * e1 + two[0] * e2, ay + one[1] * e1 + two[1] * e2, az + one[2] * e1 + two[2] * e2
        ax, ay, az = times(s["swell"][i], ax, ay, az)
        gx, gy, gz = times(p["damping2_per_s2"], ux, uy, uz)
        slopes[i, 0], slopes[i, 1], slopes[i, 2] = ax + gx, ay + gy, az + gz
    gx, gy, gz = _weighted(slopes, B, STAGES)
    ux, uy, uz = h * vx + h2 * gx, h * vy + h2 * gy, h * vz + h2 * gz
    gx, gy, gz = _weighted(slopes, B_RATE, STAGES)
    dx, dy, dz = times(p["damping_per_s"], ux, uy, uz)
    px, py, pz = times(s["shrink"][LAST], ux, uy, uz)
    vx, vy, vz = times(s["shrink"][LAST], vx + h * gx - 0.5 * dx, vy + h * gy - 0.5 * dy, vz + h * gz - 0.5 * dz)
    e1 = decay[LAST]
    e2 = e1 * e1
    g1, g2 = k * e1, 2.0 * k * e2
    motion[0], motion[3] = x + px + x1 * e1 + x2 * e2, vx - x1 * g1 - x2 * g2
    motion[1], motion[4] = y + py + y1 * e1 + y2 * e2, vy - y1 * g1 - y2 * g2
    motion[2], motion[5] = z + pz + z1 * e1 + z2 * e2, vz - z1 * g1 - z2 * g2
    pass_time(s, h, e1)


@kernel
def step(p: np.void, s: np.void, h: float) -> None:
    """Integrate motion and voltages over h s, at most LONGEST_S. If any stage met a
    stop, the step is done again in short ones."""
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
    whole = s["tabulated_h_s"]  # h, read here so that no step without a stop works out what follows
    n = math.ceil(whole / CONTACT_S)
    for _ in range(n):
        _step(p, s, whole / n)
