"""One period on the bus, compiled: what begins it, what comes, what answers. Driver, gate and cycle around one law,
over two records; nothing else goes out.

``begin``, ``on_frame``, ``period`` and ``finish`` leave what is to be sent in ``memory["driver"]["out"]``, each frame
with the gate's verdict on it. The words are in ``controller``.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.can import driver_rules, sense_input, start_sequence
from pkxyz_ctrl.can.driver_rules import (
    CONFIGURING,
    DRIVER,
    DRIVER_MEMORY,
    FAILED,
    FRESH,
    RUNNING,
    START_UP,
    drive,
    release,
)
from pkxyz_ctrl.can.other_traffic import TRAFFIC, forget, note
from pkxyz_ctrl.can.sense_input import take
from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop import outputs
from pkxyz_ctrl.safety import gate_rules
from pkxyz_ctrl.safety.gate_rules import GATE, GATE_MEMORY, check
from pkxyz_ctrl.safety.modes import NODE_EXPECTED, Event, Mode, next_mode
from pkxyz_ctrl.safety.trips import Trip

Records = NDArray[np.void]

EXCHANGE = np.dtype([("driver", DRIVER, (1,)), ("gate", GATE, (1,)), ("law", cycling.LAW, (1,))], align=True)

EXCHANGE_MEMORY = np.dtype(
    [
        ("driver", DRIVER_MEMORY, (1,)),
        ("gate", GATE_MEMORY, (1,)),
        ("held_against", GATE_MEMORY, (1,)),  # what the gate remembered when it last blocked a drive frame
        ("others", TRAFFIC, (1,)),
        ("begun_us", "i8"),  # when the period began
        ("blocked", "i4"),  # 1: the gate has blocked a frame since the last period
        ("event", "i4"),  # asked for at the next period
        ("clearing", "i4"),  # 1: a clear was asked for, and is not done yet
        ("restart_due", "i4"),  # 1: the fault is cleared, driver and node start anew
        ("is_restarting", "i4"),  # 1: that start is not done yet
        ("missed_ticks", "i4"),  # skipped, late on the wire, or without the sample that the node owed
        ("outputs", outputs.OUTPUTS, (1,)),
        ("cycle", cycling.MEMORY, (1,)),  # last, as in it what only some laws have
    ],
    align=True,
)

BLOCKED: Final = 1 << 8
"""Added to the number of frames where the gate blocks one of them."""
RESTARTED: Final = 1 << 9
"""Added by ``begin`` where gate, driver and node start anew."""
NOT_RESTARTED: Final = 1 << 10
"""Added by ``begin`` where that failed."""

_CLEAR, _GATE_BLOCKED, _CHANGED = int(Event.CLEAR), int(Trip.GATE_BLOCKED), int(Trip.SAFETY_OBJECTS)
_FOUND, _READY, _LOST = int(Event.NODE_FOUND), int(Event.NODE_READY), int(Event.NODE_LOST)
_SHORT_FRAMES_MOST: Final = 3  # that anybody asks for: outputs, our heartbeat and the node's
_SIGNATURE_TICKS: Final = 4  # in which it may come: when it is due, and a tick or two behind
_BOOT, _IDLE, _FAULT = int(Mode.BOOT), int(Mode.IDLE), int(Mode.FAULT)


@kernel
def switch_on(memory_array: Records) -> None:
    """Nothing has been sent or received."""
    driver_rules.switch_on(memory_array[0]["driver"])
    gate_rules.forget(memory_array[0]["gate"])
    forget(memory_array[0]["others"], 0)


@kernel
def start(config_array: Records, memory_array: Records, t_us: int) -> int:
    """The start-up begins, before there are periods. Returns the number of frames."""
    config, memory = config_array[0], memory_array[0]
    memory["driver"][0]["outgoing"] = 0
    forget(memory["others"], t_us)
    start_sequence.begin(config["driver"], memory["driver"], t_us)
    return judge(config, memory, 0, t_us)


@kernel
def wait(config_array: Records, memory_array: Records, t_us: int) -> int:
    """To be called where no frame comes during the start-up, every few milliseconds. Returns the number of frames."""
    config, memory = config_array[0], memory_array[0]
    memory["driver"][0]["outgoing"] = 0
    start_sequence.poll(config["driver"], memory["driver"], t_us)
    return judge(config, memory, 0, t_us)


@kernel
def come_up(memory_array: Records) -> int:
    """After ``wait`` and ``on_frame`` during the start-up: 1 once the node is operational and periods may begin, -1 if
    that failed, 0 until then.
    """
    memory = memory_array[0]
    state, cycle = memory["driver"][0]["state"], memory["cycle"][0]
    if state == FAILED or memory["blocked"] != 0:
        return -1
    if state == CONFIGURING and cycle["mode"] == _BOOT:
        cycle["mode"] = next_mode(cycle["mode"], _FOUND)
    if state != RUNNING:
        return 0
    cycle["mode"] = next_mode(cycle["mode"], _READY)
    return 1


@kernel
def begin(config_array: Records, memory_array: Records, t_us: int) -> int:
    """The period begins: SYNC, on which the amplifier applies the last voltages and samples. In FAULT the node is taken
    out of operational besides, since 0 V in a drive frame acts at a SYNC only. After a clear it is started again, one
    step a period. Returns the number of frames, with RESTARTED and NOT_RESTARTED.
    """
    config, memory = config_array[0], memory_array[0]
    memory["begun_us"] = t_us
    memory["driver"][0]["outgoing"] = 0
    told = _go_on_starting(config, memory, t_us) if memory["cycle"][0]["mode"] < _IDLE else 0
    driver_rules.sync(config["driver"], memory["driver"], t_us)
    is_changed = memory["cycle"][0]["row"]["trips"] & _CHANGED != 0  # what it does outside of operational: 0 V first
    if memory["cycle"][0]["mode"] == _FAULT and not is_changed:
        release(config["driver"], memory["driver"], t_us)
    return told | judge(config, memory, 0, t_us)


@kernel
def _go_on_starting(config: np.void, memory: np.void, t_us: int) -> int:
    """After a clear: one step of the start-up at the beginning of a period, without waiting for anything."""
    driver, told = memory["driver"][0], 0
    if memory["restart_due"] != 0 or (memory["clearing"] != 0 and driver["state"] == FAILED):
        memory["restart_due"] = memory["clearing"] = 0
        memory["is_restarting"], told = 1, RESTARTED
        gate_rules.clear(memory["gate"])
        start_sequence.begin(config["driver"], memory["driver"], t_us)
    else:
        start_sequence.poll(config["driver"], memory["driver"], t_us)
    state = driver["state"]
    if state == FAILED and memory["is_restarting"] != 0:
        memory["is_restarting"], memory["event"] = 0, _LOST
        return told | NOT_RESTARTED
    if state == CONFIGURING or (state == RUNNING and memory["cycle"][0]["mode"] == _BOOT):
        memory["event"] = _FOUND  # also if it was found and configured within one period
    elif state == RUNNING:
        memory["event"] = _READY
    return told


@kernel
def on_frame(
    config_array: Records, memory_array: Records, can_id: int, flags: int, length: int, word: int, t_us: int
) -> int:
    """A frame from the bus. Returns bits as ``driver_rules.receive``: FRESH once this period's sense values are in,
    START_UP where the start-up may have something to send.
    """
    config, memory = config_array[0], memory_array[0]
    memory["driver"][0]["outgoing"] = 0
    told = start_sequence.on_frame(config["driver"], memory["driver"], can_id, flags, length, word, t_us)
    if told & START_UP:
        judge(config, memory, 0, t_us)
    if told & FRESH == 0:
        driver = config["driver"][0]
        note(memory["others"], driver["node_id"], driver["sense"][0]["pdo"][0]["cob_id"], can_id, t_us)
    return told


@kernel
def period(config_array: Records, memory_array: Records, reference: Records, overrun: int) -> int:
    """The cycle on what has come since the SYNC; ``overrun`` periods were skipped before this one. Returns the mode
    that is left, -1 if it stays.
    """
    memory = memory_array[0]
    was = hand_over(memory_array, overrun)
    cycling.cycle(config_array[0]["law"], memory["cycle"], reference)
    outputs.decide(config_array[0]["law"], memory["cycle"], memory["outputs"], reference)
    return take_over(memory_array, was)


@kernel
def hand_over(memory_array: Records, overrun: int) -> int:
    """What has come since the SYNC becomes the cycle's input. Returns the mode."""
    memory = memory_array[0]
    driver, cycle = memory["driver"][0], memory["cycle"][0]
    seen, mode = cycle["input"], cycle["mode"]
    if memory["clearing"] != 0 and mode == _FAULT:
        memory["event"] = _CLEAR
    status = take(memory["driver"][0]["sense"])
    memory["missed_ticks"] += overrun
    if status & sense_input.SENSE_MISSING:  # a node that we took out of operation owes none
        memory["missed_ticks"] += NODE_EXPECTED[mode]
    else:
        forget(memory["others"], memory["begun_us"])
    if memory["blocked"] != 0:
        seen["trips"] = _GATE_BLOCKED
        memory["blocked"] = 0
    seen["event"], seen["sense_status"] = memory["event"], status
    seen["node_events"], seen["overrun"] = driver["node_events"], overrun
    seen["output_acting"] = driver["output"]
    for i in range(3):
        seen["sense_count"][i] = memory["driver"][0]["sense"][0]["count"][i]
    return mode


