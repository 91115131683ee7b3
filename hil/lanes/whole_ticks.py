"""Whole ticks of the lockstep lane in one compiled call: controller, wire, node and plant while all is as it should be.

A tick in which anything else happens is undone and left to the event-by-event way, which finds everything where it
would be had it run all ticks. `ordinary_ticks` says what is as it should be; ``stretches`` asks for them.
"""

from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hil.bus import wire_rules
from hil.bus.log_lines import LINE_MOST, write_line
from hil.bus.wire_rules import WIRE
from hil.node import rules
from hil.plant.on_bus import at_sync
from pkxyz_ctrl.can.driver_rules import FRESH, RUNNING
from pkxyz_ctrl.loop.exchange import BLOCKED, begin, finish, on_frame, period
from pkxyz_ctrl.safety.modes import Mode

Records = NDArray[np.void]
Bytes = NDArray[np.uint8]
Words = tuple[NDArray[np.int64], ...]

INBOX: Final = 4  # frames that came behind the one that a tick waited for
NEVER_US: Final = 1 << 62
CONTROLLER: Final = 0
AMPLIFIER: Final = 1

BENCH = np.dtype(
    [
        ("wire", WIRE, (1,)),
        ("inbox", wire_rules.FRAME, (INBOX,)),
        ("t_us", "i8"),  # when the next tick begins
        ("horizon_us", "i8"),  # from here on something else is to happen
        ("plant_us", "i8"),  # of the last exchange, by the plant's own time
        ("origin_us", "i8"),  # the plant's time 0
        ("period_us", "i8"),
        ("compute_us", "i8"),
        ("answer_us", "i8"),
        ("heartbeat_us", "i8"),
        ("logged", "i8"),  # bytes of the log
        ("frames", "i8"),  # in it
        ("received", "i4"),  # frames in the inbox
        ("is_logged", "i4"),
        ("tracking_only", "i4"),  # 1: a tick in another mode is left to the other way
    ],
    align=True,
)
"""What lies between controller, node and plant, and what is agreed between them."""

_FAULT, _TRACKING, _IDLE = int(Mode.FAULT), int(Mode.TRACKING), int(Mode.IDLE)
_OPERATIONAL: Final = 5
_LINES_MOST: Final = 8  # of a tick


@njit(cache=True, error_model="numpy")
def ordinary_ticks(
    config: Records, memory: Records, node: Records, node_memory: Records,
    params: Records, state: Records, truth: Records, bench: Records, reference: Records,
    rows: Records, channel: Bytes, text: Bytes, live: Words, kept: Words,
) -> int:  # fmt: skip
    """Run up to ``len(rows)`` ticks and write their rows; returns how many were as they should be.

    ``live`` are the words of ``memory``, ``node_memory``, ``state``, ``truth`` and ``bench``, ``kept`` room for them.
    """
    lane = bench[0]
    for done in range(len(rows)):
        if lane["t_us"] + lane["period_us"] >= lane["horizon_us"]:
            return done
        if lane["logged"] + _LINES_MOST * LINE_MOST > len(text):
            return done
        _copy_all(live, kept)
        if not _tick(config, memory, node, node_memory, params, state, truth, bench, reference, channel, text):
            _copy_all(kept, live)
            return done
        row, seen = rows[done], truth[0]
        rows[done] = memory[0]["cycle"][0]["row"]
        for i in range(3):
            row["position_m"][i] = seen["position_m"][i]
            row["stroke_m"][i] = seen["stroke_m"][i]
            row["comb_voltage_v"][i] = seen["comb_voltage_v"][i]
        row["terminal_output"] = seen["terminal_output"]
    return len(rows)


@njit(cache=True, error_model="numpy")
def _copy_all(words: Words, to: Words) -> None:
    for part in range(len(words)):
        source, target = words[part], to[part]
        for i in range(len(source)):
            target[i] = source[i]


@njit(cache=True, error_model="numpy")
def _tick(
    config: Records, memory: Records, node: Records, node_memory: Records,
    params: Records, state: Records, truth: Records, bench: Records, reference: Records,
    channel: Bytes, text: Bytes,
) -> bool:  # fmt: skip
    """One period; False as soon as something is not as it should be, in the midst of it."""
    lane, wire = bench[0], bench[0]["wire"][0]
    now_us = lane["t_us"]
    end_us, deadline_us = now_us + lane["period_us"], now_us + lane["answer_us"]
    if not _may_begin(memory[0], lane) or begin(config, memory, now_us) != 1 or not _send(memory, wire, 1, now_us):
        return False
    told = 0
    while told == 0:
        if lane["received"] > 0:
            told = _take(config, memory, lane, now_us)
            continue
        now_us = _next_us(wire, node_memory[0])
        if now_us > deadline_us:
            return False
        if not _happen(node, node_memory, params, state, truth, bench, now_us, channel, text):
            return False
    if told != FRESH:
        return False
    period(config, memory, reference, 0)
    if memory[0]["cycle"][0]["mode"] == _FAULT:
        return False
    now_us += lane["compute_us"]
    if not _pass(node, node_memory, params, state, truth, bench, now_us, channel, text):
        return False
    told = finish(config, memory, now_us, lane["t_us"] + lane["heartbeat_us"])
    if told & BLOCKED or not _send(memory, wire, told, now_us):
        return False
    if not _pass(node, node_memory, params, state, truth, bench, end_us, channel, text):
        return False
    lane["t_us"] = end_us
    return wire["waiting"] == 0 and node_memory[0]["due_us"] == NEVER_US and _may_end(memory[0], lane)


