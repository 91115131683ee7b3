"""Whole ticks of the lockstep lane in one compiled call: controller, wire, node and plant while all is as it should be,
and while a node that is not operational owes nothing.

A tick in which anything else happens is undone and left to the event-by-event way, which finds everything where it
would be had it run all ticks. ``stretches`` asks for them.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.bus.log_lines import LINE_MOST
from hil.node.rules import NEVER_US, OPERATIONAL
from hil.whole_ticks.happenings import Bytes, Line, Records, Stage, happen, look, next_us, pass_time, send, take_first
from pkxyz_ctrl.can.driver_rules import FRESH, RUNNING, START_UP
from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.loop.exchange import BLOCKED, NOT_RESTARTED, RESTARTED, begin, finish, on_frame, period, prepare
from pkxyz_ctrl.safety.modes import Mode

Pair = tuple[Records, Records]
"""Of controller or node: what it goes by, and what it remembers."""
Words = tuple[NDArray[np.int64], ...]

_FAULT, _ENABLED, _IDLE = int(Mode.FAULT), int(Mode.ENABLED), int(Mode.IDLE)
_LINES_MOST: Final = 12  # of a tick
_MARK_TICKS: Final = 16  # from one state that is kept to the next
_WORDS: Final = BLOCKED | RESTARTED | NOT_RESTARTED


@kernel
def whole_ticks(
    controller: Pair, node: Pair, stage: Stage, line: Line, bench: Records, reference: Records, rows: Records,
    seen_v: NDArray[np.float64], live: Words, kept: Words,
) -> int:  # fmt: skip
    """Run up to ``len(rows)`` ticks and write their rows, and the combs' voltages behind each to ``seen_v`` if they are
    watched; returns how many there were.

    ``live`` are the words of all that a tick changes, ``kept`` room for them. They are kept every few ticks only: the
    first that can't be played leads back there, and those between are played again. So does an end with a frame on its
    way: the last one is that behind which nothing was.
    """
    done, calm, most = 0, 0, len(rows)
    marked = -_MARK_TICKS
    while done < most or done != calm:
        if done == calm and done - marked >= _MARK_TICKS:
            _copy_all(live, kept)
            marked = done
        if done < most and _is_room(bench[0], line[3]) and _tick(
            controller, node, stage, line, bench, reference, rows, seen_v, done
        ):  # fmt: skip
            done += 1
            calm = done if _is_calm(bench[0], node[1][0]) else calm
        else:
            most, done = calm, marked
            _copy_all(kept, live)
    return done


@kernel
def _is_calm(lane: np.void, memory: np.void) -> bool:
    """Whether nothing is on its way."""
    return bool(lane["wire"][0]["waiting"] == 0 and memory["due_us"] == NEVER_US)


@kernel
def _is_room(lane: np.void, text: Bytes) -> bool:
    """Whether a tick ends before something else is to happen, and the log has room for it."""
    if lane["t_us"] + lane["period_us"] >= lane["horizon_us"]:
        return False
    return bool(lane["logged"] + _LINES_MOST * LINE_MOST <= len(text))


@kernel
def _copy_all(words: Words, to: Words) -> None:
    for part in range(len(words)):
        source, target = words[part], to[part]
        for i in range(len(source)):
            target[i] = source[i]


@kernel
def _tick(
    controller: Pair, node: Pair, stage: Stage, line: Line, bench: Records, reference: Records, rows: Records,
    seen_v: NDArray[np.float64], done: int,
) -> bool:  # fmt: skip
    """One period; False as soon as something can't be played, in the midst of it."""
    config, memory, lane, its, own = controller[0], controller[1], bench[0], node[0][0], node[1][0]
    wire, mode = lane["wire"][0], memory[0]["cycle"][0]["mode"]
    end_us, now_us = lane["t_us"] + lane["period_us"], lane["t_us"] + lane["late_us"]
    is_at_work = memory[0]["driver"][0]["state"] == RUNNING and _IDLE <= mode != _FAULT
    if now_us >= end_us or not pass_time(lane, its, own, stage, line, now_us):
        return False
    told = begin(config, memory, lane["t_us"])
    if told & _WORDS or not send(memory, wire, told, now_us):
        return False
    now_us = _wait(config, memory, lane, its, own, stage, line, now_us, is_at_work)
    if now_us == NEVER_US:
        return False
    period(config, memory, reference, 0)
    if not _is_left_alone(lane, mode, memory[0]["cycle"][0]["mode"], is_at_work):
        return False
    now_us += lane["compute_us"]
    if not pass_time(lane, its, own, stage, line, now_us):
        return False
    told = finish(config, memory, now_us, lane["t_us"] + lane["heartbeat_us"])
    if told & BLOCKED or not send(memory, wire, told, now_us):
        return False
    prepare(config, memory)
    _record(memory, lane, stage, rows, seen_v, done, now_us)
    if not pass_time(lane, its, own, stage, line, end_us):
        return False
    lane["t_us"] = end_us
    return True