@kernel
def take_over(memory_array: Records, was: int) -> int:
    """After the cycle: returns the mode ``was`` if it was left, else -1."""
    memory = memory_array[0]
    memory["event"] = 0
    if memory["cycle"][0]["mode"] == was:
        return -1
    if was == _FAULT:
        memory["restart_due"] = 1
    return was


@kernel
def finish(config_array: Records, memory_array: Records, t_us: int, heartbeat_until_us: int) -> int:
    """The voltages of this period; behind them, as far as there is room before the next SYNC, new digital outputs and
    our heartbeat if it is due. A voltage that the gate blocks becomes 0 V under the same alive counter. Returns the
    number of frames.
    """
    config, memory = config_array[0], memory_array[0]
    driver, count = memory["driver"][0], memory["cycle"][0]["tick"]["count"]
    driver["outgoing"] = 0
    drive(config["driver"], memory["driver"], count[0, 0], count[0, 1], count[0, 2])
    told = judge(config, memory, 0, t_us)
    if told & BLOCKED:
        driver_rules.revoke_drive(memory["driver"])
        drive(config["driver"], memory["driver"], 0, 0, 0)
        if judge_one(config, memory, driver["out"][1], t_us) != 0:
            driver["outgoing"] = 1
    first, sent, until_us = driver["outgoing"], 0, heartbeat_until_us
    if _is_signature_near(config["driver"][0], driver):
        until_us -= config["driver"][0]["short_frame_us"]
    if memory["cycle"][0]["mode"] >= _IDLE and memory["cycle"][0]["mode"] != _FAULT and told & BLOCKED == 0:
        room = _short_frames(config["driver"][0], driver, memory["begun_us"], t_us, until_us)
        bits = memory["outputs"][0]["bits"]
        sent = _put_outputs(config["driver"], memory["driver"], bits, t_us, room)
    last_us = until_us - sent * config["driver"][0]["short_frame_us"]
    if driver["heartbeat_next_us"] <= t_us <= last_us:
        driver_rules.heartbeat(config["driver"], memory["driver"], t_us)
    told |= judge(config, memory, first, t_us)
    return told & BLOCKED | driver["outgoing"]


