"""The tick: sense counts in, drive counts out. Composes kinematics, filter, law,
allocation and voltage; PURE and compiled.

Three steps, so that whoever composes them can look between: ``measure`` (counts -> position), ``estimate`` (filter
and its prediction to the instant of action), ``act`` (law -> comb forces -> counts). ``rest`` stands in for ``act``
while the loop is open; ``prepare`` is what the voltages do not wait for. Everything works on two records: ``law``
(numbers that were designed, never written) and ``memory`` (what lives from tick to tick).
"""

import math

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.core import (
    adaptation,
    allocation,
    feedback,
    kinematics,
    linear_law,
    predictive,
    set_point_model,
    voltage,
    youla,
)
from pkxyz_ctrl.core import estimator as filtering
from pkxyz_ctrl.core.demand import COMING, LINEAR, OPEN_LOOP, PREDICTIVE, ask, foresee_errors
from pkxyz_ctrl.core.elasticity import ELASTICITY
from pkxyz_ctrl.core.linear3 import multiply3_transposed

Array = NDArray[np.float64]

SENSE = np.dtype(
    [
        ("farad_per_count", "f8"),
        ("offset_f", "f8"),  # capacitance of count 0
        ("rest_f", "f8"),  # nominal capacitance at rest
        ("metre_per_farad", "f8", (3,)),  # of each chain
    ],
    align=True,
)

LAW = np.dtype(
    [
        ("geometry", kinematics.GEOMETRY),
        ("elasticity", ELASTICITY),
        ("sense", SENSE),
        ("estimator", filtering.ESTIMATOR),
        ("feedback", feedback.FEEDBACK),
        ("set_points", set_point_model.SET_POINTS),
        ("drive", voltage.DRIVE),
        ("kind", "i4"),  # OPEN_LOOP, STATE_FEEDBACK, LINEAR or PREDICTIVE
        ("delay_periods", "i4"),  # periods from a sample to the start of the action that it causes: 1 or 2
        ("youla", youla.YOULA),
        ("adaptation", adaptation.ADAPTATION),
        ("linear", linear_law.LINEAR_LAW),
        ("predictive", predictive.PREDICTIVE),
    ],
    align=True,
)
"""What only some laws have stands last, so that a board need not hold it for the others: no kernel looks at ``linear``
unless ``kind`` is LINEAR, nor beyond the rows of ``a`` that the order has.
"""

DELAY_MAX = set_point_model.DELAY_MAX
_BLIND, _SEEN = 1, 2

SCRATCH = np.dtype(
    [
        ("pulls", "f8", (3, 3)),
        ("inverse", "f8", (3, 3)),
        ("state", "f8", (9,)),
        ("row", "f8", (9,)),
        ("next_n", "f8", (3,)),
        ("position_m", "f8", (3,)),
        ("w_n", "f8", (3,)),
        ("w_change_n", "f8", (3,)),
        ("acting_n", "f8", (3,)),
        ("acted_n", "f8", (3,)),
        ("lower_n", "f8", (3,)),
        ("upper_n", "f8", (3,)),
        ("far", filtering.FAR),
        ("allocation", allocation.SCRATCH),
        ("nothing", "f8", (3,)),  # stays 0
    ],
    align=True,
)
"""Room for intermediate results: memory from the heap costs more than a Jacobian, and a board has none. Nothing in it
outlives a tick.
"""