@kernel
def _wait(
    config: Records, memory: Records, lane: np.void, its: np.void, own: np.void, stage: Stage, line: Line, now_us: int,
    is_at_work: bool,
) -> int:  # fmt: skip
    """The controller waits for the sense values of a node at work, or for nothing until it is late. Returns the time at
    which it goes on; NEVER_US where that can't be played.
    """
    deadline_us, is_owed = lane["t_us"] + lane["answer_us"], is_at_work and lane["node_state"] == OPERATIONAL
    while True:
        if lane["received"] > 0:
            first = lane["inbox"][0]
            told = on_frame(config, memory, first["can_id"], first["flags"], first["length"], first["word"], now_us)
            take_first(lane)
            if told & ~(FRESH | START_UP) or (told & START_UP and not _go_on_starting(memory, lane, now_us)):
                return NEVER_US
            if told & FRESH:
                return now_us
            if now_us > deadline_us:
                return NEVER_US if is_owed else now_us
            continue
        soonest_us = next_us(lane, own)
        if soonest_us > deadline_us:
            return NEVER_US if is_owed else max(now_us, deadline_us)
        now_us = soonest_us
        if not happen(lane, its, own, stage, line, now_us):
            return NEVER_US


@kernel
def _go_on_starting(memory: Records, lane: np.void, now_us: int) -> bool:
    """What a start-up sends in answer to a frame."""
    if memory[0]["blocked"] != 0:
        return False
    return bool(send(memory, lane["wire"][0], memory[0]["driver"][0]["outgoing"], now_us))


@kernel
def _is_left_alone(lane: np.void, before: int, mode: int, is_at_work: bool) -> bool:
    """Whether nobody has to act on the mode after the cycle."""
    if not is_at_work or lane["node_state"] != OPERATIONAL:
        return bool(mode == before)
    return bool(mode != _FAULT and (mode != _ENABLED or lane["is_begun_anew"] == 0))


@kernel
def _record(
    memory: Records, lane: np.void, stage: Stage, rows: Records, seen_v: NDArray[np.float64], done: int, now_us: int
) -> None:
    """The tick's row, with the truth at its sample, or now if there was none."""
    if lane["was_sampled"] == 0:
        look(lane, stage, now_us)
    lane["was_sampled"] = 0
    rows[done] = memory[0]["cycle"][0]["row"]
    row, truth = rows[done], stage[2][0]
    for i in range(3):
        row["position_m"][i] = truth["position_m"][i]
        row["stroke_m"][i] = truth["stroke_m"][i]
        row["comb_voltage_v"][i] = truth["comb_voltage_v"][i]
    row["terminal_output"] = truth["terminal_output"]
    if lane["is_watched"] != 0:
        look(lane, stage, now_us)
        for i in range(3):
            seen_v[done, i] = stage[1][0]["voltage_v"][i]
