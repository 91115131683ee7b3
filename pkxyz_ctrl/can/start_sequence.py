"""From NMT reset to a node that may be driven, compiled: who is it, what does it hold, does it notice when we are gone?

``memory["state"]`` runs from RESETTING to RUNNING or FAILED. In IDENTIFYING the node says who it is, in CONFIGURING
what it holds; what differs is written, and everything that has to hold is read once more. Once it is operational, at
0 V, our heartbeat stays away: in TRYING a node has to leave that state by itself. One that has done so, or of which a
report says so, is known by identity and serial number and not tried again.
"""

from enum import IntEnum
from typing import Final

import numpy as np

from pkxyz_ctrl.can import cob_id, driver_rules, sdo, sense_input, start_plan
from pkxyz_ctrl.can.cob_id import NmtCommand, NmtState
from pkxyz_ctrl.can.driver_rules import (
    CONFIGURING,
    FAILED,
    IDENTIFYING,
    RESETTING,
    RUNNING,
    START_UP,
    STARTING,
    TRYING,
    Failure,
    Records,
    put,
    put_nmt,
)
from pkxyz_ctrl.can.sdo import NO_SUCH_OBJECT, ReplyKind
from pkxyz_ctrl.can.start_plan import ABSENT, ANY, ASK, IDENTIFY, READ_BACK, VALUE, WRITE
from pkxyz_ctrl.compiled.kernel import kernel


class Cause(IntEnum):
    """Why the start-up failed."""

    NONE = 0
    NEVER_BOOTED = 1
    BOOTS_AGAIN = 2
    NO_ANSWER = 3
    REFUSED = 4  # ``reply``: abort code
    NO_NUMBER = 5
    SIZE = 6
    VALUE = 7
    LACKS = 8
    SYNC_COUNTER = 9
    NOT_STARTED = 10
    NOT_NOTICED = 11
    DISTURBED = 12


FIRST_HEARTBEAT_US: Final = 2000  # after the start-up: the loop's first tick has the node's heartbeat in it

(
    _NONE, _NEVER_BOOTED, _BOOTS_AGAIN, _NO_ANSWER, _REFUSED, _NO_NUMBER, _SIZE, _VALUE, _LACKS, _SYNC_COUNTER,
    _NOT_STARTED, _NOT_NOTICED, _DISTURBED,
) = (int(cause) for cause in Cause)  # fmt: skip
_RESET, _START = int(NmtCommand.RESET_NODE), int(NmtCommand.START)
_PRE_OPERATIONAL = int(NmtCommand.PRE_OPERATIONAL)
_BOOT_UP, _OPERATIONAL = int(NmtState.BOOT_UP), int(NmtState.OPERATIONAL)
_READ, _WRITTEN, _ABORTED, _OTHER = (int(kind) for kind in ReplyKind)
_NO_OBJECT, _NO_SUBINDEX = NO_SUCH_OBJECT
_TIMED_OUT: Final = sdo.TIMEOUT_ABORT
_START_FAILED: Final = int(Failure.START_UP)
_SDO_OUT, _SDO_IN, _HEARTBEAT = cob_id.SDO_REQUEST_BASE, cob_id.SDO_RESPONSE_BASE, cob_id.HEARTBEAT_BASE
_OVERFLOW_MOST: Final = cob_id.SYNC_COUNTER_OVERFLOW
_OVERFLOW: Final = 0x1019


@kernel
def begin(config_array: Records, memory_array: Records, t_us: int) -> None:
    """Reset the node, from any state."""
    config, memory = config_array[0], memory_array[0]
    driver_rules.start(memory_array)
    start = memory["start"][0]
    start["never_booted"] = start["is_surveyed"] = start["cause"] = 0
    start["repeats_left"] = config["start"][0]["retries"]
    was = memory["state"]
    _reset(config, memory, t_us)
    _enter(config, memory, was, t_us)


@kernel
def poll(config_array: Records, memory_array: Records, t_us: int) -> None:
    """Time-outs and repetitions of the start-up; our heartbeat while no loop sends it."""
    config, memory = config_array[0], memory_array[0]
    was = memory["state"]
    if driver_rules.is_starting_up(was):
        _on_time(config, memory, t_us)
        _enter(config, memory, was, t_us)
    driver_rules.watch(memory, t_us)
    if t_us >= memory["heartbeat_next_us"]:
        driver_rules.heartbeat(config_array, memory_array, t_us)


