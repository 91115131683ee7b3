"""A step of the usual length in vectors: collocation about the exact motion of the linear stage.

What is left of the acceleration a when Hooke's law at the rest pose is taken out of it,

    n(x, t) = a(x, t) + K x / m,     x'' + D x' + K x / m = n,

changes little over a step, however the stage swings: the left side is solved exactly (``sim.motion.flow``). n is
interpolated through Radau's four nodes, of which the last is the end, so poses X_j there, and the velocity at the end,
are

    X_j = flow_j (x_0, v_0) + sum_k answer_jk n(X_k).

They come nearer in two rounds: with n as it is at the start, then with n at all nodes as it was found there. Each takes
off the share by which the stiffness differs from K, times (omega h)^2 / 10 or so: a factor of a hundred. The nodes do
not wait for one another, and what they take has no branch: four instants are one vector of the processor.

The amplifier's transient is taken out of the motion as in ``sim.motion.integrator``, whose step is the one for any
other length, for ramps of the amplifier, and where a slider is at a stop or held. Collocation at Radau's nodes: Hairer,
Wanner, Solving Ordinary Differential Equations II (1996), IV.5; about an exact linear part: Hochbruck, Ostermann,
Exponential integrators, Acta Numerica 19 (2010), 2.2."""

import numpy as np

from sim.motion.amplifier import pass_time
from sim.motion.flow import tabulate_flow
from sim.motion.integrator import transient
from sim.motion.kernel import inlined, kernel
from sim.motion.layout import INSTANTS
from sim.motion.mechanics import Constants, constants, near_acceleration

Three = tuple[float, float, float]
_END = INSTANTS - 1


@kernel
def regular_step(p: np.void, s: np.void) -> bool:
    """Integrate motion and voltages over p["regular_s"]; or return False with nothing changed but scratch: on a ramp
    of a channel, or where a slider is held, or at a stop at any instant."""
    slope, held = s["slope_v_per_s"], s["held"]
    if slope[0] != 0.0 or slope[1] != 0.0 or slope[2] != 0.0 or held[0] != 0 or held[1] != 0 or held[2] != 0:
        return False
    if s["flow_h_s"] != p["regular_s"]:
        tabulate_flow(p, s)
    transient(p, s)
    _set_out(p, s)
    nx, ny, nz, near = _at_start(p, s)
    if near == 0.0:
        return False
    first_round(p, s, (nx, ny, nz))
    second_round(p, s)
    if s["near"][0] * s["near"][1] * s["near"][2] * s["near"][3] == 0.0:
        return False
    _end(p, s)
    return True


@kernel
def _set_out(p: np.void, s: np.void) -> None:
    """The smooth part of the motion at the start."""
    motion, start, smooth, one, two = s["motion"], s["start"], s["smooth"], s["fast_1_m"], s["fast_2_m"]
    k = 1.0 / p["amplifier_s"] if p["amplifier_s"] > 0.0 else 0.0
    for i in range(3):
        start[i], start[3 + i] = motion[i], motion[3 + i]
        smooth[i] = motion[i] - one[i] - two[i]
        smooth[3 + i] = motion[3 + i] + k * (one[i] + 2.0 * two[i])


@inlined
def _three(a: np.ndarray) -> Three:
    return a[0], a[1], a[2]


@inlined
def _three_at(a: np.ndarray, j: int) -> Three:
    return a[0, j], a[1, j], a[2, j]


@inlined
def _added(a: Three, b: Three) -> Three:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inlined
def _decayed(one: Three, two: Three, e1: float) -> Three:
    """A transient, when the exponential has fallen to ``e1``."""
    e2 = e1 * e1
    return one[0] * e1 + two[0] * e2, one[1] * e1 + two[1] * e2, one[2] * e1 + two[2] * e2


@inlined
def _led(table: np.ndarray, j: int, v: Three) -> Three:
    """Pose at an instant that the matrices in ``table`` (6, 4) make of three numbers."""
    return _times((table[0, j], table[1, j], table[2, j]), (table[3, j], table[4, j], table[5, j]), v)