@kernel
def prepare(config_array: Records, memory_array: Records) -> None:
    """What can wait until the voltages are on their way: see ``cycle.prepare``."""
    cycling.prepare(config_array[0]["law"], memory_array[0]["cycle"])


@kernel
def _short_frames(config: np.void, memory: np.void, begun_us: int, t_us: int, until_us: int) -> int:
    """How many frames of one byte, up to ``_SHORT_FRAMES_MOST``, still fit behind a drive frame that is sent at
    ``t_us``, of which the first had to be sent by ``until_us``; the node's heartbeat, where it is due in the period
    that began at ``begun_us``, left out.
    """
    if t_us > until_us:
        return 0
    room, left_us = 1, until_us - t_us - config["short_frame_us"]
    while left_us >= 0 and room < _SHORT_FRAMES_MOST:  # a division of 64 bits takes a board longer than its law
        room, left_us = room + 1, left_us - config["short_frame_us"]
    ahead_us = memory["node_heartbeat_us"] + config["node_period_us"] - begun_us
    return room - 1 if -config["period_us"] < ahead_us <= 2 * config["period_us"] else room


@kernel
def _is_signature_near(config: np.void, memory: np.void) -> bool:
    """Whether the node may send its signature in this period, or would have to: one that is lost is not waited for."""
    every = config["signature_syncs"]
    over = memory["signature_age"] + 1 - every
    return bool(
        memory["signature"] >= 0 and (0 <= over < _SIGNATURE_TICKS or every <= over < every + _SIGNATURE_TICKS)
    )  # a third is not waited for: without two the node has tripped