@kernel
def on_frame(
    config_array: Records, memory_array: Records, can_id: int, flags: int, length: int, word: int, t_us: int
) -> int:
    """A frame from the bus, as ``driver_rules.receive`` has it; what the start-up answers stands in ``out``."""
    told = driver_rules.receive(config_array, memory_array, can_id, flags, length, word, t_us)
    if told & START_UP:
        _go_on(config_array[0], memory_array[0], can_id, length, word, t_us)
    return told


@kernel
def _go_on(config: np.void, memory: np.void, can_id: int, length: int, word: int, t_us: int) -> None:
    was = memory["state"]
    if can_id == _HEARTBEAT + config["node_id"]:
        _on_heartbeat(config, memory, t_us)
    elif can_id != _SDO_IN + config["node_id"]:  # somebody speaks in our name while the node is operational
        _fail(memory, _DISTURBED)
        put_nmt(config, memory, _PRE_OPERATIONAL)
    elif length == 8 and was in (IDENTIFYING, CONFIGURING):
        _on_answer(config, memory, word, t_us)
    _enter(config, memory, was, t_us)
    if memory["state"] == RUNNING:
        driver_rules.heard(config, memory, memory["node_state"], t_us)


@kernel
def _enter(config: np.void, memory: np.void, was: int, t_us: int) -> None:
    """What begins with another state: our heartbeat runs while the node is starting, and stays away while its loss is
    tried.
    """
    state = memory["state"]
    if state == was:
        return
    driver_rules.fall_silent(memory)
    if state == STARTING:
        sense_input.reset(memory["sense"])  # what waited for a crowded bus is of the life before
        memory["heartbeat_next_us"] = t_us + config["heartbeat_period_us"]
    elif state == RUNNING:
        memory["heartbeat_next_us"] = t_us + FIRST_HEARTBEAT_US


@kernel
def _fail(memory: np.void, cause: int) -> None:
    memory["state"] = FAILED
    memory["start"][0]["cause"] = cause
    if memory["failure"] == 0:
        memory["failure"], memory["failed_state"] = _START_FAILED, memory["node_state"]


@kernel
def _on_time(config: np.void, memory: np.void, t_us: int) -> None:
    state, plan, start = memory["state"], config["start"][0], memory["start"][0]
    if state in (IDENTIFYING, CONFIGURING):
        if t_us >= start["answer_due_us"]:
            _ask_again(config, memory, t_us)
    elif t_us < start["deadline_us"]:
        return
    elif state == RESETTING and start["repeats_left"] > 0:
        start["repeats_left"] -= 1
        _reset(config, memory, t_us)
    elif state == RESETTING:  # it is asked all the same: its boot-up message may have been missed
        start["never_booted"] = 1
        _identify(config, memory, t_us)
    elif state == STARTING and start["repeats_left"] > 0:
        start["repeats_left"] -= 1
        start["deadline_us"] = t_us + plan["start_timeout_us"]
        put_nmt(config, memory, _START)
    else:
        _fail(memory, _NOT_STARTED if state == STARTING else _NOT_NOTICED)
        put_nmt(config, memory, _PRE_OPERATIONAL)


@kernel
def _on_heartbeat(config: np.void, memory: np.void, t_us: int) -> None:
    state, node_state = memory["state"], memory["node_state"]
    if node_state == _BOOT_UP:
        _on_boot_up(config, memory, t_us)
    elif state == STARTING and node_state == _OPERATIONAL:
        _on_started(config, memory, t_us)
    elif state == TRYING:
        _left_or_not(config, memory, t_us)


# -- reset --------------------------------------------------------------------------------------------------------


@kernel
def _reset(config: np.void, memory: np.void, t_us: int) -> None:
    memory["state"] = RESETTING
    memory["start"][0]["deadline_us"] = t_us + config["start"][0]["boot_timeout_us"]
    put_nmt(config, memory, _RESET)