@njit(cache=True, error_model="numpy")
def _may_begin(memory: np.void, lane: np.void) -> bool:
    """Whether driver and mode are those of a loop at work."""
    mode = memory["cycle"][0]["mode"]
    if memory["driver"][0]["state"] != RUNNING or mode < _IDLE or mode == _FAULT:
        return False
    return lane["tracking_only"] == 0 or mode == _TRACKING


@njit(cache=True, error_model="numpy")
def _may_end(memory: np.void, lane: np.void) -> bool:
    return lane["tracking_only"] == 0 or memory["cycle"][0]["mode"] == _TRACKING


@njit(cache=True, error_model="numpy")
def _send(memory: Records, wire: np.void, count: int, now_us: int) -> bool:
    """Put what the controller wants to send on the wire."""
    for place in range(count):
        out = memory[0]["driver"][0]["out"][place]
        if not wire_rules.send(wire, CONTROLLER, out["can_id"], out["flags"], out["length"], out["data"], now_us):
            return False
    return True


@njit(cache=True, error_model="numpy")
def _take(config: Records, memory: Records, lane: np.void, now_us: int) -> int:
    """The controller reads the oldest frame that has come; what it says of it."""
    first = lane["inbox"][0]
    told = on_frame(config, memory, first["can_id"], first["flags"], first["length"], first["word"], now_us)
    lane["received"] -= 1
    for place in range(lane["received"]):
        _copy(lane["inbox"][place + 1], lane["inbox"][place])
    return int(told)


@njit(cache=True, error_model="numpy")
def _copy(frame: np.void, to: np.void) -> None:
    to["word"], to["can_id"], to["length"], to["flags"] = (
        frame["word"], frame["can_id"], frame["length"], frame["flags"]
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _next_us(wire: np.void, node: np.void) -> int:
    return min(wire["end_us"], node["due_us"])


@njit(cache=True, error_model="numpy")
def _pass(
    node: Records, node_memory: Records, params: Records, state: Records, truth: Records,
    bench: Records, until_us: int, channel: Bytes, text: Bytes,
) -> bool:  # fmt: skip
    """Let everything happen that is due until then, then included."""
    wire, memory = bench[0]["wire"][0], node_memory[0]
    while _next_us(wire, memory) <= until_us:
        if not _happen(node, node_memory, params, state, truth, bench, _next_us(wire, memory), channel, text):
            return False
    return bool(rules.next_alarm_us(memory) > until_us)


@njit(cache=True, error_model="numpy")
def _happen(
    node: Records, node_memory: Records, params: Records, state: Records, truth: Records,
    bench: Records, now_us: int, channel: Bytes, text: Bytes,
) -> bool:  # fmt: skip
    """What is due now: a frame has ended, or the node's turn-around. Both at once, or an alarm of the node: False."""
    wire, memory = bench[0]["wire"][0], node_memory[0]
    if rules.next_alarm_us(memory) <= now_us or wire["end_us"] == memory["due_us"]:
        return False
    if memory["due_us"] == now_us:
        return _answer(node[0], memory, wire, now_us)
    wire_rules.end(wire)
    frame = wire["done"][0]
    if bench[0]["is_logged"] != 0:
        bench[0]["frames"] += 1
        bench[0]["logged"] = write_line(
            text, bench[0]["logged"], channel, now_us,
            frame["can_id"], frame["flags"], frame["length"], frame["word"],
        )  # fmt: skip
    if frame["sender"] == AMPLIFIER:
        well = _keep(bench[0], frame)
    elif frame["can_id"] == node[0]["drive_id"]:
        well = rules.on_drive(node[0], memory, frame["length"], frame["word"], now_us)
    elif frame["can_id"] == node[0]["output_id"]:
        well = rules.on_digital(memory, frame["length"], frame["word"])
    elif frame["can_id"] == node[0]["consumer_id"]:
        well = rules.on_heartbeat(node[0], memory, frame["length"], frame["word"], now_us)
    else:
        well = frame["can_id"] == node[0]["sync_id"] and rules.on_sync(
            node[0], memory, frame["length"], frame["word"], now_us
        )
        if well:
            _exchange(params, state, truth, bench[0], memory, now_us)
    wire_rules.arbitrate(wire, now_us)
    return bool(well)


@njit(cache=True, error_model="numpy")
def _keep(lane: np.void, frame: np.void) -> bool:
    if lane["received"] == INBOX:
        return False
    _copy(frame, lane["inbox"][lane["received"]])
    lane["received"] += 1
    return True


@njit(cache=True, error_model="numpy")
def _exchange(params: Records, state: Records, truth: Records, lane: np.void, memory: np.void, now_us: int) -> None:
    """The converters take the output, and the sense combs are sampled."""
    output, count, target_us = memory["output"], memory["count"], now_us - lane["origin_us"]
    count[0], count[1], count[2] = at_sync(
        params, state, truth, target_us - lane["plant_us"], True, output[0], output[1], output[2]
    )
    lane["plant_us"] = target_us
    truth[0]["terminal_output"] = memory["digital"]


@njit(cache=True, error_model="numpy")
def _answer(node: np.void, memory: np.void, wire: np.void, now_us: int) -> bool:
    """The node's sense PDO, and its heartbeat behind it if the next one would be too late."""
    word, flags = rules.answer(node, memory), node["flags"]
    if not wire_rules.send(wire, AMPLIFIER, node["sense_id"], flags, rules.LENGTH, word, now_us):
        return False
    if not rules.rides(node, memory, now_us):
        return True
    return bool(wire_rules.send(wire, AMPLIFIER, node["heartbeat_id"], flags, 1, _OPERATIONAL, now_us))