@kernel
def _put_outputs(config_array: Records, memory_array: Records, bits: int, t_us: int, room: int) -> int:
    """RPDO 1 with what the digital outputs are to be from the next SYNC on, where that is something new and there is
    ``room`` for it. Our heartbeat, if it is due, waits for it as long as it may. A bit that rose and found no room goes
    out in the next tick, however short it was. Returns how many frames there are: 0 or 1.
    """
    config, memory = config_array[0], memory_array[0]
    if memory["has_outputs"] == 0 or memory["state"] != RUNNING:
        return 0
    bits |= memory["output_owed"]
    if bits == memory["output"]:
        return 0
    is_heartbeat_first = t_us - memory["heartbeat_next_us"] >= config["heartbeat_wait_us"]
    if room < (2 if is_heartbeat_first else 1):
        memory["output_owed"] |= bits & ~memory["output"]
        return 0
    driver_rules.put(config, memory, config["output_id"], 1, bits)
    memory["output"], memory["output_owed"] = bits, 0
    return 1


@kernel
def ask_to_clear(memory_array: Records) -> None:
    """Somebody asks to forget the fault; without one, nothing happens."""
    memory = memory_array[0]
    mode = memory["cycle"][0]["mode"]
    is_failed = mode < _IDLE and memory["driver"][0]["state"] == FAILED
    memory["clearing"] = 1 if mode == _FAULT or is_failed else 0


@kernel
def stop(config_array: Records, memory_array: Records, t_us: int) -> int:
    """0 V and pre-operational, whatever the mode. Returns the number of frames."""
    config, memory = config_array[0], memory_array[0]
    memory["driver"][0]["outgoing"] = 0
    driver_rules.stop(config["driver"], memory["driver"])
    return judge(config, memory, 0, t_us)


@kernel
def judge(config: np.void, memory: np.void, first: int, t_us: int) -> int:
    """The gate's verdict on all frames from ``first`` on. Returns how many stand there in all, and BLOCKED."""
    driver, told = memory["driver"][0], 0
    for place in range(first, driver["outgoing"]):
        if judge_one(config, memory, driver["out"][place], t_us) != 0:
            memory["blocked"] = 1
            told = BLOCKED
    return told | driver["outgoing"]


@kernel
def judge_one(config: np.void, memory: np.void, frame: np.void, t_us: int) -> int:
    """The verdict on one frame, 0 if it may be sent."""
    reason = check(
        config["gate"], memory["gate"],
        frame["can_id"], frame["flags"], frame["length"], frame["data"], memory["cycle"][0]["mode"], t_us,
    )  # fmt: skip
    frame["reason"] = reason
    if reason != 0 and frame["can_id"] == config["gate"][0]["drive_id"]:
        remember(memory["gate"][0], memory["held_against"][0])
    return reason


@kernel
def remember(gate: np.void, copy: np.void) -> None:
    """What the gate holds a drive frame against, for the words."""
    copy["time_us"], copy["counter_next"] = gate["time_us"], gate["counter_next"]
    for i in range(3):
        copy["count"][i] = gate["count"][i]
