"""One tick of the composition after the other, as ``loop.runtime`` has them, and all that may happen in it."""

from typing import Final

import numpy as np
from kept import kernel
from numpy.typing import NDArray
from product import (
    AFTER,
    APART_TOO_LONG,
    BEFORE,
    BEGIN,
    CLOSED_TOO_SOON,
    CLOSES,
    COMPUTE,
    COMPUTING,
    CUT,
    DAMAGE,
    DELIVER,
    DIALOGUE,
    DONE,
    ENDED,
    FAILED,
    FINISH,
    FINISHING,
    FRAME,
    FRESH,
    GO,
    LANDING_FOR_EVER,
    LATE,
    LOSE,
    MEND,
    QUIET,
    READ,
    RELEASE,
    REPEAT,
    REST,
    SENSED,
    SKIP,
    SKIPS,
    START,
    STARTED_WITH_VOLTAGE,
    SYNCED,
    TICK,
    TOO_LATE_AT_0_V,
    TOO_LATE_LOW,
    UNSIGNED_TOO_LONG,
    VANISH,
    VIOLATED,
    WAIT,
    Rows,
    controller_does,
    deliver,
    hold,
    let_go,
    off_port,
    off_wire,
    pass_us,
)

_CUTS: Final = 6


# -- a tick ---------------------------------------------------------------------------------------------------------