MEMORY = np.dtype(
    [
        ("estimate", filtering.ESTIMATE),
        ("sense_zero_f", "f8", (3,)),  # found by homing: capacitance at rest less its nominal value
        ("sense_f", "f8", (3,)),
        ("stroke_m", "f8", (3,)),
        ("residual_m", "f8", (3,)),  # strokes measured less those of the predicted position
        ("measurement_m", "f8", (3,)),
        ("seen_m", "f8", (3,)),  # the measurement, or the estimate in its place
        ("set_point_model", set_point_model.SET_POINT_MODEL),
        ("plan_n", "f8", (3,)),  # force at the platform that a plan adds to the feed-forward of this tick
        ("plan_known", "i4"),
        ("solver_iterations", "i4"),  # of this tick's plan; 0 without one, negative if it was not used
        ("count", "i4", (DELAY_MAX + 1, 3)),  # counts commanded, newest first
        ("carry_v", "f8", (3,)),
        ("error_v", "f8", (2, 3)),  # of the voltages of the last two ticks, by rounding
        ("demand_n", "f8", (3,)),
        ("slack_n", "f8", (3,)),
        ("force_n", "f8", (3,)),
        ("feedforward_n", "f8", (3,)),  # of the last tick, if the loop was closed then
        ("held_n", "f8", (3,)),  # the same with what makes up for its being held
        ("coming", COMING),
        ("feedforward_known", "i4"),
        ("active_set_steps", "i4"),
        ("to_learn", "i4"),  # of this tick, by ``prepare``: 0 nothing, _BLIND without a measurement, _SEEN with one
        ("to_follow", "i4"),  # 1: the model of the set-points is not where this tick's forces lead it
        ("landing", "i4"),  # 1: the stage is led down; instead of the feedback acts ...
        ("landing_share", "f8"),  # ... so much of its last force
        ("scratch", SCRATCH),
        ("linear", linear_law.LINEAR_STATE),  # large: before what every tick looks at, it would put that out of reach
        ("youla", youla.YOULA_STATE),  # last but one: without taps nobody looks at its ring
        ("adaptation", adaptation.ADAPTATION_STATE),  # last: without adaptation nobody looks at it
    ],
    align=True,
)


@kernel
def measure(law: np.void, memory: np.void, sense_count: NDArray[np.int32]) -> None:
    """Sense counts (3,) -> capacitances -> strokes -> ``measurement_m``, by one Newton step from the predicted
    position; ``residual_m`` is how far the strokes are from those expected there.
    """
    sense = law["sense"]
    capacitance, stroke, position = memory["sense_f"], memory["stroke_m"], memory["measurement_m"]
    predicted, origin = memory["estimate"]["predicted"], law["estimator"]["operating_point_m"]
    residual, metre_per_farad = memory["residual_m"], sense["metre_per_farad"]
    for i in range(3):
        capacitance[i] = sense["offset_f"] + sense["farad_per_count"] * sense_count[i] - memory["sense_zero_f"][i]
        stroke[i] = (capacitance[i] - sense["rest_f"]) * metre_per_farad[i]
        position[i] = origin[i] + predicted[i]
    kinematics.newton_step(law["geometry"], stroke, position, residual)


@kernel
def estimate(law: np.void, memory: np.void, has_measurement: bool) -> None:
    """Filter the measurement, then predict to the next sample and on to when this tick's force begins to act."""
    estimator, state, drive, scratch = law["estimator"], memory["estimate"], law["drive"], memory["scratch"]
    learnt, delay, online = memory["adaptation"], law["delay_periods"], law["adaptation"]["on"] != 0
    origin, seen = estimator["operating_point_m"], memory["seen_m"]
    for i in range(3):
        seen[i] = memory["measurement_m"][i]
    if online:
        adaptation.seen(law["adaptation"], learnt, memory["measurement_m"], delay, seen)
    filtering.update(estimator, state, seen, has_measurement)
    youla.note(law["youla"], memory["youla"], state["innovation_m"])
    if online:
        memory["to_learn"] = _SEEN if has_measurement else _BLIND
    position, w, w_change = scratch["position_m"], scratch["w_n"], scratch["w_change_n"]
    acting, acted, start = scratch["acting_n"], scratch["acted_n"], state["filtered"]
    ahead, none = state["ahead"], scratch["nothing"]
    told = learnt["told_n"] if online else none
    for i in range(3):
        seen[i] = seen[i] if has_measurement else origin[i] + start[i]
    for step in range(delay):
        age = delay - 1 - step
        voltage.forces_of_counts(drive, memory["count"][age], acting)
        voltage.forces_of_counts(drive, memory["count"][age + 1], acted)
        filtering.midway(estimator, start, position)
        if online:
            adaptation.tell(learnt, age)
        filtering.net_input(
            law["geometry"], law["elasticity"], estimator, position, acting, acted, none, none, told, w, w_change
        )
        filtering.predict(estimator, start, w, w_change, ahead)
        if filtering.goes_far(estimator, start, ahead):
            far, geometry, elasticity = scratch["far"], law["geometry"], law["elasticity"]
            filtering.predict_far(geometry, elasticity, estimator, start, acting, acted, none, none, told, far, ahead)
        if step == 0:
            for i in range(
                9
            ):  # an assignment of whole arrays costs ten times as much: numba looks whether they overlap
                state["predicted"][i] = ahead[i]
        if step + 1 < delay:
            start = scratch["state"]
            for i in range(9):
                start[i] = ahead[i]


