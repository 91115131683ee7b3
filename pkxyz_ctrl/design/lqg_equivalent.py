"""State feedback, with a Youla filter or without, and the predictive law far from its limits, as a linear law from
measured position to force: what filter and regulator amount to.

The tick's filter knows the forces that it asked for, so they are states too: x = [s(9), w(k-1), w(k-2), ...]. Its net
input is taken at the estimate's own mid-period position, so where the stage's gradient is not that of the design point
the difference M (x + T/2 v) is part of the prediction.
"""

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.core.demand import PREDICTIVE
from pkxyz_ctrl.design.model.discrete_law import DiscreteLaw, TappedLaw
from pkxyz_ctrl.design.model.loop_plant import NOMINAL, Perturbation, held_force_softening
from pkxyz_ctrl.stage import Stage

Array = NDArray[np.float64]


def lqg_equivalent(
    stage: Stage, law: NDArray[np.void], strokes_m: Array, perturbation: Perturbation = NOMINAL
) -> DiscreteLaw:
    """The linear law that ``law``, the (1,) array of ``design_law``, is about the position of ``strokes_m`` (3,), far
    from every limit and without quantisation.

    The predictive law, as long as its plans meet no limit, is the regulator without what the stage adds to the design
    point's stiffness: it knows that in advance.

    The stage is the controller's belief. The perturbation of the real one only matters through the forces that the
    controller thinks it holds the point with.
    """
    parts = lqg_in_parts(stage, law, strokes_m, perturbation)
    return parts.whole() if isinstance(parts, TappedLaw) else parts


def lqg_in_parts(
    stage: Stage, law: NDArray[np.void], strokes_m: Array, perturbation: Perturbation = NOMINAL
) -> DiscreteLaw | TappedLaw:
    """The same; a Youla filter, where there is one, stays beside the rest."""
    numbers = law["tick"][0]
    filter_, feedback, delay = numbers["estimator"], numbers["feedback"], int(numbers["delay_periods"])
    position = stage.forward_kinematics(np.asarray(strokes_m, dtype=np.float64))
    holding = stage.holding_forces(position)
    believed = holding * (1.0 + perturbation.stiffness) / (1.0 + np.array(perturbation.comb_gain))
    softening = held_force_softening(stage, position, believed)
    softening = softening - (stage.stiffness(position) - filter_["stiffness_n_per_m"])
    share = float(np.clip(holding.min() / feedback["authority_force_n"], 0.0, 1.0))
    gains = np.hstack([feedback["position_gain_n_per_m"], feedback["velocity_gain_n_s_per_m"], np.eye(3)])
    if numbers["kind"] == PREDICTIVE:
        gains[:, :6] += softening @ _midway(filter_, gains[:, :6])
    gains *= share
    regulator = None if numbers["kind"] == PREDICTIVE else set_point_gain(numbers)
    equivalent = _assemble(filter_, softening, gains, delay, float(law["period_us"][0]) * 1e-6, regulator)
    taps = numbers["youla"]["tap_n_per_m"][: int(numbers["youla"]["taps"])]
    if not len(taps):
        return equivalent
    late = np.zeros((3, equivalent.order - 9))
    return TappedLaw(equivalent, np.hstack([seen_by(filter_), late]), share * taps)


def set_point_gain(numbers: np.void) -> Array:
    """(3,6) of position and velocity: K_s."""
    set_points = numbers["set_points"]
    return np.hstack([set_points["position_gain_n_per_m"], set_points["velocity_gain_n_s_per_m"]])


def _midway(filter_: np.void, gains: Array) -> Array:
    """(3,6): deviation in the middle of a period by that at its start, where the regulator's ``gains`` (3,6) act."""
    closed, bend_s = filter_["transition"][:, :6] - filter_["input"] @ gains, 0.25 * filter_["half_period_s"]
    return np.hstack([0.5 * np.eye(3), bend_s * np.eye(3)]) + 0.5 * closed[:3] - bend_s * closed[3:]


def _assemble(
    filter_: np.void, softening: Array, gains: Array, delay: int, period_s: float, regulator: Array | None
) -> DiscreteLaw:
    phi = np.vstack([filter_["transition"], np.eye(9)[6:]])
    gamma, lag = (np.vstack([filter_[name], np.zeros((3, 3))]) for name in ("input", "input_lag"))
    phi = phi + gamma @ softening @ np.hstack([np.eye(3), filter_["half_period_s"] * np.eye(3), np.zeros((3, 3))])
    order = 9 + 3 * (delay + 1)
    # rows over [x, y]: what the filter's state is after each step, as a function of the law's state and measurement
    ahead = np.zeros((9, order + 3))
    ahead[:, :9] = np.eye(9) - filter_["gain"] @ seen_by(filter_)
    ahead[:, order:] = filter_["gain"]
    predicted = ahead
    for step in range(delay):
        age = delay - 1 - step  # of the force that acts in this period; the one before it is still fading
        ahead = phi @ ahead
        ahead[:, 9 + 3 * age : 12 + 3 * age] += gamma - lag
        ahead[:, 12 + 3 * age : 15 + 3 * age] += lag
        if step == 0:
            predicted = ahead
    force = -gains @ ahead
    after = np.zeros((order, order + 3))
    after[:9] = predicted
    after[9:12] = force
    after[12:order, 9 : order - 3] = np.eye(order - 12)
    a, b, c, d = after[:, :order], after[:, order:], -force[:, :order], -force[:, order:]
    return DiscreteLaw(period_s, a, b, c, d, told_from=9, set_point_gain=regulator)


def seen_by(filter_: np.void) -> Array:
    """H (3,9): what a sample shows of the filter's state, x - tau v."""
    return np.hstack([np.eye(3), -filter_["sense_delay_s"] * np.eye(3), np.zeros((3, 3))])
