"""Adaptation: what this device differs in from its model, learnt while the loop works. Compiled.

The model lacks a force at the platform and shows a measurement otherwise, both linear in the errors theta of its
numbers (``PARAMETERS``), each in units of its spread, which is how far devices differ beforehand::

    m x'' + C x' + grad V = B^T F - phi(r) theta,    y = x - tau v + psi(r) theta

phi and psi are taken along the reference r, not along the motion: they are known beforehand, and what is learnt acts as
a feed-forward, outside the feedback loop. So no theta can make that loop unstable.

The Kalman filter is told both. What it still does not expect shows in its innovations nu, which answer to an error of
theta as the filter itself does (Friedland 1969): with U the change of the filter's state for each theta, ::

    d nu = psi - H U,    U+ = U + K d nu,    U(next) = Phi U+ - Gamma phi

Recursive least squares (a Kalman filter of numbers that drift slowly) works on nu with d nu, one axis a tick. Its
covariance never exceeds what was known beforehand. It stands still where the reference does or turns more sharply than
psi describes, where the stage is not where it should be, and after a comb was at a limit. What acts follows within some
milliseconds, and the filter's prediction moves along by U, as if it had always known: nothing kicks, no voltage waits.

Beside it stands what was known once, the base. If one cause alone has changed since (a comb, a chain's springs, the
hinges), one number makes the innovations that the base would leave as small as those that are left: it is a warning.

Where a loop over the parameters shall become vectors, what it needs of another record or row is read before it: a
compiler can't know that what it writes does not change that.
"""

import math

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.kernel import kernel

Array = NDArray[np.float64]

COMB, SLIDER, CRANK, LINK, FRINGE, LIFT, DAMPING, DELAY, BEND = 0, 3, 6, 9, 10, 11, 12, 13, 14
PARAMETERS = 15
"""Relative errors of each comb's pull, of each chain's sliders' and cranks' springs, and of the out-of-plane hinges;
growth of the pull over ``fringe_m`` of stroke; lift by pull; relative error of the damping; sense delay in s, and by
how many s^2 the acceleration shows in what is measured. The mass is taken as drawn: only ratios to it are seen.
"""
ROOM = 16  # of a row of them: whole vectors; the last number says nothing
CAUSES = 7
"""What may change by itself: each comb, the springs of each chain, the out-of-plane hinges."""
LEAST_LOSS = 0.1
"""By how much, in variances of the noise, innovations have to be worse with the base before something has changed."""
_MOST_SPARED = 0.5  # of a comb's pull: one that has become stronger is told as at most twice as strong
_PARAMETERS, _ROOM, _CAUSES = np.int32(PARAMETERS), np.int32(ROOM), np.int32(CAUSES)  # cheaper to count by, of 32 bits
_LANES, _ROWS = np.int32(4), np.int32(5)  # sums of a product; rows of the covariance at a time, to fit into registers
_FLOOR_N = 1e-100  # in each force: else what is at rest falls below the normal numbers, and a PC slows down fivefold
AGES = 3  # intervals that are remembered: two periods of delay, and the one that is decided

ADAPTATION = np.dtype(
    [
        ("transition", "f8", (3, 3, 3)),  # of each axis: the filter's x, v, d
        ("input", "f8", (3, 3)),  # of each axis: what a force does to them in a period
        ("gain", "f8", (3, 3)),  # of each axis: the filter's
        ("sense_delay_s", "f8"),
        ("variance_m2", "f8", (3,)),  # of the innovations, where the model is right
        ("spread", "f8", (ROOM,)),  # how far devices differ, one standard deviation, in units of the parameter
        ("bound", "f8", (ROOM,)),  # most that is learnt, in spreads
        ("start", "f8", (PARAMETERS,)),  # what is known at the beginning, in spreads, and ...
        ("start_covariance", "f8", (PARAMETERS, PARAMETERS)),  # ... how well
        ("doubt", "f8"),  # share of an unexpected innovation's square that counts as noise
        ("drift", "f8"),  # variance, in spreads squared, that an update loses
        ("follow", "f8"),  # share by which what acts follows what is learnt, each tick
        ("least", "f8"),  # an update has to tell so much: variance of its prediction over that of the noise
        ("near_m", "f8"),  # how near the reference the stage has to be
        ("turn_m_per_s2", "f8", (3,)),  # most that its acceleration may change by in a period
        ("fringe_m", "f8"),
        ("forget", "f8"),  # share of what speaks against the base that an update forgets
        ("warn", "f8"),  # least change, relative, and ...
        ("alone", "f8"),  # ... least share of what the base leaves that one cause has to explain
        ("calm_ticks", "i4"),  # for so long, and without a limit
        ("base_updates", "i4"),  # after so many what is known becomes the base
        ("known", "i4"),  # 1: the start is of an earlier run, and changes are counted from there
        ("on", "i4"),
    ],
    align=True,
)