@kernel
def _on_boot_up(config: np.void, memory: np.void, t_us: int) -> None:
    start = memory["start"][0]
    if start["never_booted"] != 0:  # it was only slow
        start["never_booted"] = 0
    elif memory["state"] != RESETTING:  # late answer to a repeated reset: what was written is lost
        if start["repeats_left"] == 0:
            _fail(memory, _BOOTS_AGAIN)
            return
        start["repeats_left"] -= 1
    _identify(config, memory, t_us)


# -- dialogue -----------------------------------------------------------------------------------------------------


@kernel
def _identify(config: np.void, memory: np.void, t_us: int) -> None:
    """A node that starts by itself (CiA 302-2, object 1F80h) is not configured while it is operational."""
    memory["state"] = IDENTIFYING
    start_plan.identify(config["start"][0], memory["start"][0])
    put_nmt(config, memory, _PRE_OPERATIONAL)
    _begin_to_ask(config, memory, t_us)


@kernel
def _begin_to_ask(config: np.void, memory: np.void, t_us: int) -> None:
    memory["start"][0]["position"] = memory["start"][0]["tries"] = 0
    _ask(config, memory, t_us)


@kernel
def _ask(config: np.void, memory: np.void, t_us: int) -> None:
    """The request of the open step."""
    start = memory["start"][0]
    start["tries"] += 1
    start["answer_due_us"] = t_us + config["start"][0]["sdo_timeout_us"]
    row, act = config["start"][0]["rows"][start["row"][start["position"]]], start["act"][start["position"]]
    if act < WRITE:
        _put_sdo(config, memory, row, sdo.UPLOAD, 0)
    else:
        _put_sdo(config, memory, row, sdo.download(int(row["size"])), start_plan.value_of(row, act))


@kernel
def _put_sdo(config: np.void, memory: np.void, row: np.void, command: int, value: int) -> None:
    word = sdo.message(command, int(row["index"]), int(row["subindex"]), value)
    put(config, memory, _SDO_OUT + config["node_id"], 8, word)


@kernel
def _ask_again(config: np.void, memory: np.void, t_us: int) -> None:
    """A request without an answer is aborted and repeated, until it was often enough."""
    start = memory["start"][0]
    gives_up = start["tries"] > config["start"][0]["retries"]
    if gives_up and start["never_booted"] != 0 and start["position"] == 0:
        _fail(memory, _NEVER_BOOTED)
        return
    row = start["row"][start["position"]]
    _put_sdo(config, memory, config["start"][0]["rows"][row], sdo.ABORT, _TIMED_OUT)
    if gives_up:
        _fail_step(memory, _NO_ANSWER, 0, 0)
    else:
        _ask(config, memory, t_us)


@kernel
def _fail_step(memory: np.void, cause: int, reply: int, size: int) -> None:
    """The open step can't be done; the words want to know what was answered."""
    start = memory["start"][0]
    start["cause_row"], start["reply"], start["reply_size"] = start["row"][start["position"]], reply, size
    if start["never_booted"] != 0 and start["position"] == 0:
        cause = _NEVER_BOOTED
    _fail(memory, cause)


@kernel
def _on_answer(config: np.void, memory: np.void, word: int, t_us: int) -> None:
    """One that does not belong to the open request (late, repeated, for another object) is ignored."""
    start = memory["start"][0]
    place, act = start["row"][start["position"]], start["act"][start["position"]]
    row = config["start"][0]["rows"][place]
    if word >> 8 & 0xFFFF != row["index"] or word >> 24 & 0xFF != row["subindex"]:
        return
    kind, value, is_write = sdo.kind_of(word), sdo.value_of(word), act >= WRITE
    if kind == _ABORTED and value == _TIMED_OUT:
        return  # the server has lost a transfer, too: our own time-out repeats it
    may_refuse = act == ASK or (is_write and row["flags"] & start_plan.MAY_DIFFER != 0)
    if may_refuse and (kind == _ABORTED or (kind == _OTHER and not is_write)):
        if kind == _ABORTED and value in (_NO_OBJECT, _NO_SUBINDEX):
            _note_absent(start, place)
        _next(config, memory, t_us)
    elif kind == _ABORTED:
        _fail_step(memory, _REFUSED, value, 0)
    elif kind == _OTHER and not is_write:
        _fail_step(memory, _NO_NUMBER, value, 0)
    elif is_write and kind == _WRITTEN:
        _next(config, memory, t_us)
    elif not is_write and kind == _READ:
        _on_value(config, memory, value, sdo.size_of(word), t_us)


