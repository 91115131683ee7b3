"""Kalman filter of the platform: position, velocity and disturbance force, nine states, constant gain, compiled.

State s = [x - x_0, v, d] in platform coordinates about the operating point x_0. Over one period, with the comb forces
held and approached through the amplifier's pole::

    s+ = Phi s + Gamma w + Gamma_lag (w_old - w),   w = J(x)^T F - grad V(x) + K_0 (x - x_0)

so the linear part carries the resonance and the input w the exact energy gradient and Jacobian, taken where the
estimate will be in mid-period: the filter follows the stage over the whole workspace with one gain. The commanded
forces of the last tick act from the sample of this one, hence the loop's period of delay is in the bookkeeping of w,
not in extra states. A sample shows x - tau v, tau being the sense chain's delay.
"""

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel, rare
from pkxyz_ctrl.core.elasticity import gradient_and_forces

Array = NDArray[np.float64]

ESTIMATOR = np.dtype(
    [
        ("transition", "f8", (6, 9)),  # first six rows of Phi; the disturbance keeps its value
        ("input", "f8", (6, 3)),  # Gamma
        ("input_lag", "f8", (6, 3)),  # Gamma_lag
        ("gain", "f8", (9, 3)),  # steady-state Kalman gain of the measurement update
        ("stiffness_n_per_m", "f8", (3, 3)),  # K_0
        ("operating_point_m", "f8", (3,)),  # x_0
        ("sense_delay_s", "f8"),  # tau
        ("half_period_s", "f8"),  # T/2
        ("decoupled", "i4"),  # 1: no axis acts on another, so Phi, Gamma and K_0 are diagonal, block by block
    ],
    align=True,
)

ESTIMATE = np.dtype(
    [
        ("predicted", "f8", (9,)),  # s at the next sample, before it is seen
        ("filtered", "f8", (9,)),  # s at the last sample, after it was seen
        ("ahead", "f8", (9,)),  # s at the instant from which the force of this tick acts
        ("innovation_m", "f8", (3,)),
    ],
    align=True,
)

FAR = np.dtype(
    [
        (name, "f8", (3,))
        for name in ("start_m", "middle_m", "end_m", "w_n", "w_middle_n", "w_end_n", "w_change_n", "unused_n")
    ],
    align=True,
)
"""Room for ``predict_far``."""


@kernel
def update(estimator: np.void, estimate: np.void, measured_m: Array, has_measurement: bool) -> None:
    """Measurement update at a sample: filtered = predicted + gain (y - h(predicted)).
    Without a measurement the prediction stands.
    """
    predicted, filtered, innovation = estimate["predicted"], estimate["filtered"], estimate["innovation_m"]
    gain, origin, tau = estimator["gain"], estimator["operating_point_m"], estimator["sense_delay_s"]
    for i in range(3):
        innovation[i] = measured_m[i] - origin[i] - (predicted[i] - tau * predicted[3 + i]) if has_measurement else 0.0
    x, y, z = innovation[0], innovation[1], innovation[2]
    for i in range(9):
        filtered[i] = predicted[i] + gain[i, 0] * x + gain[i, 1] * y + gain[i, 2] * z


@kernel
def midway(estimator: np.void, s: Array, position_m: Array) -> None:
    """Position (3,) half a period after the state ``s`` (9,), where ``net_input`` is to be evaluated: at the start of
    the period it would lag behind a moving stage, and the disturbance would have to make up for it."""
    for i in range(3):
        position_m[i] = estimator["operating_point_m"][i] + s[i] + estimator["half_period_s"] * s[3 + i]


@kernel
def net_input(
    geometry: np.void,
    elasticity: np.void,
    estimator: np.void,
    position_m: Array,
    force_n: Array,
    force_old_n: Array,
    apart_n: Array,
    apart_old_n: Array,
    told_n: Array,
    w: Array,
    w_change: Array,
) -> None:
    """w (3,) and w_old - w (3,) in N at an estimated position, for the comb forces that act now and those that acted
    before; ``apart_n`` (3,) and ``apart_old_n`` of them, at the platform, do not count. ``told_n`` (3,) acts beside.
    """
    stiffness, origin = estimator["stiffness_n_per_m"], estimator["operating_point_m"]
    ix, iy, iz = gradient_and_forces(geometry, elasticity, position_m, force_n, force_old_n, w, w_change)
    x, y, z = position_m[0] - origin[0], position_m[1] - origin[1], position_m[2] - origin[2]
    if estimator["decoupled"] != 0:
        ix, iy, iz = ix - stiffness[0, 0] * x, iy - stiffness[1, 1] * y, iz - stiffness[2, 2] * z
    else:
        ix = ix - stiffness[0, 0] * x - stiffness[0, 1] * y - stiffness[0, 2] * z
        iy = iy - stiffness[1, 0] * x - stiffness[1, 1] * y - stiffness[1, 2] * z
        iz = iz - stiffness[2, 0] * x - stiffness[2, 1] * y - stiffness[2, 2] * z
    for i in range(3):
        w_change[i] += apart_n[i] - apart_old_n[i] - w[i]
    w[0] = w[0] - (ix + apart_n[0]) + told_n[0]
    w[1] = w[1] - (iy + apart_n[1]) + told_n[1]
    w[2] = w[2] - (iz + apart_n[2]) + told_n[2]