@kernel
def _go_on(w: np.void, r: Rows) -> int:
    phase, rules = w["phase"], r.rules[0]
    told = 0
    if phase == START:
        return _start(w, r)
    if phase == BEFORE:
        told = controller_does(w, r, BEGIN)
        w["phase"] = SYNCED
    elif phase == SYNCED:
        told = pass_us(w, r, rules["turnaround_us"])
        w["phase"] = SENSED
    elif phase == SENSED:
        w["phase"] = AFTER
    elif phase == AFTER:
        w["phase"] = READ
    elif phase == READ:
        return _read(w, r)
    elif phase == FINISHING:
        told = pass_us(w, r, rules["period_us"] // 2 - w["age_us"])
        if told >= 0 and w["on_wire"] == 0:
            told = controller_does(w, r, FINISH)
            w["phase"] = REST
    elif phase == REST:
        next_us = r.nodes[w["node"]]["next_us"]
        if w["age_us"] + next_us <= rules["period_us"]:
            return pass_us(w, r, next_us)
        return _pass_tick(w, r)
    return told


@kernel
def _start(w: np.void, r: Rows) -> int:
    """As ``loop.runtime.start``."""
    if w["in_port"] > 0:
        told = controller_does(w, r, FRAME + DIALOGUE + off_port(w))
    else:
        told = pass_us(w, r, min(r.rules[0]["poll_us"], r.nodes[w["node"]]["next_us"]))
        if told < 0 or w["on_wire"] > 0:
            return told
        told = controller_does(w, r, WAIT)
    if told < 0:
        return told
    if told & FAILED:
        w["phase"] = ENDED
        if r.nodes[w["node"]]["counts"] != 0:
            w["violation"] = STARTED_WITH_VOLTAGE
            return VIOLATED
    elif told & DONE:
        w["phase"] = REST
    return told


@kernel
def _read(w: np.void, r: Rows) -> int:
    while w["in_port"] > 0:
        frame = off_port(w)
        told = controller_does(w, r, FRAME + frame)
        if r.frame_labels[frame]["is_signature"] != 0:
            w["unsigned"] = 0
        if told < 0:
            return told
        if told & FRESH:
            break
        if w["on_wire"] > 0:
            return told
    w["phase"] = COMPUTING
    return 0


@kernel
def _compute(w: np.void, r: Rows, wish: int) -> int:
    told = controller_does(w, r, COMPUTE + SKIPS * wish + w["skipped"])
    if told < 0:
        return told
    w["skipped"] = 0
    if told & CLOSES and w["quiet"] < r.rules[0]["settled"]:
        w["violation"] = CLOSED_TOO_SOON
        return VIOLATED
    w["quiet"] = min(w["quiet"] + 1, r.rules[0]["settled"]) if told & QUIET else 0
    w["phase"] = FINISHING
    return 0


@kernel
def _pass_tick(w: np.void, r: Rows) -> int:
    """The next one begins; what must not last too long has lasted one longer."""
    rules = r.rules[0]
    told = pass_us(w, r, rules["period_us"] - w["age_us"])
    if told < 0:
        return told
    w["age_us"] = 0
    w["ticks"] += 1
    controller, counts = r.controllers[w["controller"]], r.nodes[w["node"]]["counts"]
    if not _compare_beliefs(w, r, controller, counts):
        return VIOLATED
    w["landing"] = w["landing"] + 1 if controller["mode"] == rules["mode_landing"] else 0
    if w["landing"] > rules["landing_ticks"]:
        w["violation"] = LANDING_FOR_EVER
        return VIOLATED
    if controller["may_energise"] != 0 or counts == 0:
        w["since_decision"] = 0
    else:
        w["since_decision"] += 1
        rules["longest"] = max(rules["longest"], w["since_decision"])
        if w["since_decision"] > rules["settle_ticks"]:
            w["violation"] = TOO_LATE_AT_0_V
            return VIOLATED
    if not _look_at_extras(w, r, controller):
        return VIOLATED
    place = 0
    while place < w["are_held"]:
        w["left"][place] -= 1
        if w["left"][place] == 0:
            let_go(w, place)
        else:
            place += 1
    w["phase"] = BEFORE
    return 0


@kernel
def _compare_beliefs(w: np.void, r: Rows, controller: np.void, counts: int) -> bool:
    """Do energised combs hold what the gate takes them to hold? It may be wrong while it can't know better.

    Combs at 0 V that the gate takes for energised (no drive frame arrives) are the business of the loop's monitors.
    """
    rules = r.rules[0]
    if controller["believes"] == 0 or counts == 0 or counts == w["believed"]:
        w["apart"] = 0
    else:
        w["apart"] += 1
        rules["longest_apart"] = max(rules["longest_apart"], w["apart"])
        if w["apart"] > rules["agree_ticks"]:
            w["violation"] = APART_TOO_LONG
            return False
    w["believed"] = controller["counts"] if controller["believes"] != 0 else 0
    return True


@kernel
def _look_at_extras(w: np.void, r: Rows, controller: np.void) -> bool:
    """Digital outputs go low with the combs; without a signature that is right the loop does not stay closed."""
    rules = r.rules[0]
    if controller["may_put_out"] != 0 or r.nodes[w["node"]]["bits"] == 0:
        w["high"] = 0
    else:
        w["high"] += 1
        rules["longest_high"] = max(rules["longest_high"], w["high"])
        if w["high"] > rules["settle_ticks"]:
            w["violation"] = TOO_LATE_LOW
            return False
    if controller["goes_by_signature"] == 0 or controller["may_energise"] == 0:
        w["unsigned"] = 0
    else:
        w["unsigned"] += 1
        rules["longest_unsigned"] = max(rules["longest_unsigned"], w["unsigned"])
        if w["unsigned"] > rules["unsigned_ticks"]:
            w["violation"] = UNSIGNED_TOO_LONG
            return False
    return True


# -- what may happen ------------------------------------------------------------------------------------------------


@kernel
def options(w: np.void, r: Rows, to: NDArray[np.int32]) -> int:
    """Everything that may happen now, and how much that is; the first is what happens when nothing goes wrong."""
    rules, phase, count = r.rules[0], w["phase"], 1
    to[0] = GO << 8
    if phase == ENDED:
        return 0
    if w["on_wire"] > 0:
        return _fates(w, r, to)
    if phase == COMPUTING:
        choice = r.choices[r.controllers[w["controller"]]["choice"]]
        for wish in range(choice[0]):
            to[wish] = TICK << 8 | choice[1 + wish]
        return int(choice[0])
    if phase == BEFORE and w["faults_left"] > 0:
        if rules["skip"] != 0:
            to[count] = SKIP << 8
            count += 1
        if rules["cut"] != 0 and w["cut"] == 0:
            for cut in range(_CUTS):
                if rules["cut"] >> cut & 1:
                    to[count] = CUT << 8 | cut
                    count += 1
    if phase == BEFORE and w["cut"] != 0:
        to[count] = MEND << 8
        count += 1
    if phase in (BEFORE, AFTER):
        for place in range(w["are_held"]):
            to[count] = RELEASE << 8 | place
            count += 1
    return count


@kernel
def _fates(w: np.void, r: Rows, to: NDArray[np.int32]) -> int:
    """What may become of the frame that is on the wire."""
    rules, frame, count = r.rules[0], r.frame_labels[w["wire"][0]], 1
    to[0] = DELIVER << 8
    if w["cut"] > 0 and frame["cuts"] >> w["cut"] & 1:
        to[0] = VANISH << 8
    elif w["faults_left"] > 0:
        if rules["late"] != 0:
            to[count] = LATE << 8
            count += 1
        if rules["repeat"] != 0:
            to[count] = REPEAT << 8
            count += 1
        if rules["damage"] != 0:
            for which in range(frame["damages"]):
                to[count] = DAMAGE << 8 | which
                count += 1
        if rules["lose"] != 0:
            to[count] = LOSE << 8
            count += 1
    return count


@kernel
def take(w: np.void, r: Rows, option: int) -> int:
    """Let one of `options` happen. Below 0: MISSING or VIOLATED."""
    kind, which = option >> 8, option & 0xFF
    if kind == GO:
        return _go_on(w, r)
    if kind == TICK:
        return _compute(w, r, which)
    if kind == DELIVER:
        return deliver(w, r, off_wire(w))
    if kind == RELEASE:
        return deliver(w, r, let_go(w, which))
    if kind == VANISH:
        off_wire(w)
        return 0
    if kind == MEND:
        w["cut"] = 0
        return 0
    w["faults_left"] -= 1
    if kind == LATE:
        hold(w, r, off_wire(w))
    elif kind == REPEAT:
        frame = off_wire(w)
        hold(w, r, frame)
        return deliver(w, r, frame)
    elif kind == DAMAGE:
        return deliver(w, r, r.frame_labels[off_wire(w)]["damaged"][which])
    elif kind == LOSE:
        off_wire(w)
    elif kind == CUT:
        w["cut"] = 1 + which
    elif kind == SKIP:
        w["skipped"] += 1
        return _pass_tick(w, r)
    return 0


@kernel
def is_landmark(w: np.void, r: Rows) -> bool:
    """Where ways meet again although nothing is to be decided: before a tick, and now and then in the dialogue."""
    if w["on_wire"] > 0:
        is_request = r.frame_labels[w["wire"][0]]["is_request"] != 0
        return bool(is_request and r.controllers[w["controller"]]["is_landmark"] != 0)
    return bool(w["phase"] == BEFORE)


@kernel
def settle(w: np.void, r: Rows, to: NDArray[np.int32]) -> int:
    """Go on until something has to be decided; returns how much may happen there, or MISSING or VIOLATED."""
    has_moved = False
    while True:
        count = options(w, r, to)
        if count != 1 or (has_moved and is_landmark(w, r)):
            return count
        told = take(w, r, to[0])
        if told < 0:
            return told
        has_moved = True