@kernel
def _note_absent(start: np.void, place: int) -> None:
    """Once there is a plan it stands; what then turns out to be lacking holds nothing."""
    start["found"][place], start["known"][place] = 0, VALUE if start["is_planned"] != 0 else ABSENT


@kernel
def _on_value(config: np.void, memory: np.void, value: int, size: int, t_us: int) -> None:
    start = memory["start"][0]
    place, act = start["row"][start["position"]], start["act"][start["position"]]
    row = config["start"][0]["rows"][place]
    start["found"][place], start["known"][place] = value, VALUE
    is_compared = act == READ_BACK or (act == IDENTIFY and row["flags"] & ANY == 0)
    if size != 0 and size != row["size"]:
        _fail_step(memory, _SIZE, value, size)
    elif is_compared and (value ^ int(row["value"])) & ((1 << 8 * int(row["size"])) - 1) & ~int(row["alike"]) != 0:
        _fail_step(memory, _VALUE, value, size)
    else:
        _next(config, memory, t_us)


@kernel
def _next(config: np.void, memory: np.void, t_us: int) -> None:
    plan, start = config["start"][0], memory["start"][0]
    start["position"] += 1
    start["tries"] = 0
    if start["position"] < start["steps"]:
        _ask(config, memory, t_us)
    elif memory["state"] == IDENTIFYING:
        memory["state"] = CONFIGURING
        start_plan.survey(plan, start)
        _begin_to_ask(config, memory, t_us)
    elif start["is_planned"] == 0:
        _configure(config, memory, t_us)
    else:
        _end_dialogue(config, memory, t_us)


@kernel
def _configure(config: np.void, memory: np.void, t_us: int) -> None:
    plan, start = config["start"][0], memory["start"][0]
    refused = start_plan.plan(plan, start)
    if refused >= 0:
        start["cause_row"] = refused
        _fail(memory, _LACKS)
        return
    start["is_tried"] = 1 if start_plan.is_proven(plan, start) or start_plan.is_known(start) else 0
    _begin_to_ask(config, memory, t_us)


@kernel
def _end_dialogue(config: np.void, memory: np.void, t_us: int) -> None:
    plan, start, overflow = config["start"][0], memory["start"][0], 0
    for place in range(plan["count"]):
        if plan["rows"][place]["index"] == _OVERFLOW and start["known"][place] == VALUE:
            overflow = int(start["found"][place])
    if overflow == 1 or overflow > _OVERFLOW_MOST:
        start["reply"] = overflow
        _fail(memory, _SYNC_COUNTER)
        return
    if memory["sync_overflow"] != overflow:
        memory["sync_overflow"], memory["sync_count"] = overflow, 0
    memory["has_outputs"] = 1 if start_plan.has_group(plan, start, start_plan.OUTPUTS) else 0
    memory["signature"] = start_plan.signature(plan, start) if start_plan.is_signed(plan, start) else -1
    _start(config, memory, t_us)


# -- start and trial ----------------------------------------------------------------------------------------------


@kernel
def _start(config: np.void, memory: np.void, t_us: int) -> None:
    plan, start = config["start"][0], memory["start"][0]
    memory["state"] = STARTING
    start["repeats_left"] = plan["retries"]
    start["deadline_us"] = t_us + plan["start_timeout_us"]
    put(config, memory, config["our_heartbeat_id"], 1, _OPERATIONAL)
    put_nmt(config, memory, _START)


@kernel
def _on_started(config: np.void, memory: np.void, t_us: int) -> None:
    start = memory["start"][0]
    if start["is_tried"] != 0:
        memory["state"] = RUNNING
        return
    memory["state"] = TRYING
    start["times_left"] = 0
    start["deadline_us"] = t_us + config["start"][0]["trial_us"]


@kernel
def _left_or_not(config: np.void, memory: np.void, t_us: int) -> None:
    """It has left once it says so twice: one heartbeat may be damaged, late, or somebody else's."""
    start = memory["start"][0]
    start["times_left"] = start["times_left"] + 1 if memory["node_state"] != _OPERATIONAL else 0
    if start["times_left"] == 2:
        start["is_tried"] = 1
        start_plan.remember_tried(start)
        _start(config, memory, t_us)
