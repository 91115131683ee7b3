"""The model's answer to the set-points: what the stage would do if nothing but the controller's own forces moved it.

    s+ = Phi s + Gamma w + Gamma_lag (w_old - w),   w = J^T F - f - grad V + K_0 (x - x_0),   demand += f - K_s (s - r)

The filter's model, driven by the comb forces F that were really applied (limits, slew, quantisation and all) less f,
the feedback's part of them. A regulator K_s leads it to the reference, and the stage gets the same force. A feedback
that looks at what the stage does otherwise than this model sees what it is there for, and nothing of set-points, jumps
and limits: how the stage answers to these is K_s's, whatever the feedback is, and the loop's transfer is the feedback's
alone (two degrees of freedom). Nothing in it is measured, so it can't make a loop unstable.

Where the reference jumps, r goes there at a speed that the voltages can follow: a regulator that met their slew limit
would brake too late.
"""

import math

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.core import estimator as filtering
from pkxyz_ctrl.core.feedback import jump

Array = NDArray[np.float64]

DELAY_MAX = 2
_ROUNDING_M = 1e-12

SET_POINTS = np.dtype(
    [
        ("position_gain_n_per_m", "f8", (3, 3)),  # K_s, as of the feedback
        ("velocity_gain_n_s_per_m", "f8", (3, 3)),
        ("jump_step_m", "f8"),  # most that the reference jumps in a tick
        ("decoupled", "i4"),  # 1: K_s is diagonal
    ],
    align=True,
)

SET_POINT_MODEL = np.dtype(
    [
        ("state", "f8", (9,)),  # as the filter's, without disturbance, where the force of this tick begins to act
        ("sample_m", "f8", (DELAY_MAX + 1, 3)),  # what the sample of this tick, and those after it, would show
        ("fed_back_n", "f8", (3,)),  # what feedback and adaptation have of this tick's force at the platform
        ("fed_back_old_n", "f8", (3,)),  # and of the last one's
        ("feedback_n", "f8", (3,)),  # of the last tick in which the feedback was alive, without adaptation
        ("applied_n", "f8", (3,)),  # comb forces of the last tick
        ("short_m", "f8", (3,)),  # where is aimed less where the reference has jumped to
        ("short_later_m", "f8", (3,)),  # a period later
        ("aim", "f8", (3, 9)),  # rows to be led along: at both ends of the interval of action, and a period after that
        ("expected", "f8", (2, 9)),  # rows of the reference that the next tick begins with, if nothing else is wanted
        ("foreseen", "i4"),  # 1: ``aim`` and ``expected`` are those of the last tick
    ],
    align=True,
)


@kernel
def set_out(estimator: np.void, model: np.void, position_m: Array) -> None:
    """Begin at a position (3,), at rest."""
    for i in range(9):
        model["state"][i] = position_m[i] - estimator["operating_point_m"][i] if i < 3 else 0.0
    for i in range(3):
        model["fed_back_n"][i] = 0.0
        model["fed_back_old_n"][i] = 0.0
        model["feedback_n"][i] = 0.0
        model["applied_n"][i] = 0.0
        model["short_m"][i] = 0.0
    model["foreseen"] = 0
    for i in range(3):
        for age in range(DELAY_MAX + 1):
            model["sample_m"][age, i] = position_m[i]


@kernel
def approach(set_points: np.void, model: np.void, period_s: float, now: Array, after: Array, later: Array) -> bool:
    """Write the rows ``aim`` to be led along: the reference at the start and the end of the interval of action and a
    period after that, less what is still missing of its jumps. Returns whether the reference went on as it was
    foreseen: then the first two rows are those that came after the first in the last tick.
    """
    short, following, aim, expected = model["short_m"], model["short_later_m"], model["aim"], model["expected"]
    goes_on = model["foreseen"] != 0
    for i in range(9):
        goes_on = goes_on and now[i] == expected[0, i] and after[i] == expected[1, i]
    if goes_on:
        for i in range(9):
            aim[0, i], aim[1, i] = aim[1, i], aim[2, i]
        for i in range(3):
            short[i] = following[i]
    else:
        for i in range(9):
            aim[0, i], aim[1, i] = now[i], after[i]
        for i in range(3):
            aim[0, i] += short[i]
        _step(set_points, short, period_s, now, after, short)
        for i in range(3):
            aim[1, i] += short[i]
    for i in range(9):
        aim[2, i], expected[0, i], expected[1, i] = later[i], after[i], later[i]
    _step(set_points, short, period_s, after, later, following)
    for i in range(3):
        aim[2, i] += following[i]
    model["foreseen"] = 1
    return bool(goes_on)


@kernel
def _step(set_points: np.void, short: Array, period_s: float, now: Array, after: Array, out: Array) -> None:
    """Of the way that is missing, with a jump between two rows added to it, a tick's share is made: write the rest."""
    x, y = short[0] - jump(period_s, now, after, 0), short[1] - jump(period_s, now, after, 1)
    z, most = short[2] - jump(period_s, now, after, 2), set_points["jump_step_m"]
    square, left = x * x + y * y + z * z, 0.0
    if square > most * most:
        left = 1.0 - most / math.sqrt(square)
    out[0], out[1], out[2] = left * x, left * y, left * z


@kernel
def is_astray(model: np.void, origin_m: Array, row: Array) -> bool:
    """Whether the model is elsewhere than the row (9,) by more than rounding. At rest, where combs can't push, the rest
    of a sum would be a force that they lack.
    """
    near = True
    for i in range(3):
        near = near and abs(origin_m[i] + model["state"][i] - row[i]) <= _ROUNDING_M
    return not near


@kernel
def follow(
    geometry: np.void,
    elasticity: np.void,
    estimator: np.void,
    model: np.void,
    delay_periods: int,
    force_n: Array,
    scratch: np.void,
) -> None:
    """Time update over the period in which this tick's comb forces (3,) act, after those of the last tick. What the
    feedback had its part in them stands in ``fed_back_n``.
    """
    state, sample, applied = model["state"], model["sample_m"], model["applied_n"]
    fed_back, before = model["fed_back_n"], model["fed_back_old_n"]
    position, w, w_change, start = scratch["position_m"], scratch["w_n"], scratch["w_change_n"], scratch["state"]
    filtering.midway(estimator, state, position)
    nothing = scratch["nothing"]
    filtering.net_input(
        geometry, elasticity, estimator, position, force_n, applied, fed_back, before, nothing, w, w_change
    )
    for i in range(9):
        start[i] = state[i]
    filtering.predict(estimator, start, w, w_change, state)
    if filtering.goes_far(estimator, start, state):
        filtering.predict_far(
            geometry, elasticity, estimator, start, force_n, applied, fed_back, before, nothing, scratch["far"], state,
        )  # fmt: skip
    tau, origin = estimator["sense_delay_s"], estimator["operating_point_m"]
    for age in range(DELAY_MAX):
        for i in range(3):
            sample[age, i] = sample[age + 1, i]
    for i in range(3):
        before[i], applied[i] = fed_back[i], force_n[i]
        sample[delay_periods, i] = origin[i] + state[i] - tau * state[3 + i]
