"""The force that the law asks for: feed-forward along the reference plus state feedback about it, compiled.

    w = grad V(r_f) + C v_f + m a_f  -  g [ h + K_x (x - r) + K_v (v - r') + d ]

r, r' are the reference (as ``sampled_target`` sees it) at the instant the force begins to act (one period after the
sample), x, v, d the estimate predicted for it; r_f, v_f, a_f are the reference at the middle of the interval in which
it acts, as the amplifier lets it act; h makes up for its being held. Combs only pull, so at rest there is no force to
take away: the feedback's authority g rises from 0 to 1 with the least of the forces that hold r.
"""

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel

Array = NDArray[np.float64]

FEEDBACK = np.dtype(
    [
        ("position_gain_n_per_m", "f8", (3, 3)),  # K_x
        ("velocity_gain_n_s_per_m", "f8", (3, 3)),  # K_v
        ("damping_n_s_per_m", "f8", (3, 3)),  # C
        ("mass_kg", "f8"),
        ("period_s", "f8"),
        ("ripple_s_per_kg", "f8"),  # what a sampled velocity lacks for each newton that a held force grows by in a tick
        ("lead_s", "f8"),  # from the start of the interval to its effective middle: T/2 + amplifier time constant
        ("decoupled", "i4"),  # 1: K_x, K_v and C are diagonal
        ("ripple_of_held", "i4"),  # 1: the ripple is that of the feed-forward as it is held, 0: of the smooth one
        ("authority_force_n", "f8"),  # least holding force from which the feedback has its full gain
    ],
    align=True,
)


_JUMP_M = 1e-9


@kernel
def jump(period_s: float, now: Array, after: Array, i: int) -> float:
    """How far the reference jumps along axis ``i`` between two rows (9,) a period apart: 0.0 if it moves there."""
    v, a = period_s * now[3 + i], period_s * period_s * now[6 + i]
    way = after[i] - now[i] - v - 0.5 * a
    speed, bend = period_s * after[3 + i] - v - a, period_s * period_s * after[6 + i] - a
    return 0.0 if abs(way) <= abs(speed) + abs(bend) + _JUMP_M else way


@kernel
def stands_still(here: Array, later: Array) -> bool:
    """Whether the reference does, by two of its rows (9,)."""
    still = True
    for i in range(3):
        still = still and here[i] == later[i] and here[3 + i] == 0.0 and later[3 + i] == 0.0
    return still


@kernel
def ahead(feedback: np.void, now: Array, after: Array, out: Array) -> None:
    """Reference row (9,) at ``lead_s`` past the row ``now``, on the quintic that joins it
    to the row ``after``, one period later.

    A row is position m, velocity m/s, acceleration m/s^2. Of a sine of 4 samples a period the quintic's acceleration in
    mid-interval is right to 0.4 %, where one between the two accelerations would be 30 % too small. Where the position
    jumps, which no motion explains, the jerk is taken as constant.
    """
    period = feedback["period_s"]
    rate = 1.0 / period
    s = feedback["lead_s"] * rate
    for i in range(3):
        v, a = period * now[3 + i], period * period * now[6 + i]
        way = after[i] - now[i] - v - 0.5 * a  # what third and higher orders make of position, velocity, acceleration
        speed = period * after[3 + i] - v - a
        bend = period * period * after[6 + i] - a
        cubic, quartic, quintic = (1 / 6) * bend, 0.0, 0.0
        if abs(way) <= abs(speed) + abs(bend) + _JUMP_M:
            cubic = 10.0 * way - 4.0 * speed + 0.5 * bend
            quartic = -15.0 * way + 7.0 * speed - bend
            quintic = 6.0 * way - 3.0 * speed + 0.5 * bend
        out[i] = now[i] + s * (v + s * (0.5 * a + s * (cubic + s * (quartic + s * quintic))))
        out[3 + i] = (v + s * (a + s * (3.0 * cubic + s * (4.0 * quartic + s * 5.0 * quintic)))) * rate
        out[6 + i] = (a + s * (6.0 * cubic + s * (12.0 * quartic + s * 20.0 * quintic))) * (rate * rate)