@kernel
def predict(estimator: np.void, s: Array, w: Array, w_change: Array, out: Array) -> None:
    """Time update over one period: write the state (9,) that follows from ``s`` and the input of ``net_input`` to
    ``out``, another array.
    """
    phi, gamma, lag = estimator["transition"], estimator["input"], estimator["input_lag"]
    if estimator["decoupled"] != 0:
        for i in range(3):
            x, v, d, f, change = s[i], s[3 + i], s[6 + i], w[i], w_change[i]
            out[i] = phi[i, i] * x + phi[i, 3 + i] * v + phi[i, 6 + i] * d + gamma[i, i] * f + lag[i, i] * change
            r = 3 + i
            out[r] = phi[r, i] * x + phi[r, 3 + i] * v + phi[r, 6 + i] * d + gamma[r, i] * f + lag[r, i] * change
            out[6 + i] = d
        return
    x, y, z, vx, vy, vz, dx, dy, dz = s[0], s[1], s[2], s[3], s[4], s[5], s[6], s[7], s[8]
    wx, wy, wz, cx, cy, cz = w[0], w[1], w[2], w_change[0], w_change[1], w_change[2]
    for i in range(6):
        total = phi[i, 0] * x + phi[i, 1] * y + phi[i, 2] * z
        total = total + phi[i, 3] * vx + phi[i, 4] * vy + phi[i, 5] * vz
        total = total + phi[i, 6] * dx + phi[i, 7] * dy + phi[i, 8] * dz
        total = total + gamma[i, 0] * wx + gamma[i, 1] * wy + gamma[i, 2] * wz
        out[i] = total + lag[i, 0] * cx + lag[i, 1] * cy + lag[i, 2] * cz
    for i in range(6, 9):
        out[i] = s[i]


_FAR_M = 1e-6


@kernel
def goes_far(estimator: np.void, s: Array, after: Array) -> bool:
    """Whether from a state (9,) to the one a period later the way, or what it differs by from the first half to the
    second, is so long that the input in mid-period no longer stands for all of it: at 10 um that errs by 80 nm. Up to
    some nm the feed-forward errs alike, and the disturbance makes up for both.
    """
    half_s, far = estimator["half_period_s"], False
    for i in range(3):
        far = far or abs(after[i] - s[i]) > _FAR_M or abs(half_s * (after[3 + i] - s[3 + i])) > _FAR_M
    return far


@kernel
@rare
def predict_far(
    geometry: np.void,
    elasticity: np.void,
    estimator: np.void,
    s: Array,
    force_n: Array,
    force_old_n: Array,
    apart_n: Array,
    apart_old_n: Array,
    told_n: Array,
    scratch: np.void,
    out: Array,
) -> None:
    """``predict`` by Simpson's rule, over ``out`` (9,), which it had written: w at the start, in the middle of the
    cubic that joins both states, and at the end. Input that comes early in a period moves the stage further: of
    the change of w, Gamma / 6 goes from the position, and half of what that would have done meanwhile to the velocity.
    ``scratch``: a record of ``FAR``.
    """
    phi, gamma = estimator["transition"], estimator["input"]
    origin, bend_s = estimator["operating_point_m"], 0.25 * estimator["half_period_s"]
    start, middle, end, unused = scratch["start_m"], scratch["middle_m"], scratch["end_m"], scratch["unused_n"]
    w, w_middle, w_end, w_change = scratch["w_n"], scratch["w_middle_n"], scratch["w_end_n"], scratch["w_change_n"]
    for i in range(3):
        start[i], end[i] = origin[i] + s[i], origin[i] + out[i]
        middle[i] = 0.5 * (start[i] + end[i]) + bend_s * (s[3 + i] - out[3 + i])
    net_input(geometry, elasticity, estimator, start, force_n, force_old_n, apart_n, apart_old_n, told_n, w, w_change)
    net_input(
        geometry, elasticity, estimator, middle, force_n, force_old_n, apart_n, apart_old_n, told_n, w_middle, unused
    )
    net_input(geometry, elasticity, estimator, end, force_n, force_old_n, apart_n, apart_old_n, told_n, w_end, unused)
    for i in range(3):
        change = w_end[i] - w[i]
        w[i] = (w[i] + 4.0 * w_middle[i] + w_end[i]) / 6.0
        w_end[i] = change
    predict(estimator, s, w, w_change, out)
    for i in range(3):
        start[i] = (gamma[i, 0] * w_end[0] + gamma[i, 1] * w_end[1] + gamma[i, 2] * w_end[2]) / 6.0
        out[i] -= start[i]
    for i in range(3, 6):
        out[i] -= 0.5 * (phi[i, 0] * start[0] + phi[i, 1] * start[1] + phi[i, 2] * start[2])