@inlined
def _times(own: Three, cross: Three, v: Three) -> Three:
    """A symmetric matrix times a vector: what is on its diagonal, and its xy, xz, yz."""
    return (
        own[0] * v[0] + cross[0] * v[1] + cross[1] * v[2],
        cross[0] * v[0] + own[1] * v[1] + cross[2] * v[2],
        cross[1] * v[0] + cross[2] * v[1] + own[2] * v[2],
    )


@inlined
def _stiff(p: np.void) -> tuple[Three, Three]:
    """K / m: what is on the diagonal, and xy, xz, yz."""
    k = p["stiff_per_s2"]
    return (k[0, 0], k[1, 1], k[2, 2]), (k[0, 1], k[0, 2], k[1, 2])


@inlined
def _left(
    m: Constants, stiff: tuple[Three, Three], volt2: Three, x: Three, fast: Three, push: Three
) -> tuple[float, float, float, float]:
    """n where the smooth part of the pose is ``x`` and the transient adds ``fast``, m, and what of its acceleration
    answers ``push``; and whether that is near, as ``near_acceleration`` says it."""
    ax, ay, az, near = near_acceleration(m, volt2, x[0] + fast[0], x[1] + fast[1], x[2] + fast[2])
    kx, ky, kz = _times(*stiff, x)
    return ax + (push[0] + kx), ay + (push[1] + ky), az + (push[2] + kz), near


@kernel
def _at_start(p: np.void, s: np.void) -> tuple[float, float, float, float]:
    """n at the start, and whether that is near. Where the last step ended the acceleration is known, unless voltages
    jump. Forces that have changed since are seen in the rounds: the start only says where these begin."""
    at, fast = _three(s["smooth"]), _added(_three(s["fast_1_m"]), _three(s["fast_2_m"]))
    push = _added(_three(s["fast_1_m_per_s2"]), _three(s["fast_2_m_per_s2"]))
    motion, ended, known = s["motion"], s["ended_m"], s["ended_m_per_s2"]
    if motion[0] == ended[0] and motion[1] == ended[1] and motion[2] == ended[2] and p["amplifier_s"] > 0.0:
        x, y, z = _times(*_stiff(p), at)
        return known[0] + (push[0] + x), known[1] + (push[1] + y), known[2] + (push[2] + z), 1.0
    base, error, charge = s["base_v"], s["error_v"], s["charge_v"]
    vx, vy, vz = base[0] + error[0] - charge[0], base[1] + error[1] - charge[1], base[2] + error[2] - charge[2]
    return _left(constants(p, s), _stiff(p), (vx * vx, vy * vy, vz * vz), at, fast, push)


@kernel
def first_round(p: np.void, s: np.void, n: Three) -> None:
    """Write n at the instants, where the ``n`` of the start leads; and what is known of them beforehand: squared
    voltages, what the transient adds, and where the stage swings by itself."""
    charge, one, two, x = s["charge_v"], _three(s["fast_1_m"]), _three(s["fast_2_m"]), _three(s["smooth"])
    one_push, two_push, v = _three(s["fast_1_m_per_s2"]), _three(s["fast_2_m_per_s2"]), _three(s["smooth"][3:])
    bx, by, bz = s["base_v"][0] - charge[0], s["base_v"][1] - charge[1], s["base_v"][2] - charge[2]
    ex, ey, ez = _three(s["error_v"])
    from_pose, from_rate, steady, decay = s["from_pose"], s["from_rate"], s["steady"], s["instant_decay"]
    volt2, fast, push, free, pose = s["instant_volt2"], s["fast_m"], s["fast_m_per_s2"], s["free_m"], s["pose_m"]
    near = s["near"]
    for j in range(INSTANTS):
        e1 = decay[j]
        wx, wy, wz = bx + ex * e1, by + ey * e1, bz + ez * e1
        swung = _added(_led(from_pose, j, x), _led(from_rate, j, v))
        volt2[0, j], volt2[1, j], volt2[2, j] = wx * wx, wy * wy, wz * wz
        fast[0, j], fast[1, j], fast[2, j] = _decayed(one, two, e1)
        push[0, j], push[1, j], push[2, j] = _decayed(one_push, two_push, e1)
        free[0, j], free[1, j], free[2, j] = swung
        pose[0, j], pose[1, j], pose[2, j] = _added(swung, _led(steady, j, n))
        near[j] = 1.0
    _look(p, s)


