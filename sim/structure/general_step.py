"""One step of table and flexible modes together, under a shaking base and a noisy voltage.

Coordinates z = (table y, modes r). With V the mechanism's energy, F the comb forces, a_b the base's acceleration and
x = y - sum kappa_j r_j where the mechanism is:

    m y''     = P - m D y' + F_ext - m a_b,                  P = -grad V(x) + J(x)^T F + F_lift + F_stops
    m_j r_j'' = u_j . F - kappa_j . P - m_j (w_j^2 r_j + w_j / Q_j r_j')

from the kinetic energy m y'^2 / 2 + sum m_j r_j'^2 / 2 and the potential V(x) + sum m_j w_j^2 r_j^2 / 2: what a mode
takes the others get. The method is that of ``sim.motion.integrator``, with the amplifier's transient and the damping
taken out in the same way; steps are shorter, for the fastest mode."""

import math

import numpy as np

from sim.motion.amplifier import pass_time
from sim.motion.geometry import E_X, E_Y, N_X, N_Y, leg, lift, strokes
from sim.motion.integrator import CONTACT_S, LAST, tabulate, times
from sim.motion.kernel import kernel
from sim.motion.layout import CUBIC, MODES
from sim.motion.mechanics import comb_accelerations, undamped_acceleration
from sim.motion.nystrom import B_RATE, STAGES, A, B, C
from sim.structure.side import rise_within


@kernel
def cubic(coefficients: np.ndarray, j: int, t: float) -> float:
    """Value at t s of column j of coefficients (4, 3)."""
    value = 0.0
    for n in range(CUBIC - 1, -1, -1):
        value = value * t + coefficients[n, j]
    return value


@kernel
def _comb_forces(p: np.void, volt2: np.ndarray, x: float, y: float, z: float, out_n: np.ndarray) -> None:
    """Forces (3,) of the drive combs, N, with the mechanism at a pose."""
    _, _, drawn_m = lift(p, z)
    for i in range(3):
        w = N_X[i] * x + N_Y[i] * y
        q = E_X[i] * x + E_Y[i] * y + drawn_m + p["crank_m"] - leg(p["crank_m"], w)
        out_n[i] = p["force_gain_n_per_v2"][i] * (1.0 + p["fringe_per_m"] * q) * volt2[i]


@kernel
def _generalise(p: np.void, forces_n: np.ndarray, ax: float, ay: float, az: float, modes: int, out: np.ndarray) -> None:
    """Accelerations (3 + modes,) from the mechanism's, P / m, and from the comb forces,
    without the modes' own springs."""
    out[0], out[1], out[2] = ax, ay, az
    mass = p["mass_kg"]
    for k in range(modes):
        u, kappa = p["mode_comb"][k], p["mode_table"][k]
        push = u[0] * forces_n[0] + u[1] * forces_n[1] + u[2] * forces_n[2]
        push -= mass * (kappa[0] * ax + kappa[1] * ay + kappa[2] * az)
        out[3 + k] = push * p["mode_per_kg"][k]


@kernel
def accelerations(p: np.void, s: np.void, t: float, volt2: np.ndarray, out: np.ndarray) -> None:
    """z'' (3 + modes,) without damping at s["z_at"], s["rate_at"], t s into the call, with squared voltages (3,), which
    rise by what fingers aside add."""
    z, rate, modes = s["z_at"], s["rate_at"], p["mode_count"]
    x0, x1, x2, v0, v1, v2 = z[0], z[1], z[2], rate[0], rate[1], rate[2]
    for k in range(modes):
        kappa, r, rr = p["mode_table"][k], z[3 + k], rate[3 + k]
        x0, x1, x2 = x0 - kappa[0] * r, x1 - kappa[1] * r, x2 - kappa[2] * r
        v0, v1, v2 = v0 - kappa[0] * rr, v1 - kappa[1] * rr, v2 - kappa[2] * rr
    if p["misaligned_on"] != 0:
        s["pose"][0], s["pose"][1], s["pose"][2] = x0, x1, x2
        strokes(p, s["pose"], s["strokes_m"])
        rise_within(s, s["strokes_m"], volt2)
    ax, ay, az = undamped_acceleration(p, s, volt2, x0, x1, x2, v0, v1, v2)
    if modes > 0:
        _comb_forces(p, volt2, x0, x1, x2, s["comb_n"])
        for i in range(3):
            if s["held"][i] != 0:
                s["comb_n"][i] = 0.0
    _generalise(p, s["comb_n"], ax, ay, az, modes, out)
    for k in range(modes):
        out[3 + k] -= p["mode_w2_per_s2"][k] * z[3 + k]
    for j in range(3):
        out[j] += p["per_kg"] * s["steady_n"][j] - cubic(s["shake_m_per_s2"], j, t)


