"""One period on the bus, compiled: what begins it, what comes, what answers. Driver, gate and cycle around one law,
over two records; nothing else goes out.

``begin``, ``on_frame``, ``period`` and ``finish`` leave what is to be sent in ``memory["driver"]["out"]``, each frame
with the gate's verdict on it. The words are in ``controller``.
"""

from typing import Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pkxyz_ctrl.can import driver_rules, sense_input
from pkxyz_ctrl.can.driver_rules import DRIVER, DRIVER_MEMORY, FRESH, drive, receive, release
from pkxyz_ctrl.can.other_traffic import TRAFFIC, forget, note
from pkxyz_ctrl.can.sense_input import take
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.safety import gate_rules
from pkxyz_ctrl.safety.gate_rules import GATE, GATE_MEMORY, check
from pkxyz_ctrl.safety.modes import NODE_EXPECTED, Event, Mode
from pkxyz_ctrl.safety.trips import Trip

Records = NDArray[np.void]

EXCHANGE = np.dtype([("driver", DRIVER, (1,)), ("gate", GATE, (1,)), ("law", cycling.LAW, (1,))], align=True)

EXCHANGE_MEMORY = np.dtype(
    [
        ("driver", DRIVER_MEMORY, (1,)),
        ("gate", GATE_MEMORY, (1,)),
        ("held_against", GATE_MEMORY, (1,)),  # what the gate remembered when it last blocked a drive frame
        ("others", TRAFFIC, (1,)),
        ("cycle", cycling.MEMORY, (1,)),
        ("begun_us", "i8"),  # when the period began
        ("blocked", "i4"),  # 1: the gate has blocked a frame since the last period
        ("event", "i4"),  # asked for at the next period
        ("clearing", "i4"),  # 1: a clear was asked for, and is not done yet
        ("restart_due", "i4"),  # 1: the fault is cleared, driver and node start anew
        ("missed_ticks", "i4"),  # skipped, late on the wire, or without the sample that the node owed
    ],
    align=True,
)

BLOCKED: Final = 1 << 8
"""Added to the number of frames where the gate blocks one of them."""

_CLEAR, _GATE_BLOCKED = int(Event.CLEAR), int(Trip.GATE_BLOCKED)
_FAULT: Final = int(Mode.FAULT)


@njit(cache=True, error_model="numpy")
def switch_on(memory_array: Records) -> None:
    """Nothing has been sent or received."""
    driver_rules.switch_on(memory_array[0]["driver"])
    gate_rules.forget(memory_array[0]["gate"])
    forget(memory_array[0]["others"], 0)


@njit(cache=True, error_model="numpy")
def begin(config_array: Records, memory_array: Records, t_us: int) -> int:
    """The period begins: SYNC, on which the amplifier applies the last voltages and samples. In FAULT the node is taken
    out of operational besides, since 0 V in a drive frame acts at a SYNC only. Returns the number of frames.
    """
    config, memory = config_array[0], memory_array[0]
    memory["begun_us"] = t_us
    memory["driver"][0]["outgoing"] = 0
    driver_rules.sync(config["driver"], memory["driver"], t_us)
    if memory["cycle"][0]["mode"] == _FAULT:
        release(config["driver"], memory["driver"], t_us)
    return judge(config, memory, 0, t_us)


@njit(cache=True, error_model="numpy")
def on_frame(
    config_array: Records, memory_array: Records, can_id: int, flags: int, length: int, word: int, t_us: int
) -> int:
    """A frame from the bus. Returns bits as ``driver_rules.receive``: FRESH once this period's sense values are in."""
    config, memory = config_array[0], memory_array[0]
    told = receive(config["driver"], memory["driver"], can_id, flags, length, word, t_us)
    if told & FRESH == 0:
        driver = config["driver"][0]
        note(memory["others"], driver["node_id"], driver["sense"][0]["pdo"][0]["cob_id"], can_id, t_us)
    return told


@njit(cache=True, error_model="numpy")
def period(config_array: Records, memory_array: Records, reference: Records, overrun: int) -> int:
    """The cycle on what has come since the SYNC; ``overrun`` periods were skipped before this one. Returns the mode
    that is left, -1 if it stays.
    """
    memory = memory_array[0]
    was = hand_over(memory_array, overrun)
    cycling.cycle(config_array[0]["law"], memory["cycle"], reference)
    return take_over(memory_array, was)


@njit(cache=True, error_model="numpy")
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
    for i in range(3):
        seen["sense_count"][i] = memory["driver"][0]["sense"][0]["count"][i]
    return mode


@njit(cache=True, error_model="numpy")
def take_over(memory_array: Records, was: int) -> int:
    """After the cycle: returns the mode ``was`` if it was left, else -1."""
    memory = memory_array[0]
    memory["event"] = 0
    if memory["cycle"][0]["mode"] == was:
        return -1
    if was == _FAULT:
        memory["restart_due"] = 1
    return was


@njit(cache=True, error_model="numpy")
def finish(config_array: Records, memory_array: Records, t_us: int, heartbeat_until_us: int) -> int:
    """The voltages of this period, and our heartbeat behind them if it is due and still fits before the next SYNC. A
    voltage that the gate blocks becomes 0 V under the same alive counter. Returns the number of frames.
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
    if driver["heartbeat_next_us"] <= t_us <= heartbeat_until_us:
        first = driver["outgoing"]
        driver_rules.heartbeat(config["driver"], memory["driver"], t_us)
        told |= judge(config, memory, first, t_us)
    return told & BLOCKED | driver["outgoing"]


@njit(cache=True, error_model="numpy")
def stop(config_array: Records, memory_array: Records, t_us: int) -> int:
    """0 V and pre-operational, whatever the mode. Returns the number of frames."""
    config, memory = config_array[0], memory_array[0]
    memory["driver"][0]["outgoing"] = 0
    driver_rules.stop(config["driver"], memory["driver"])
    return judge(config, memory, 0, t_us)


@njit(cache=True, error_model="numpy")
def judge(config: np.void, memory: np.void, first: int, t_us: int) -> int:
    """The gate's verdict on all frames from ``first`` on. Returns how many stand there in all, and BLOCKED."""
    driver, told = memory["driver"][0], 0
    for place in range(first, driver["outgoing"]):
        if judge_one(config, memory, driver["out"][place], t_us) != 0:
            memory["blocked"] = 1
            told = BLOCKED
    return told | driver["outgoing"]


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def remember(gate: np.void, copy: np.void) -> None:
    """What the gate holds a drive frame against, for the words."""
    copy["time_us"], copy["counter_next"] = gate["time_us"], gate["counter_next"]
    for i in range(3):
        copy["count"][i] = gate["count"][i]