@kernel
def add_motion(feedback: np.void, row: Array, out: Array) -> None:
    """Add damping and inertia of a reference row (9,) to the force ``out`` (3,): C v + m a."""
    damping, mass = feedback["damping_n_s_per_m"], feedback["mass_kg"]
    vx, vy, vz = row[3], row[4], row[5]
    if feedback["decoupled"] != 0:
        for i in range(3):
            out[i] += mass * row[6 + i] + damping[i, i] * row[3 + i]
        return
    for i in range(3):
        out[i] += mass * row[6 + i] + (damping[i, 0] * vx + damping[i, 1] * vy + damping[i, 2] * vz)


@kernel
def add_held_share(feedforward_n: Array, last_n: Array, next_n: Array, share: float, out: Array) -> None:
    """Subtract share times h = (next - 2 present + last) / 24 from ``out`` (3,): feed-forward forces at mid-interval.

    Held for a period T, a sinusoidal force at angular frequency w moves a mass less than the smooth one by 1 + (w T)^2
    / 24 at the samples; the second difference gives that back, without phase, up to terms of fourth order.
    """
    part = share / 24.0
    for i in range(3):
        out[i] -= part * (next_n[i] - 2.0 * feedforward_n[i] + last_n[i])


@kernel
def sampled_target(feedback: np.void, now: Array, feedforward_n: Array, feedforward_last_n: Array, out: Array) -> None:
    """The row (9,) that the sampled state has to meet: ``now``, with the velocity
    that held forces really give at a sample.

    A force that is held for a period T in place of one that grows by f' in the time makes the velocity ripple about
    its mean; at the samples the ripple is -f' T^2 / (12 m), which at 631 Hz and 5 kHz is 5 % of the velocity. Without
    this term the feedback takes the ripple for an error and pushes the stage ahead of its reference. Behind an
    amplifier of time constant tau the steps are rounded, and the ripple is 1 - 6 tau / T of that, or so.
    """
    share = feedback["ripple_s_per_kg"]
    for i in range(3):
        out[i] = now[i]
        out[3 + i] = now[3 + i] - share * (feedforward_n[i] - feedforward_last_n[i])
        out[6 + i] = now[6 + i]


@kernel
def authority(feedback: np.void, inverse: Array, holding_n: Array) -> float:
    """g in 0..1 from the least comb force of J^-T ``holding_n``; ``inverse`` is J^-1 at the set-point."""
    least, per_newton = np.inf, 1.0 / feedback["authority_force_n"]
    for i in range(3):
        least = min(least, inverse[0, i] * holding_n[0] + inverse[1, i] * holding_n[1] + inverse[2, i] * holding_n[2])
    return min(max(least * per_newton, 0.0), 1.0)


@kernel
def add_feedback(
    feedback: np.void, origin_m: Array, predicted: Array, reference: Array, share: float, out: Array
) -> None:
    """Subtract share times the feedback force from ``out`` (3,); ``predicted`` (9,) is about ``origin_m``,
    ``reference`` a row (9,).
    """
    kx, kv = feedback["position_gain_n_per_m"], feedback["velocity_gain_n_s_per_m"]
    if feedback["decoupled"] != 0:
        for i in range(3):
            off_m, off_m_per_s = origin_m[i] + predicted[i] - reference[i], predicted[3 + i] - reference[3 + i]
            out[i] -= share * (predicted[6 + i] + (kx[i, i] * off_m + kv[i, i] * off_m_per_s))
        return
    x, y, z = (
        origin_m[0] + predicted[0] - reference[0],
        origin_m[1] + predicted[1] - reference[1],
        origin_m[2] + predicted[2] - reference[2],
    )
    vx, vy, vz = predicted[3] - reference[3], predicted[4] - reference[4], predicted[5] - reference[5]
    for i in range(3):
        total = predicted[6 + i] + (kx[i, 0] * x + kv[i, 0] * vx)
        total = total + (kx[i, 1] * y + kv[i, 1] * vy) + (kx[i, 2] * z + kv[i, 2] * vz)
        out[i] -= share * total