@kernel
def _tabulate_modes(p: np.void, s: np.void, h: float) -> None:
    """exp(-d t / 2) of each mode at the stages of a step of h s; kept until h changes."""
    if s["mode_h_s"] == h:
        return
    s["mode_h_s"] = h
    for i in range(STAGES):
        for k in range(p["mode_count"]):
            s["mode_shrink"][i, k] = math.exp(-0.5 * p["mode_damping_per_s"][k] * C[i] * h)


@kernel
def _answer(response: np.ndarray, vector: np.ndarray, n: int, out: np.ndarray) -> None:
    for j in range(n):
        out[j] = 0.0
        for k in range(n):
            out[j] += response[j, k] * vector[k]


@kernel
def _transient(p: np.void, s: np.void, n: int) -> None:
    """As in ``sim.motion.integrator``, of all coordinates: s["general_one"], s["general_two"] and what they push."""
    error, pose, pull = s["error_v"], s["pose"], s["pull"]
    if error[0] == 0.0 and error[1] == 0.0 and error[2] == 0.0:
        for j in range(n):
            s["general_one"][j], s["general_two"][j] = 0.0, 0.0
            s["general_one_push"][j], s["general_two_push"][j] = 0.0, 0.0
        return
    for i in range(3):
        s["volt2"][i] = 2.0 * (s["base_v"][i] - s["charge_v"][i]) * error[i] * s["comb_rise"][i]
        s["error_volt2"][i] = error[i] * error[i] * s["comb_rise"][i]
    for j in range(3):
        pose[j] = s["motion"][j]
        for k in range(n - 3):
            pose[j] -= p["mode_table"][k, j] * s["modes"][0, k]
    ax, ay, az, bx, by, bz = comb_accelerations(p, s, s["volt2"], s["error_volt2"], pose)
    _comb_forces(p, s["volt2"], pose[0], pose[1], pose[2], s["comb_n"])
    _generalise(p, s["comb_n"], ax, ay, az, n - 3, pull)
    _answer(p["general_response_1_s2"], pull, n, s["general_one"])
    _answer(p["general_response_1"], pull, n, s["general_one_push"])
    _comb_forces(p, s["error_volt2"], pose[0], pose[1], pose[2], s["comb_n"])
    _generalise(p, s["comb_n"], bx, by, bz, n - 3, pull)
    _answer(p["general_response_2_s2"], pull, n, s["general_two"])
    _answer(p["general_response_2"], pull, n, s["general_two_push"])


@kernel
def _shrunk(m: np.ndarray, modes: np.ndarray, vector: np.ndarray, n: int, out: np.ndarray) -> None:
    """A table's matrix (3, 3) and the modes' factors times a vector (n,)."""
    out[0], out[1], out[2] = times(m, vector[0], vector[1], vector[2])
    for k in range(n - 3):
        out[3 + k] = modes[k] * vector[3 + k]


@kernel
def _voltages(s: np.void, t: float, since_s: float, e1: float) -> None:
    """s["volt2"] (3,) t s into the step, which is ``since_s`` into the call."""
    for c in range(3):
        volt = s["base_v"][c] - s["charge_v"][c] + s["slope_v_per_s"][c] * t + s["error_v"][c] * e1
        volt += cubic(s["ripple_v"], c, since_s)
        s["volt2"][c] = volt * volt if s["held"][c] == 0 else 0.0


