"""The force that is asked for: feed-forward, the model's answer to set-points, and feedback. PURE and compiled."""

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.core import adaptation, feedback, linear_law, set_point_model, youla
from pkxyz_ctrl.core.elasticity import BENT, gradient_and_pulls
from pkxyz_ctrl.core.linear3 import inverse3

Array = NDArray[np.float64]

OPEN_LOOP, STATE_FEEDBACK, LINEAR, PREDICTIVE = 0, 1, 2, 3
"""What feeds back: nothing, the filter's state through gains, a linear law of the user's choice on what was measured,
or a plan that somebody made from the estimate; without one the filter's state as before.

A plan answers to set-points, too. For the others ``set_point_model`` does, and what feeds back sees none of them.
"""

COMING = np.dtype(
    [
        ("row", "f8", (9,)),  # of the reference
        ("bent", BENT),  # there
        ("pulls", "f8", (3, 3)),  # ``kinematics.pulls`` there, and ...
        ("inverse", "f8", (3, 3)),  # ... their inverse
        ("holding_n", "f8", (3,)),  # at the platform, what holds it there, and ...
        ("needed_n", "f8", (3,)),  # ... what moves it along, too
    ],
    align=True,
)
"""Feed-forward in the middle of an interval of action: of the next one, so that it is worked out once for both ticks
that ask for it.
"""


@kernel
def _look_ahead(law: np.void, begin: Array, end: Array, coming: np.void) -> None:
    """Write what the interval between two rows (9,) takes into ``coming``, a record of ``COMING``."""
    row, holding, needed = coming["row"], coming["holding_n"], coming["needed_n"]
    feedback.ahead(law["feedback"], begin, end, row)
    gradient_and_pulls(law["geometry"], law["elasticity"], row[0:3], holding, coming["pulls"], coming["bent"])
    inverse3(coming["pulls"], coming["inverse"])
    for i in range(3):
        needed[i] = holding[i]
    feedback.add_motion(law["feedback"], row, needed)


@kernel
def foresee_errors(law: np.void, memory: np.void) -> None:
    """What the device's errors make of the interval in ``coming``."""
    coming = memory["coming"]
    adaptation.foresee(
        law["adaptation"], memory["adaptation"], law["geometry"], law["feedback"]["damping_n_s_per_m"], coming["row"],
        coming["bent"], coming["inverse"], coming["pulls"], coming["needed_n"],
    )  # fmt: skip


@kernel
def ask(law: np.void, memory: np.void, now: Array, after: Array, later: Array) -> float:
    """Write the demand (3,) at the platform for the reference rows (9,) at the start and the end of the interval of
    action, and a period after that. Returns the feedback's authority. ``law``, ``memory``: the tick's.
    """
    gains, scratch, demand = law["feedback"], memory["scratch"], memory["demand_n"]
    j, inverse, row = scratch["pulls"], scratch["inverse"], scratch["row"]
    following, kind, coming = scratch["next_n"], law["kind"], memory["coming"]
    set_points, model, aim = law["set_points"], memory["set_point_model"], memory["set_point_model"]["aim"]
    is_foreseen = set_point_model.approach(set_points, model, gains["period_s"], now, after, later)
    if not is_foreseen:
        _look_ahead(law, aim[0], aim[1], coming)
    for i in range(3):
        demand[i] = coming["needed_n"][i]
        for k in range(3):
            j[i, k], inverse[i, k] = coming["pulls"][i, k], coming["inverse"][i, k]
    share = feedback.authority(gains, inverse, coming["holding_n"])
    learnt, online = memory["adaptation"], law["adaptation"]["on"] != 0
    if online:
        if not is_foreseen:
            foresee_errors(law, memory)
        adaptation.note(learnt, aim[0])
    _look_ahead(law, aim[1], aim[2], coming)
    last, before = memory["feedforward_n"], scratch["w_n"]
    known = memory["feedforward_known"] != 0
    for i in range(3):
        following[i] = coming["needed_n"][i] if known else demand[i]
        before[i] = last[i] if known else demand[i]
        last[i] = demand[i]
    feedback.sampled_target(gains, aim[0], demand, before, row)
    memory["feedforward_known"] = 1
    feedback.add_held_share(last, before, following, share, demand)
    if online:
        for i in range(3):
            demand[i] += learnt["added_n"][i]
    if gains["ripple_of_held"] != 0:
        held = memory["held_n"]
        for i in range(3):
            before[i] = held[i] if known else demand[i]
            held[i] = demand[i]
        feedback.sampled_target(gains, aim[0], demand, before, row)
    origin = law["estimator"]["operating_point_m"]
    if kind != PREDICTIVE:
        led = 1.0 if set_point_model.is_astray(model, origin, row) else share
        feedback.add_feedback(set_points, origin, model["state"], row, led, demand)
        _feed_back(law, memory, share)
        for i in range(3):
            demand[i] += model["fed_back_n"][i]
            if online:  # the model is as drawn: what the device differs in, and what makes up for it, is not in it
                model["fed_back_n"][i] += learnt["added_n"][i]
    else:
        _follow_plan(law, memory, share)
        for i in range(3):
            demand[i] += model["fed_back_n"][i]
    return float(share)


@kernel
def _follow_plan(law: np.void, memory: np.void, share: float) -> None:
    """As ``_feed_back``, of a law that plans: the plan's force, or without one that of the regulator."""
    model, planned = memory["set_point_model"], memory["set_point_model"]["fed_back_n"]
    if memory["landing"] != 0:
        for i in range(3):
            planned[i] = memory["landing_share"] * model["feedback_n"][i]
        return
    for i in range(3):
        planned[i] = share * memory["plan_n"][i] if memory["plan_known"] != 0 else 0.0
    if memory["plan_known"] == 0:
        origin, ahead, row = (
            law["estimator"]["operating_point_m"],
            memory["estimate"]["ahead"],
            memory["scratch"]["row"],
        )
        feedback.add_feedback(law["feedback"], origin, ahead, row, share, planned)
    for i in range(3):
        model["feedback_n"][i] = planned[i]


@kernel
def _feed_back(law: np.void, memory: np.void, share: float) -> None:
    """Note the force (3,) at the platform by which the feedback answers to what the stage does otherwise than the model
    of the set-points; none in open loop. While the stage is led down it is a share of the last: a device that takes
    more force than the model says takes more all the way, and a law that went astray is out of the loop.
    """
    model, ours, origin = memory["set_point_model"], memory["scratch"]["row"], law["estimator"]["operating_point_m"]
    fed_back = model["fed_back_n"]
    if memory["landing"] != 0:
        for i in range(3):
            fed_back[i] = memory["landing_share"] * model["feedback_n"][i]
        return
    for i in range(3):
        fed_back[i] = 0.0
    if law["kind"] == STATE_FEEDBACK:
        for i in range(3):
            ours[i], ours[3 + i] = origin[i] + model["state"][i], model["state"][3 + i]
        feedback.add_feedback(law["feedback"], origin, memory["estimate"]["ahead"], ours, share, fed_back)
        if law["youla"]["taps"] > 0:
            youla.add_feedback(law["youla"], memory["youla"], share, fed_back)
    elif law["kind"] == LINEAR:
        seen, expected = memory["seen_m"], model["sample_m"][0]
        linear_law.add_feedback(law["linear"], memory["linear"], seen, expected, share, fed_back)
    for i in range(3):
        model["feedback_n"][i] = fed_back[i]