@kernel
def second_round(p: np.void, s: np.void) -> None:
    """Write n at the instants, where that at the nodes leads."""
    answer, free, left, pose = s["answer"], s["free_m"], s["left_m_per_s2"], s["pose_m"]
    one, two, three, four = _three_at(left, 0), _three_at(left, 1), _three_at(left, 2), _three_at(left, 3)
    for j in range(INSTANTS):
        led = _added(_led(answer[0], j, one), _led(answer[1], j, two))
        led = _added(led, _added(_led(answer[2], j, three), _led(answer[3], j, four)))
        pose[0, j], pose[1, j], pose[2, j] = _added(_three_at(free, j), led)
    _look(p, s)


@kernel
def _look(p: np.void, s: np.void) -> None:
    """Write n at the instants from the poses there, and where one is not near, 0 to its ``near``."""
    m, stiff, near, pose, left = constants(p, s), _stiff(p), s["near"], s["pose_m"], s["left_m_per_s2"]
    volt2, fast, push = s["instant_volt2"], s["fast_m"], s["fast_m_per_s2"]
    for j in range(INSTANTS):
        ax, ay, az, near_there = _left(
            m, stiff, _three_at(volt2, j), _three_at(pose, j), _three_at(fast, j), _three_at(push, j)
        )
        left[0, j], left[1, j], left[2, j] = ax, ay, az
        near[j] *= near_there


@kernel
def _end(p: np.void, s: np.void) -> None:
    """Take over where the step leads."""
    motion, table, left, parts, to_end = s["motion"], s["end_rate"], s["left_m_per_s2"], s["ended"], s["to_end"]
    for j in range(INSTANTS):
        n = _three_at(left, j)
        parts[0, j], parts[1, j], parts[2, j] = _led(to_end, j, n)
        parts[3, j], parts[4, j], parts[5, j] = _led(to_end[6:], j, n)
    x, v = _three(s["smooth"]), _three(s["smooth"][3:])
    rate = _added(_times(_three(table[0]), _three(table[0, 3:]), x), _times(_three(table[1]), _three(table[1, 3:]), v))
    rate = _added(rate, (_sum(parts[3]), _sum(parts[4]), _sum(parts[5])))
    pose = _added(_three_at(s["free_m"], _END), (_sum(parts[0]), _sum(parts[1]), _sum(parts[2])))
    kx, ky, kz = _times(*_stiff(p), pose)
    known, push = s["ended_m_per_s2"], _three_at(s["fast_m_per_s2"], _END)
    known[0], known[1] = left[0, _END] - (push[0] + kx), left[1, _END] - (push[1] + ky)
    known[2] = left[2, _END] - (push[2] + kz)
    one, two, e1 = s["fast_1_m"], s["fast_2_m"], s["instant_decay"][_END]
    e2, k = e1 * e1, 1.0 / p["amplifier_s"] if p["amplifier_s"] > 0.0 else 0.0
    motion[0], motion[1], motion[2] = _added(pose, _three_at(s["fast_m"], _END))
    motion[3], motion[4], motion[5] = rate
    for i in range(3):
        motion[3 + i] -= k * (one[i] * e1 + 2.0 * (two[i] * e2))
        s["ended_m"][i] = motion[i]
    pass_time(s, p["regular_s"], e1)


@inlined
def _sum(a: np.ndarray) -> float:
    """Of what each node adds."""
    return float((a[0] + a[1]) + (a[2] + a[3]))