@kernel
def _step(p: np.void, s: np.void, h: float) -> None:
    """Integrate motion, modes and voltages over h s, without a look at stops."""
    n = 3 + p["mode_count"]
    tabulate(p, s, h)
    _tabulate_modes(p, s, h)
    _transient(p, s, n)
    z, v, at, rate, u, pull, slopes = (
        s["z"],
        s["rate"],
        s["z_at"],
        s["rate_at"],
        s["change"],
        s["pull"],
        s["general_slopes"],
    )
    one, two, one_push, two_push = s["general_one"], s["general_two"], s["general_one_push"], s["general_two_push"]
    k, h2 = 1.0 / p["amplifier_s"] if p["amplifier_s"] > 0.0 else 0.0, h * h
    for j in range(n):
        where = s["motion"][j] if j < 3 else s["modes"][0, j - 3]
        speed = s["motion"][3 + j] if j < 3 else s["modes"][1, j - 3]
        z[j] = where - one[j] - two[j]
        v[j] = speed + k * (one[j] + 2.0 * two[j])
    for i in range(STAGES):
        t, e1 = C[i] * h, s["decay"][i]
        e2 = e1 * e1
        mean = 2.0 * h2 / t if i > 0 else 0.0  # of the velocity's change: stops alone ask for it, in short steps
        for j in range(n):
            g = 0.0
            for r in range(i):
                g += A[i, r] * slopes[r, j]
            u[j] = t * v[j] + h2 * g
            rate[j] = v[j] + mean * g - k * (one[j] * e1 + 2.0 * two[j] * e2)
        _shrunk(s["shrink"][i], s["mode_shrink"][i], u, n, at)
        for j in range(n):
            at[j] += z[j] + one[j] * e1 + two[j] * e2
        _voltages(s, t, s["call_s"] + t, e1)
        accelerations(p, s, s["call_s"] + t, s["volt2"], pull)
        for j in range(n):
            pull[j] += one_push[j] * e1 + two_push[j] * e2
        ax, ay, az = times(s["swell"][i], pull[0], pull[1], pull[2])
        gx, gy, gz = times(p["damping2_per_s2"], u[0], u[1], u[2])
        slopes[i, 0], slopes[i, 1], slopes[i, 2] = ax + gx, ay + gy, az + gz
        for m in range(n - 3):
            d = 0.5 * p["mode_damping_per_s"][m]
            slopes[i, 3 + m] = pull[3 + m] / s["mode_shrink"][i, m] + d * d * u[3 + m]
    _end(p, s, h, n)


@kernel
def _end(p: np.void, s: np.void, h: float, n: int) -> None:
    """From the stages to motion, modes and voltages at the step's end."""
    z, v, at, rate, u, slopes = s["z"], s["rate"], s["z_at"], s["rate_at"], s["change"], s["general_slopes"]
    one, two = s["general_one"], s["general_two"]
    k = 1.0 / p["amplifier_s"] if p["amplifier_s"] > 0.0 else 0.0
    for j in range(n):
        g, gr = 0.0, 0.0
        for r in range(STAGES):
            g += B[r] * slopes[r, j]
            gr += B_RATE[r] * slopes[r, j]
        u[j] = h * v[j] + h * h * g
        rate[j] = v[j] + h * gr
    dx, dy, dz = times(p["damping_per_s"], u[0], u[1], u[2])
    rate[0], rate[1], rate[2] = rate[0] - 0.5 * dx, rate[1] - 0.5 * dy, rate[2] - 0.5 * dz
    for m in range(n - 3):
        rate[3 + m] -= 0.5 * p["mode_damping_per_s"][m] * u[3 + m]
    e1 = s["decay"][LAST]
    e2 = e1 * e1
    _shrunk(s["shrink"][LAST], s["mode_shrink"][LAST], u, n, at)
    _shrunk(s["shrink"][LAST], s["mode_shrink"][LAST], rate, n, u)
    for j in range(n):
        where = z[j] + at[j] + one[j] * e1 + two[j] * e2
        speed = u[j] - k * (one[j] * e1 + 2.0 * two[j] * e2)
        if j < 3:
            s["motion"][j], s["motion"][3 + j] = where, speed
        else:
            s["modes"][0, j - 3], s["modes"][1, j - 3] = where, speed
    s["call_s"] += h
    pass_time(s, h, e1)


@kernel
def general_step(p: np.void, s: np.void, h: float) -> None:
    """Integrate motion, modes and voltages over h s, at most p["longest_s"]. If any stage met a stop, the step is done
    again in short ones."""
    for j in range(6):
        s["start"][j] = s["motion"][j]
    for k in range(MODES):
        s["start_modes"][0, k], s["start_modes"][1, k] = s["modes"][0, k], s["modes"][1, k]
    base0, base1, base2 = s["base_v"][0], s["base_v"][1], s["base_v"][2]
    error0, error1, error2 = s["error_v"][0], s["error_v"][1], s["error_v"][2]
    call_s = s["call_s"]
    s["contact"] = 0
    _step(p, s, h)
    if s["contact"] == 0 or h <= CONTACT_S:
        return
    for j in range(6):
        s["motion"][j] = s["start"][j]
    for k in range(MODES):
        s["modes"][0, k], s["modes"][1, k] = s["start_modes"][0, k], s["start_modes"][1, k]
    s["base_v"][0], s["base_v"][1], s["base_v"][2] = base0, base1, base2
    s["error_v"][0], s["error_v"][1], s["error_v"][2] = error0, error1, error2
    s["call_s"] = call_s
    for i in range(3):
        s["touched"][i] = 0
    n = math.ceil(h / CONTACT_S)
    for _ in range(n):
        _step(p, s, h / n)
