"""Elastic energy, its gradient and Hessian, and the acceleration of the table.

    V = sum_i (2 K1_i q_i^2 + 2 K2_i theta_i^2) + 2 c K3 (alpha - alpha_0)^2
        with sin(theta_i) = w_i / L1 and sin(alpha) = z / L2
    m x'' = -grad V + J^T F + F_levitation + F_stops + F_external - m D x'
        with F_i = k_i (1 + phi q_i) (V_i - V_charge,i)^2

The record keeps leaf = 4 K1, crank_hinge = 4 K2 and link_hinge = 4 c K3, so each
energy is half of that times the square."""

import math
from typing import NamedTuple

import numpy as np

from sim.motion.geometry import E_X, E_Y, N_X, N_Y, chain, leg, lift, near_chain, see_sliders
from sim.motion.kernel import inlined, kernel

NEAR = 0.1
"""The sine of an angle up to which its series is exact to rounding."""


@kernel
def arcsine(y: float) -> float:
    """asin(y); near zero by its series, which is cheaper than the library."""
    return near_arcsine(y) if abs(y) <= NEAR else math.asin(max(-1.0, min(1.0, y)))


@inlined
def near_arcsine(y: float) -> float:
    """asin(y) of at most ``NEAR``, by its series."""
    s = y * y
    fourth = s * s
    tail = 15.0 / 336.0 + s * (105.0 / 3456.0) + fourth * (945.0 / 42240.0 + s * (10395.0 / 599040.0))
    return y * (1.0 + s * (1.0 / 6.0 + s * (3.0 / 40.0) + fourth * tail))


@kernel
def elevation_change(p: np.void, height_m: float, projection_m: float) -> float:
    """alpha - alpha_0, rad: the sine of the difference from the two legs now and at rest."""
    cross = height_m * p["projection_rest_m"] - projection_m * p["height_rest_m"]
    return float(arcsine(cross * p["per_link2"]))


@kernel
def energy(p: np.void, motion: np.ndarray) -> float:
    """Elastic energy of the pose motion[:3], J."""
    height_m, projection_m, drawn_m = lift(p, motion[2])
    total = 0.5 * p["link_hinge_nm"] * elevation_change(p, height_m, projection_m) ** 2
    for i in range(3):
        u = E_X[i] * motion[0] + E_Y[i] * motion[1]
        w = N_X[i] * motion[0] + N_Y[i] * motion[1]
        q = u + drawn_m + p["crank_m"] - leg(p["crank_m"], w)
        total += 0.5 * p["leaf_n_per_m"][i] * q * q + 0.5 * p["crank_hinge_nm"][i] * arcsine(w / p["crank_m"]) ** 2
    return float(total)


@kernel
def acceleration(
    p: np.void, s: np.void, volt2: np.ndarray, x: float, y: float, z: float, vx: float, vy: float, vz: float
) -> tuple[float, float, float]:
    """Acceleration (ax, ay, az) in m/s^2: ``undamped_acceleration`` less the damping's."""
    ax, ay, az = undamped_acceleration(p, s, volt2, x, y, z, vx, vy, vz)
    d = p["damping_per_s"]
    ax -= d[0, 0] * vx + d[0, 1] * vy + d[0, 2] * vz
    ay -= d[1, 0] * vx + d[1, 1] * vy + d[1, 2] * vz
    az -= d[2, 0] * vx + d[2, 1] * vy + d[2, 2] * vz
    return ax, ay, az