ADAPTATION_STATE = np.dtype(
    [
        ("learnt", "f8", (ROOM,)),  # theta in spreads
        ("acting", "f8", (ROOM,)),  # what feed-forward and filter reckon with
        ("covariance", "f8", (PARAMETERS, ROOM)),  # transposed: symmetric but for rounding
        ("sensitivity", "f8", (3, 3, ROOM)),  # U: axis, then x, v, d of the prediction
        ("shown", "f8", (3, ROOM)),  # d nu
        ("base", "f8", (ROOM,)),
        ("work", "f8", (ROOM,)),
        ("lanes", "f8", (4,)),  # sums that make a product
        ("motion", "f8", (AGES, 9)),  # row of the reference at their beginnings
        ("added_n", "f8", (3,)),  # what the feed-forward of this tick has more
        ("told_n", "f8", (3,)),  # what the filter was told of the last interval that it went through
        ("answer", "f8", (CAUSES,)),  # to each cause: mean square of what it shows, over that of the noise, ...
        ("clue", "f8", (CAUSES,)),  # ... and its product with what the base leaves
        ("left_by_base", "f8"),  # mean square innovation with the base, and ...
        ("left", "f8"),  # ... with what is learnt, over that of the noise
        ("change", "f8"),  # relative, of the cause that is warned of
        ("updates", "i8"),
        ("begun", "i4"),  # 0: nothing is known yet, not even how little
        ("based", "i4"),  # 1: there is a base
        ("axis", "i4"),  # whose turn it is
        ("cause", "i4"),  # 0: no warning; else 1 + a cause
        ("calm", "i4"),  # ticks since something was not as it should be for learning
        ("spare", "f8", (6,)),  # so that the rows that follow begin with a line of a processor's cache, as those before
        ("force_n", "f8", (AGES, 3, ROOM)),  # phi of the last intervals, newest first
    ],
    align=True,
)
"""Last the ages of ``force_n``: a board need not hold those beyond the delay, at which no kernel looks."""


@kernel
def _product(a: Array, b: Array, lanes: Array) -> float:
    """Scalar product of two rows (ROOM,), in four sums: one after the other a processor would wait for each."""
    for q in range(_LANES):
        lanes[q] = a[q] * b[q] + a[4 + q] * b[4 + q] + (a[8 + q] * b[8 + q] + a[12 + q] * b[12 + q])
    return lanes[0] + lanes[1] + (lanes[2] + lanes[3])


@kernel
def _product_with_change(a: Array, b: Array, since: Array, lanes: Array) -> float:
    """The same with what ``b`` differs in from ``since``."""
    for q in range(_LANES):
        lanes[q] = a[q] * (b[q] - since[q]) + a[4 + q] * (b[4 + q] - since[4 + q])
        lanes[q] += a[8 + q] * (b[8 + q] - since[8 + q]) + a[12 + q] * (b[12 + q] - since[12 + q])
    return lanes[0] + lanes[1] + (lanes[2] + lanes[3])


@kernel
def seen(adaptation: np.void, state: np.void, measured_m: Array, delay: int, out: Array) -> None:
    """Write what was measured (3,), less psi theta, to ``out`` (3,): what the filter's model would have shown."""
    row, acting, spread = state["motion"][delay], state["acting"], adaptation["spread"]
    late_s, bend_s2 = acting[DELAY] * spread[DELAY], acting[BEND] * spread[BEND]
    for i in range(3):
        out[i] = measured_m[i] + late_s * row[3 + i] - bend_s2 * row[6 + i]