@kernel
def act(law: np.void, memory: np.void, now: Array, after: Array, later: Array) -> bool:
    """Law, allocation and voltages for the reference rows (9,) at the start and the end of the interval of action, and
    a period after that.

    Writes demand, comb forces, slack and the new counts. Returns whether a comb force met a limit.
    """
    share, kind = ask(law, memory, now, after, later), law["kind"]
    drive, scratch, demand = law["drive"], memory["scratch"], memory["demand_n"]
    j, inverse, applied = scratch["pulls"], scratch["inverse"], scratch["w_n"]
    force, count = memory["force_n"], memory["count"]
    _push(memory)
    voltage.force_limits(drive, count[1], scratch["lower_n"], scratch["upper_n"])
    lower, upper = scratch["lower_n"], scratch["upper_n"]
    memory["active_set_steps"] = allocation.allocate(j, inverse, demand, lower, upper, force, scratch["allocation"])
    voltage.counts_for_forces(drive, force, count[1], memory["carry_v"], count[0])
    voltage.shape(drive, feedback.stands_still(now, later), memory["carry_v"], memory["error_v"])
    multiply3_transposed(j, force, applied)
    for i in range(3):
        memory["slack_n"][i] = demand[i] - applied[i]
    if law["adaptation"]["on"] != 0 and (memory["active_set_steps"] > 1 or memory["landing"] != 0):
        adaptation.disturb(memory["adaptation"])
    memory["to_follow"] = 1 if kind != PREDICTIVE else 0
    if kind == LINEAR:
        linear_law.advance(law["linear"], memory["linear"], share)
    return memory["active_set_steps"] > 1


@kernel
def prepare(law: np.void, memory: np.void) -> None:
    """What the next tick begins with: to be called between two ticks, when the voltages are on their way."""
    if memory["to_learn"] != 0:
        estimator, state = law["estimator"], memory["estimate"]
        adaptation.learn(
            law["adaptation"], memory["adaptation"], law["delay_periods"], estimator["operating_point_m"],
            state["innovation_m"], state["filtered"], state["predicted"], memory["to_learn"] == _SEEN,
        )  # fmt: skip
        adaptation.move_on(memory["adaptation"], law["delay_periods"])
        if memory["set_point_model"]["foreseen"] != 0:
            foresee_errors(law, memory)
        memory["to_learn"] = 0
    if memory["to_follow"] != 0:
        _follow(law, memory)
        memory["to_follow"] = 0


@kernel
def _follow(law: np.void, memory: np.void) -> None:
    """Tell the model of the set-points which forces are applied: those of the counts, so that no feedback takes their
    rounding for a disturbance. Open loop stays what it is, the yardstick of all feedback: nobody makes up for it there.
    """
    scratch, model, acting = memory["scratch"], memory["set_point_model"], memory["force_n"]
    if law["kind"] != OPEN_LOOP:
        acting = scratch["acting_n"]
        voltage.forces_of_counts(law["drive"], memory["count"][0], acting)
    geometry, elasticity, estimator = law["geometry"], law["elasticity"], law["estimator"]
    set_point_model.follow(geometry, elasticity, estimator, model, law["delay_periods"], acting, scratch)


@kernel
def rest(law: np.void, memory: np.void) -> None:
    """The open loop: 0 V on every comb at once, no demand. A release to 0 V is never delayed by the slew limit."""
    _push(memory)
    release(law, memory)


@kernel
def release(law: np.void, memory: np.void) -> None:
    """Take back what this tick decided: 0 V goes out instead."""
    for i in range(3):
        memory["count"][0, i] = 0
        memory["carry_v"][i] = 0.0
        memory["error_v"][0, i] = 0.0
        memory["error_v"][1, i] = 0.0
        memory["demand_n"][i] = 0.0
        memory["slack_n"][i] = 0.0
        memory["force_n"][i] = 0.0
    memory["active_set_steps"] = 0
    memory["feedforward_known"] = 0
    memory["landing"] = 0
    memory["to_follow"] = 0
    linear_law.clear(memory["linear"])
    if law["youla"]["taps"] > 0:
        youla.clear(memory["youla"])
    if law["adaptation"]["on"] != 0:
        adaptation.clear(memory["adaptation"], law["delay_periods"])
    set_point_model.set_out(law["estimator"], memory["set_point_model"], memory["scratch"]["nothing"])