@kernel
def undamped_acceleration(
    p: np.void, s: np.void, volt2: np.ndarray, x: float, y: float, z: float, vx: float, vy: float, vz: float
) -> tuple[float, float, float]:
    """Acceleration (ax, ay, az) in m/s^2 at a pose, with squared comb voltages ``volt2`` (3,) in V^2 and the constant
    force s["force_n"], without damping: the velocity counts on stops alone. Sets s["contact"] and s["touched"] where a
    slider meets a stop or is held by snapped fingers."""
    height_m, projection_m, drawn_m = lift(p, z)
    crank_m = p["crank_m"]
    fringe = p["fringe_per_m"]
    per_projection = 1.0 / projection_m
    steep = height_m * per_projection
    per_crank = p["per_crank"]
    fx, fy, pulls, combs = s["force_n"][0], s["force_n"][1], 0.0, 0.0
    for i in range(3):
        q, w, inverse_c = chain(i, crank_m, x, y, drawn_m)
        tangent = w * inverse_c
        comb = p["force_gain_n_per_v2"][i] * (1.0 + fringe * q) * volt2[i]
        pull = comb - p["leaf_n_per_m"][i] * q
        if q > p["stop_high_m"] or q < p["stop_low_m"] or s["held"][i] != 0:
            rate = E_X[i] * vx + E_Y[i] * vy + (N_X[i] * vx + N_Y[i] * vy) * tangent + vz * steep
            if s["held"][i] != 0:
                pull -= comb  # shorted
                comb = 0.0
            pull += _stop_force(p, s, i, q, rate)
            s["contact"] = 1
        turn = pull * tangent - p["crank_hinge_nm"][i] * arcsine(w * per_crank) * inverse_c
        fx += pull * E_X[i] + turn * N_X[i]
        fy += pull * E_Y[i] + turn * N_Y[i]
        pulls += pull
        combs += comb
    hinge = p["link_hinge_nm"] * elevation_change(p, height_m, projection_m) * per_projection
    fz = s["force_n"][2] + pulls * steep - hinge + p["levitation"] * combs
    per_kg = p["per_kg"]
    return fx * per_kg, fy * per_kg, fz * per_kg


class Constants(NamedTuple):
    """What ``near_acceleration`` takes of the parameters, as values: what a loop writes can't change them. Names and
    units as there; (3,) by chain or axis."""

    crank_m: float
    per_crank: float
    link_m: float
    per_link2: float
    height_rest_m: float
    projection_rest_m: float
    leaf: tuple[float, float, float]
    crank_hinge: tuple[float, float, float]
    link_hinge: float
    comb: tuple[float, float, float]
    fringe_per_m: float
    levitation: float
    stop_low_m: float
    stop_high_m: float
    force_n: tuple[float, float, float]
    per_kg: float


@inlined
def constants(p: np.void, s: np.void) -> Constants:
    """With the constant force s["force_n"]."""
    leaf, hinge, comb, force = p["leaf_n_per_m"], p["crank_hinge_nm"], p["force_gain_n_per_v2"], s["force_n"]
    return Constants(
        p["crank_m"], p["per_crank"], p["link_m"], p["per_link2"], p["height_rest_m"], p["projection_rest_m"],
        (leaf[0], leaf[1], leaf[2]), (hinge[0], hinge[1], hinge[2]), p["link_hinge_nm"], (comb[0], comb[1], comb[2]),
        p["fringe_per_m"], p["levitation"], p["stop_low_m"], p["stop_high_m"], (force[0], force[1], force[2]),
        p["per_kg"],
    )  # fmt: skip


@inlined
def near_acceleration(
    m: Constants, volt2: tuple[float, float, float], x: float, y: float, z: float
) -> tuple[float, float, float, float]:
    """``undamped_acceleration`` without a branch, and 1.0; or anything, and 0.0, where a slider meets a stop or an
    angle is beyond ``NEAR``. Held sliders are not looked for."""
    height_m = m.height_rest_m + z
    projection_m = leg(m.link_m, height_m)
    drawn_m, per_projection = m.projection_rest_m - projection_m, 1.0 / projection_m
    steep = height_m * per_projection
    x1, y1, pull1, comb1, near1 = _near_pull(m, 0, volt2[0], x, y, drawn_m)
    x2, y2, pull2, comb2, near2 = _near_pull(m, 1, volt2[1], x, y, drawn_m)
    x3, y3, pull3, comb3, near3 = _near_pull(m, 2, volt2[2], x, y, drawn_m)
    change = (height_m * m.projection_rest_m - projection_m * m.height_rest_m) * m.per_link2
    hinge = m.link_hinge * near_arcsine(change) * per_projection
    fx, fy = m.force_n[0] + (x1 + x2 + x3), m.force_n[1] + (y1 + y2 + y3)
    fz = m.force_n[2] + (pull1 + pull2 + pull3) * steep - hinge + m.levitation * (comb1 + comb2 + comb3)
    near = near1 * near2 * near3 if abs(change) <= NEAR else 0.0
    return fx * m.per_kg, fy * m.per_kg, fz * m.per_kg, near