@kernel
def learn(
    adaptation: np.void, state: np.void, delay: int, origin_m: Array, innovation_m: Array, filtered: Array,
    predicted: Array, has_measurement: bool,
) -> None:  # fmt: skip
    """After ``note``: take in the innovation (3,) of this sample, where the filter's state (9,) about ``origin_m`` was
    ``filtered``, carry U to the next one, and move what is ``predicted`` (9,) for it along.
    """
    if state["begun"] == 0:
        begin(adaptation, state)
    if has_measurement:
        _show(adaptation, state, state["motion"][delay])
    row, later, near = state["motion"][delay], state["motion"][delay - 1], has_measurement
    for i in range(3):
        off_m, turn_m_per_s2 = origin_m[i] + filtered[i] - row[i], later[6 + i] - row[6 + i]
        near = near and abs(off_m) < adaptation["near_m"] and abs(turn_m_per_s2) < adaptation["turn_m_per_s2"][i]
    state["calm"] = min(state["calm"] + 1, adaptation["calm_ticks"]) if near else 0
    axis = state["axis"]
    state["axis"] = axis + 1 if axis < 2 else 0
    if near and state["calm"] >= adaptation["calm_ticks"]:
        _update(adaptation, state, axis, innovation_m[axis])
    change, follow = state["work"], adaptation["follow"]
    for p in range(_ROOM):
        change[p] = follow * (state["learnt"][p] - state["acting"][p])
        state["acting"][p] += change[p]
    for i in range(3):
        _carry(adaptation, state, i, delay, has_measurement)
        for s in range(3):
            predicted[3 * s + i] += _product(state["sensitivity"][i, s], change, state["lanes"])


@kernel
def _carry(adaptation: np.void, state: np.void, i: int, delay: int, has_measurement: bool) -> None:
    """U of axis i: what the filter's gain makes of d nu, if there was a measurement, then on to the next sample."""
    u, shown, k = state["sensitivity"][i], state["shown"][i], adaptation["gain"][i]
    phi, gamma = adaptation["transition"][i], adaptation["input"][i]
    force = state["force_n"][1 if delay == 1 else 2, i]  # so it is known to lie within the array
    kx, kv, kd = (k[0], k[1], k[2]) if has_measurement else (0.0, 0.0, 0.0)
    xx, xv, xd, xf = phi[0, 0], phi[0, 1], phi[0, 2], gamma[0]
    vx, vv, vd, vf = phi[1, 0], phi[1, 1], phi[1, 2], gamma[1]
    for p in range(_ROOM):
        f = force[p] + _FLOOR_N
        x, v, d = u[0, p] + kx * shown[p], u[1, p] + kv * shown[p], u[2, p] + kd * shown[p]
        u[0, p] = xx * x + xv * v + xd * d - xf * f
        u[1, p] = vx * x + vv * v + vd * d - vf * f
        u[2, p] = d


@kernel
def _show(adaptation: np.void, state: np.void, row: Array) -> None:
    """d nu at this sample, where the reference is at ``row`` (9,)."""
    tau, spread, shown, u = adaptation["sense_delay_s"], adaptation["spread"], state["shown"], state["sensitivity"]
    for i in range(3):
        late, bent = tau * u[i, 1, DELAY] - u[i, 0, DELAY], tau * u[i, 1, BEND] - u[i, 0, BEND]
        for p in range(_ROOM):
            shown[i, p] = tau * u[i, 1, p] - u[i, 0, p]
        shown[i, DELAY] = late + spread[DELAY] * row[3 + i]
        shown[i, BEND] = bent - spread[BEND] * row[6 + i]