@kernel
def _push(memory: np.void) -> None:
    """Make room for this tick's counts: the history moves on by one."""
    count = memory["count"]
    for age in range(DELAY_MAX, 0, -1):
        for i in range(3):
            count[age, i] = count[age - 1, i]


@kernel
def set_position(law: np.void, memory: np.void, position_m: Array) -> None:
    """Start filter and model at a position (3,) at rest, without disturbance: after homing, and wherever a state is
    known.
    """
    set_point_model.set_out(law["estimator"], memory["set_point_model"], position_m)
    for i in range(9):
        known = position_m[i] - law["estimator"]["operating_point_m"][i] if i < 3 else 0.0
        memory["estimate"]["predicted"][i] = known
        memory["estimate"]["filtered"][i] = known
        memory["estimate"]["ahead"][i] = known
    for i in range(3):
        memory["estimate"]["innovation_m"][i] = 0.0
    if law["adaptation"]["on"] != 0:
        adaptation.clear(memory["adaptation"], law["delay_periods"])


@kernel
def set_at_rest(law: np.void, memory: np.void) -> None:
    """``set_position`` where the stage is without forces."""
    position = memory["scratch"]["position_m"]
    for i in range(3):
        position[i] = 0.0
    set_position(law, memory, position)


@kernel
def is_discharged(memory: np.void) -> bool:
    """Whether the voltages of this tick are 0 V on every comb."""
    count = memory["count"]
    return bool(count[0, 0] == 0 and count[0, 1] == 0 and count[0, 2] == 0)


@kernel
def unexplained_force(law: np.void, memory: np.void, out_n: Array) -> None:
    """Comb forces (3,) that would explain what was seen: B^-T (d + K_0 e), with ``pulls`` of the last
    ``act``; d is the estimated disturbance, which takes its time, and K_0 e what holds the stage
    where it is instead of where it was expected.

    A comb that does not give the force of its voltage shows up in its own entry alone. What was learnt of the device
    explains at most what there is to explain.
    """
    inverse, disturbance = memory["scratch"]["inverse"], memory["estimate"]["filtered"]
    innovation, stiffness = memory["estimate"]["innovation_m"], law["estimator"]["stiffness_n_per_m"]
    x, y, z = innovation[0], innovation[1], innovation[2]
    if law["estimator"]["decoupled"] != 0:
        held_x, held_y, held_z = stiffness[0, 0] * x, stiffness[1, 1] * y, stiffness[2, 2] * z
    else:
        held_x = stiffness[0, 0] * x + stiffness[0, 1] * y + stiffness[0, 2] * z
        held_y = stiffness[1, 0] * x + stiffness[1, 1] * y + stiffness[1, 2] * z
        held_z = stiffness[2, 0] * x + stiffness[2, 1] * y + stiffness[2, 2] * z
    wx, wy, wz = disturbance[6] + held_x, disturbance[7] + held_y, disturbance[8] + held_z
    for i in range(3):
        out_n[i] = inverse[0, i] * wx + inverse[1, i] * wy + inverse[2, i] * wz
    if law["adaptation"]["on"] != 0:
        _discount(memory["adaptation"]["told_n"], inverse, out_n)


@kernel
def _discount(told_n: Array, inverse: Array, lack_n: Array) -> None:
    """Of what each comb (3,) lacks beyond what was learnt, leave what it would lack without that, too.

    So nothing that was learnt can look like a fault by itself. What breaks suddenly shows in both.
    """
    for i in range(3):
        known = 0.0
        for k in range(3):
            known += inverse[k, i] * told_n[k]
        whole = lack_n[i] + known
        if lack_n[i] > 0.0:
            lack_n[i] = min(lack_n[i], max(whole, 0.0))
        else:
            lack_n[i] = max(lack_n[i], min(whole, 0.0))


@kernel
def commanded_force(law: np.void, memory: np.void, out_n: Array) -> None:
    """Comb forces (3,) by the voltages that act from this sample on, at the end of a tick."""
    voltage.forces_of_counts(law["drive"], memory["count"][law["delay_periods"]], out_n)


@kernel
def is_finite(memory: np.void) -> bool:
    """Whether the estimate and the forces of this tick are numbers."""
    total = 0.0
    for i in range(9):
        total += memory["estimate"]["ahead"][i]
    for i in range(3):
        total += memory["force_n"][i] + memory["demand_n"][i]
    return math.isfinite(total)
