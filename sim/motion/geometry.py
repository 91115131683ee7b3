"""The mechanism's loop closure, solved from its points.

Chain i: a slider on the line through the centre along e_i; a crank of length L1 in the plane, from the slider to a
pin; a link of length L2 from the pin up to the table, which the parallelogram keeps in the vertical plane of e_i.
Hence, for a table at (p, z),

    pin_i = p - delta e_i,   delta = sqrt(L2^2 - z^2)      (the link's projection)
    slider_i: the point of the line along e_i at distance L1 from pin_i, on the outer side.

With u = p.e_i and w = p.n_i the pin lies w beside the line, so the slider is sqrt(L1^2 - w^2) =: c behind it: the
stroke is q = u + (delta_0 - delta) + (L1 - c), whose differences of half-millimetres round to about 1e-19 m.
Frame: origin of the table at rest, z up; e_i at 90, 210, 330 degrees, n_i = e_i turned by +90 degrees."""

import math

import numpy as np

from sim.motion.kernel import inlined, kernel

HALF_ROOT3 = math.sqrt(3.0) / 2.0
E_X = (0.0, -HALF_ROOT3, HALF_ROOT3)
E_Y = (1.0, -0.5, -0.5)
N_X = (-1.0, 0.5, 0.5)
N_Y = (0.0, -HALF_ROOT3, HALF_ROOT3)

STRAIGHT = 0.01
"""A link or crank is never taken shorter than this share of itself across its line: keeps numbers finite in a wreck."""


@inlined
def leg(length_m: float, across_m: float) -> float:
    """Length of the other leg of a right triangle with hypotenuse ``length_m``."""
    return math.sqrt(max(length_m * length_m - across_m * across_m, (STRAIGHT * length_m) ** 2))


@kernel
def lift(p: np.void, z_m: float) -> tuple[float, float, float]:
    """For a table z_m above rest: link height, its projection, and how far that has drawn the pins outward, m."""
    height_m = p["height_rest_m"] + z_m
    projection_m = leg(p["link_m"], height_m)
    return height_m, projection_m, p["projection_rest_m"] - projection_m


@inlined
def chain(i: int, crank_m: float, x_m: float, y_m: float, drawn_m: float) -> tuple[float, float, float]:
    """Chain i for a table at (x, y) whose links have drawn the pins outward by ``drawn_m``: its stroke q, m, how far
    across its line the pin is, w, m, and 1 / c, 1/m."""
    w = N_X[i] * x_m + N_Y[i] * y_m
    c = leg(crank_m, w)
    return E_X[i] * x_m + E_Y[i] * y_m + drawn_m + (crank_m - c), w, 1.0 / c


@inlined
def near_chain(
    i: int, crank_m: float, per_crank: float, x_m: float, y_m: float, drawn_m: float
) -> tuple[float, float, float]:
    """The same, and w / L1 in place of w, where that is 0.1 at most: 1 / c by the series of (1 - a)^(-1/2), which waits
    for neither root nor division."""
    w = N_X[i] * x_m + N_Y[i] * y_m
    lean = w * per_crank
    a = lean * lean
    a2 = a * a
    low, high = 1.0 + 0.5 * a + a2 * (0.375 + 0.3125 * a), 35 / 128 + 63 / 256 * a + a2 * (231 / 1024 + 429 / 2048 * a)
    inverse_c = per_crank * (low + a2 * a2 * high)
    short_m = crank_m - (crank_m * crank_m - w * w) * inverse_c
    return E_X[i] * x_m + E_Y[i] * y_m + drawn_m + short_m, lean, inverse_c


@kernel
def strokes(p: np.void, motion: np.ndarray, out_m: np.ndarray) -> None:
    """Strokes (3,) of the sliders from rest, positive inward, for the pose in motion[:3]."""
    _, _, drawn_m = lift(p, motion[2])
    for i in range(3):
        u = E_X[i] * motion[0] + E_Y[i] * motion[1]
        w = N_X[i] * motion[0] + N_Y[i] * motion[1]
        out_m[i] = u + drawn_m + p["crank_m"] - leg(p["crank_m"], w)


@kernel
def see_sliders(p: np.void, s: np.void, pose_m: np.ndarray) -> None:
    """At a pose (3 or more,) the strokes to s["slider_m"], the tangents of the cranks' angles to s["slider_tangent"]
    and that of the links' to s["slider_steep"]: worked out once, for all who ask of the same pose."""
    at, crank_m, x, y, z = s["slider_at_m"], p["crank_m"], pose_m[0], pose_m[1], pose_m[2]
    if x == at[0] and y == at[1] and z == at[2]:
        return
    height_m, projection_m, drawn_m = lift(p, z)
    for i in range(3):
        u, w = E_X[i] * x + E_Y[i] * y, N_X[i] * x + N_Y[i] * y
        c = leg(crank_m, w)
        s["slider_m"][i] = u + drawn_m + crank_m - c
        s["slider_tangent"][i] = w / c
    s["slider_steep"] = height_m / projection_m
    at[0], at[1], at[2] = x, y, z


@kernel
def stroke_rates(p: np.void, motion: np.ndarray, out_m_per_s: np.ndarray) -> None:
    """Rates (3,) of the strokes for pose and velocity in motion (6,)."""
    height_m, projection_m, _ = lift(p, motion[2])
    for i in range(3):
        w = N_X[i] * motion[0] + N_Y[i] * motion[1]
        tangent = w / leg(p["crank_m"], w)
        along = E_X[i] * motion[3] + E_Y[i] * motion[4]
        across = N_X[i] * motion[3] + N_Y[i] * motion[4]
        out_m_per_s[i] = along + across * tangent + motion[5] * height_m / projection_m


def jacobian(p: np.ndarray, position_m: np.ndarray) -> np.ndarray:
    """d(strokes)/d(position) (3, 3) at a pose; for starting up and looking in, not for the inner loop."""
    rows = np.empty((3, 3))
    column = np.empty(3)
    for axis in range(3):
        motion = np.concatenate([position_m, np.eye(3)[axis]])
        stroke_rates(p, motion, column)
        rows[:, axis] = column
    return rows