@kernel
def _update(adaptation: np.void, state: np.void, axis: int, innovation_m: float) -> None:
    """One step of recursive least squares with the innovation of an axis: nu is -d nu times what theta still lacks."""
    p, learnt, acting = state["covariance"], state["learnt"], state["acting"]
    by, gain, base, lanes = state["shown"][axis], state["work"], state["base"], state["lanes"]
    b0, b1, b2, b3, b4 = by[0], by[1], by[2], by[3], by[4]
    b5, b6, b7, b8, b9 = by[5], by[6], by[7], by[8], by[9]
    b10, b11, b12, b13, b14 = by[10], by[11], by[12], by[13], by[14]
    for i in range(_ROOM):
        total = 0.0 + p[0, i] * b0 + p[1, i] * b1 + p[2, i] * b2 + p[3, i] * b3 + p[4, i] * b4
        total = total + p[5, i] * b5 + p[6, i] * b6 + p[7, i] * b7 + p[8, i] * b8 + p[9, i] * b9
        gain[i] = total + p[10, i] * b10 + p[11, i] * b11 + p[12, i] * b12 + p[13, i] * b13 + p[14, i] * b14
    told = _product(gain, by, lanes)
    # Not whether the innovation is large: of a device that changes fast only the small ones would be left.
    if not told > adaptation["least"] * adaptation["variance_m2"][axis]:
        return
    missing = innovation_m + _product_with_change(by, learnt, acting, lanes)
    noise_m2 = adaptation["variance_m2"][axis]
    if state["cause"] == 0:  # what a change explains that has been named is no noise
        noise_m2 += adaptation["doubt"] * missing * missing
    scale = 1.0 / (told + noise_m2)
    for k in range(0, _PARAMETERS, _ROWS):
        g0, g1, g2, g3, g4 = gain[k], gain[k + 1], gain[k + 2], gain[k + 3], gain[k + 4]
        for i in range(_ROOM):
            weight = gain[i] * scale
            p[k, i] -= weight * g0
            p[k + 1, i] -= weight * g1
            p[k + 2, i] -= weight * g2
            p[k + 3, i] -= weight * g3
            p[k + 4, i] -= weight * g4
    bound, outside = adaptation["bound"], np.int32(0)  # seldom is one, and whether is told without a branch for each
    for i in range(_ROOM):
        learnt[i] = better = learnt[i] - gain[i] * scale * missing
        outside |= np.int32(0) if abs(better) <= bound[i] else np.int32(1)
    for i in range(_PARAMETERS):
        p[i, i] = min(p[i, i] + adaptation["drift"], 1.0)
    if outside != 0:
        _keep_within(bound, p, learnt)
    state["updates"] += 1
    if state["based"] != 0:
        since = innovation_m + _product_with_change(by, base, acting, lanes)
        scale = 1.0 / math.sqrt(adaptation["variance_m2"][axis])
        _compare(adaptation, state, by, scale * since, scale * missing, scale)
    elif state["updates"] >= adaptation["base_updates"]:
        set_base(state)


@kernel
def begin(adaptation: np.void, state: np.void) -> None:
    """Know no more than the spreads, or what an earlier run has learnt."""
    state["begun"] = 1
    for i in range(_PARAMETERS):
        state["learnt"][i] = state["acting"][i] = adaptation["start"][i]
        for k in range(_PARAMETERS):
            state["covariance"][k, i] = adaptation["start_covariance"][i, k]
    if adaptation["known"] != 0:
        set_base(state)


@kernel
def set_base(state: np.void) -> None:
    """What is known now is what changes are counted from."""
    state["based"], state["cause"] = 1, 0
    state["left_by_base"] = state["left"] = state["change"] = 0.0
    for i in range(_PARAMETERS):
        state["base"][i] = state["learnt"][i]
    for c in range(_CAUSES):
        state["answer"][c] = state["clue"][c] = 0.0


@kernel
def _compare(adaptation: np.void, state: np.void, by: Array, since: float, missing: float, scale: float) -> None:
    """Note what an innovation says of the base, in standard deviations of its noise, and name what has changed."""
    spread, forget = adaptation["spread"], adaptation["forget"]
    state["left_by_base"] += forget * (since * since - state["left_by_base"])
    state["left"] += forget * (missing * missing - state["left"])
    best, most, change = 0, 0.0, 0.0
    for c in range(_CAUSES):
        if c < 3:
            shown = by[COMB + c] / spread[COMB + c]
        elif c < 6:
            shown = by[SLIDER + c - 3] / spread[SLIDER] + by[CRANK + c - 3] / spread[CRANK]
        else:
            shown = by[LINK] / spread[LINK]
        shown *= scale
        state["answer"][c] += forget * (shown * shown - state["answer"][c])
        state["clue"][c] += forget * (-shown * since - state["clue"][c])
        explained = state["clue"][c] * state["clue"][c]
        if explained > most * state["answer"][c]:
            best, most, change = c + 1, explained / state["answer"][c], state["clue"][c] / state["answer"][c]
    lost = state["left_by_base"] - state["left"]
    if most > adaptation["alone"] * lost and lost > LEAST_LOSS and abs(change) >= adaptation["warn"]:
        # A comb that has lost a share s has to be asked for s / (1 - s) more: that is what shows.
        state["cause"], state["change"] = best, change / (1.0 - min(change, _MOST_SPARED)) if best <= 3 else change
    else:
        state["cause"], state["change"] = 0, 0.0