@inlined
def _near_pull(
    m: Constants, i: int, volt2: float, x: float, y: float, drawn_m: float
) -> tuple[float, float, float, float, float]:
    """Chain i's part: its force in the plane, N, its pull, N, the comb's in that, and whether it is near."""
    q, lean, inverse_c = near_chain(i, m.crank_m, m.per_crank, x, y, drawn_m)
    comb = m.comb[i] * (1.0 + m.fringe_per_m * q) * volt2
    pull = comb - m.leaf[i] * q
    turn = (pull * (lean * m.crank_m) - m.crank_hinge[i] * near_arcsine(lean)) * inverse_c
    near = 1.0 if (q >= m.stop_low_m) & (q <= m.stop_high_m) & (abs(lean) <= NEAR) else 0.0
    return pull * E_X[i] + turn * N_X[i], pull * E_Y[i] + turn * N_Y[i], pull, comb, near


@kernel
def comb_accelerations(
    p: np.void, s: np.void, one: np.ndarray, two: np.ndarray, pose_m: np.ndarray
) -> tuple[float, float, float, float, float, float]:
    """The combs' own part of ``undamped_acceleration``, which is linear in squared voltages (3,): for two sets of them
    at one pose (3 or more,), one after the other."""
    see_sliders(p, s, pose_m)
    fx, fy, combs, gx, gy, others = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        tangent = s["slider_tangent"][i]
        gain = p["force_gain_n_per_v2"][i] * (1.0 + p["fringe_per_m"] * s["slider_m"][i])
        along_x, along_y = E_X[i] + N_X[i] * tangent, E_Y[i] + N_Y[i] * tangent
        comb, other = gain * one[i], gain * two[i]
        fx, gx = fx + comb * along_x, gx + other * along_x
        fy, gy = fy + comb * along_y, gy + other * along_y
        combs, others = combs + comb, others + other
    per_kg, steep = p["per_kg"], s["slider_steep"] + p["levitation"]
    return fx * per_kg, fy * per_kg, combs * steep * per_kg, gx * per_kg, gy * per_kg, others * steep * per_kg


@kernel
def _stop_force(p: np.void, s: np.void, i: int, q: float, rate: float) -> float:
    """Force of stops on slider i, N, positive inward: Hunt-Crossley k d (1 + c d'), which never pulls. Snapped
    fingers hold the slider with the same stiffness, both ways, near critically damped."""
    force = 0.0
    if s["held"][i] != 0:
        k = p["stop_n_per_m"]
        force -= k * (q - s["held_m"][i]) + math.sqrt(k * p["mass_kg"]) * rate
    if q > p["stop_high_m"]:
        force -= p["stop_n_per_m"] * (q - p["stop_high_m"]) * max(0.0, 1.0 + p["stop_damping_s_per_m"] * rate)
        s["touched"][i] = 1
    elif q < p["stop_low_m"]:
        force += p["stop_n_per_m"] * (p["stop_low_m"] - q) * max(0.0, 1.0 - p["stop_damping_s_per_m"] * rate)
        s["touched"][i] = 1
    return force


@kernel
def stiffness(p: np.void, x: float, y: float, z: float) -> tuple[float, float, float, float, float, float]:
    """Hessian of the elastic energy at a pose, N/m: (k_xx, k_xy, k_xz, k_yy, k_yz, k_zz)."""
    height_m, projection_m, drawn_m = lift(p, z)
    crank_m = p["crank_m"]
    steep = height_m / projection_m
    bend = p["link_m"] * p["link_m"] / projection_m**3
    change = elevation_change(p, height_m, projection_m)
    k_zz = p["link_hinge_nm"] / projection_m**2 * (1.0 + change * steep)
    k_xx, k_xy, k_xz, k_yy, k_yz = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(3):
        w = N_X[i] * x + N_Y[i] * y
        c = leg(crank_m, w)
        q = E_X[i] * x + E_Y[i] * y + drawn_m + (crank_m - c)
        k1, k2 = p["leaf_n_per_m"][i], p["crank_hinge_nm"][i]
        jx = E_X[i] + N_X[i] * w / c
        jy = E_Y[i] + N_Y[i] * w / c
        across = k1 * q * crank_m * crank_m / c**3 + k2 / c**2 * (1.0 + arcsine(w / crank_m) * w / c)
        k_xx += k1 * jx * jx + across * N_X[i] * N_X[i]
        k_xy += k1 * jx * jy + across * N_X[i] * N_Y[i]
        k_yy += k1 * jy * jy + across * N_Y[i] * N_Y[i]
        k_xz += k1 * jx * steep
        k_yz += k1 * jy * steep
        k_zz += k1 * (steep * steep + q * bend)
    return k_xx, k_xy, k_xz, k_yy, k_yz, k_zz