@kernel
def _keep_within(bound: Array, p: Array, learnt: Array) -> None:
    """Take numbers back to their bounds, and the others along by as much as they depend on them."""
    for i in range(_PARAMETERS):
        beyond = learnt[i] - min(max(learnt[i], -bound[i]), bound[i])
        if beyond != 0.0:
            share = beyond / p[i, i]
            for k in range(_PARAMETERS):
                learnt[k] -= share * p[i, k]
    for i in range(_PARAMETERS):
        learnt[i] = min(max(learnt[i], -bound[i]), bound[i])


@kernel
def tell(state: np.void, age: int) -> None:
    """Write -phi theta (3,) of the interval of the force that was decided ``age`` ticks ago to ``told_n``: what the
    filter has to reckon with there.
    """
    for i in range(3):
        state["told_n"][i] = -_product(state["force_n"][age + 1, i], state["acting"], state["lanes"])


@kernel
def move_on(state: np.void, delay: int) -> None:
    """Between two ticks: what was decided is one older, and there is room for the next interval."""
    force, motion = state["force_n"], state["motion"]
    for age in range(delay, 0, -1):
        for i in range(9):
            motion[age, i] = motion[age - 1, i]
        for i in range(3):
            for p in range(_ROOM):
                force[age, i, p] = force[age - 1, i, p]


@kernel
def foresee(
    adaptation: np.void, state: np.void, geometry: np.void, damping: Array, row: Array, bent: np.void, inverse: Array,
    pulls: Array, feedforward_n: Array,
) -> None:  # fmt: skip
    """Write phi of the next interval, with ``row`` (9,) of the reference in its middle. There the stage is ``bent`` (a
    record of ``elasticity.BENT``), has ``pulls`` (3,3) with their ``inverse``, and needs ``feedforward_n`` (3,).
    """
    newest, spread = state["force_n"][0], adaptation["spread"]
    for i in range(3):
        newest[i, FRINGE] = newest[i, LIFT] = 0.0
        lost_n = damping[i, 0] * row[3] + damping[i, 1] * row[4] + damping[i, 2] * row[5]
        newest[i, DAMPING] = spread[DAMPING] * lost_n
    newest[2, LINK] = spread[LINK] * bent["link_n_m"] * bent["per_projection_m"]
    for i in range(3):
        pull = inverse[0, i] * feedforward_n[0] + inverse[1, i] * feedforward_n[1] + inverse[2, i] * feedforward_n[2]
        _note_chain(1.0 / adaptation["fringe_m"], spread, geometry, i, bent, pulls[i], pull, newest)


@kernel
def note(state: np.void, start: Array) -> None:
    """The interval that was foreseen is decided, and begins at the row ``start`` (9,): write phi theta, which the
    feed-forward lacks, to ``added_n``.
    """
    for i in range(9):
        state["motion"][0, i] = start[i]
    for i in range(3):
        state["added_n"][i] = _product(state["force_n"][0, i], state["acting"], state["lanes"])


@kernel
def _note_chain(
    per_m: float, spread: Array, geometry: np.void, i: int, bent: np.void, along: Array, pull_n: float, out: Array
) -> None:
    """What errors of chain i make the feed-forward lack, per ``spread``: its comb's pull, springs, and its share of the
    rest. ``along`` (3,) is where the comb pulls.
    """
    n = geometry["n"]
    across = spread[CRANK + i] * bent["crank_n_m"][i] * bent["per_along_m"][i]
    spring = spread[SLIDER + i] * bent["slider_n"][i]
    pulled, grown = spread[COMB + i] * pull_n, spread[FRINGE] * pull_n * bent["stroke_m"][i] * per_m
    for k in range(3):
        out[k, COMB + i] = -pulled * along[k]
        out[k, SLIDER + i] = spring * (along[k] if k < 2 else along[k] - geometry["lift"])
        out[k, CRANK + i] = across * n[i, k] if k < 2 else 0.0
        out[k, FRINGE] -= grown * along[k]
    out[2, LIFT] -= spread[LIFT] * pull_n


@kernel
def disturb(state: np.void) -> None:
    """Something is not as it should be for learning: a limit was met."""
    state["calm"] = 0


@kernel
def clear(state: np.void, delay: int) -> None:
    """The loop is open, or the filter begins anew: forget the motion, keep what was learnt."""
    for i in range(3):
        state["added_n"][i] = state["told_n"][i] = 0.0
        for p in range(_ROOM):
            state["shown"][i, p] = 0.0
            for k in range(3):
                state["sensitivity"][i, k, p] = 0.0
            for age in range(delay + 1):
                state["force_n"][age, i, p] = 0.0
    state["motion"][:] = 0.0
    state["calm"] = 0
