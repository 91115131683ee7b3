"""What happens in a tick between controller, wire, node and plant, compiled: frames end, the node answers, time passes.

What a kernel here can't play it leaves alone and says so; the tick is then undone.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.bus import wire_rules
from hil.bus.log_lines import write_line
from hil.bus.wire_rules import WIRE
from hil.faults.channels import at_faulty_look, at_faulty_sync
from hil.faults.frame_rules import meets
from hil.node import rules
from pkxyz_ctrl.compiled.kernel import kernel

Records = NDArray[np.void]
Bytes = NDArray[np.uint8]
Stage = tuple[Records, Records, Records, Records, Records]
"""Parameters and state of the plant, ``on_bus.RECORD``, its faulty ``CHANNEL``s, and the ``DICE`` that they roll."""
Line = tuple[Records, Records, Bytes, Bytes]
"""``RULE``s of the wire with their ``DICE``; the log: its channel's name, and room for its text."""

INBOX: Final = 4  # frames that came behind the one that a tick waited for
NEVER_US: Final = 1 << 62
CONTROLLER: Final = 0  # numbers of ``faults.wire.SENDERS``
AMPLIFIER: Final = 1
REFUSED, HEARD, SAMPLED = range(3)
"""What becomes of a frame: it can't be played, it is taken, the plant is to be sampled."""

BENCH = np.dtype(
    [
        ("wire", WIRE, (1,)),
        ("inbox", wire_rules.FRAME, (INBOX,)),
        ("t_us", "i8"),  # when the next tick begins
        ("late_us", "i8"),  # how much later the controller begins it
        ("horizon_us", "i8"),  # from here on something else is to happen
        ("plant_us", "i8"),  # of the last exchange, by the plant's own time
        ("origin_us", "i8"),  # the plant's time 0
        ("period_us", "i8"),
        ("compute_us", "i8"),
        ("answer_us", "i8"),
        ("heartbeat_us", "i8"),
        ("logged", "i8"),  # bytes of the log
        ("frames", "i8"),  # in it
        ("commanded", "i4", (3,)),  # counts that the node last put out
        ("received", "i4"),  # frames in the inbox
        ("rules", "i4"),  # of the wire that are on
        ("node_state", "i4"),  # as its heartbeat says it; rules.DEAF: it takes nothing
        ("was_sampled", "i4"),  # since the last row
        ("is_disturbed", "i4"),  # 1: something acts on the plant besides the node's voltages
        ("is_logged", "i4"),
        ("is_watched", "i4"),  # 1: the combs are looked at behind each tick
        ("is_begun_anew", "i4"),  # 1: a tick that ends in ENABLED is left to the other way
    ],
    align=True,
)
"""What lies between controller, node and plant, and what is agreed between them."""


@kernel
def send(memory: Records, wire: np.void, count: int, now_us: int) -> bool:
    """Put what the controller wants to send on the wire."""
    for place in range(count):
        out = memory[0]["driver"][0]["out"][place]
        if not wire_rules.send(wire, CONTROLLER, out["can_id"], out["flags"], out["length"], out["data"], now_us):
            return False
    return True


@kernel
def take_first(lane: np.void) -> None:
    """The oldest frame of the inbox has been read."""
    lane["received"] -= 1
    for place in range(lane["received"]):
        _copy(lane["inbox"][place + 1], lane["inbox"][place])


@kernel
def _copy(frame: np.void, to: np.void) -> None:
    to["word"], to["can_id"], to["length"], to["flags"] = (
        frame["word"], frame["can_id"], frame["length"], frame["flags"]
    )  # fmt: skip


@kernel
def next_us(lane: np.void, memory: np.void) -> int:
    """When something happens next."""
    soonest_us = min(lane["wire"][0]["end_us"], memory["due_us"])
    if lane["node_state"] == rules.OPERATIONAL:
        return int(soonest_us)
    return int(min(soonest_us, memory["beat_us"]))


@kernel
def pass_time(lane: np.void, node: np.void, memory: np.void, stage: Stage, line: Line, until_us: int) -> bool:
    """Let everything happen that is due until then, then included. False for what can't be played."""
    now_us = next_us(lane, memory)
    while now_us <= until_us:
        if not happen(lane, node, memory, stage, line, now_us):
            return False
        now_us = next_us(lane, memory)
    return bool(_left_alone_us(lane, memory) > until_us)


@kernel
def _left_alone_us(lane: np.void, memory: np.void) -> int:
    """When the node does something that is not played here."""
    if lane["node_state"] == rules.OPERATIONAL:
        return int(rules.next_alarm_us(memory))
    return int(memory["consumer_us"])


@kernel
def happen(lane: np.void, node: np.void, memory: np.void, stage: Stage, line: Line, now_us: int) -> bool:
    """What is due now: a frame has ended, the node's response time has, or at rest its heartbeat. False for two at
    once, and for something else.
    """
    wire = lane["wire"][0]
    if wire["end_us"] != now_us:
        return _act(lane, node, memory, now_us)
    if not _is_alone(lane, memory, now_us):
        return False
    wire_rules.end(wire)
    frame, is_lost = wire["done"][0], False
    if lane["rules"] != 0:
        met = meets(line[0], line[1], lane["rules"], frame["can_id"], frame["sender"])
        if met >= 0 and line[0][met]["is_loss"] == 0:
            return False
        is_lost = met >= 0
    if lane["is_logged"] != 0 and not is_lost:
        lane["frames"] += 1
        lane["logged"] = write_line(
            line[3], lane["logged"], line[2], now_us, frame["can_id"], frame["flags"], frame["length"], frame["word"]
        )
    told = HEARD
    if not is_lost:
        wire_rules.received(wire)
        told = _hear(lane, node, memory, frame, now_us)
    if told == SAMPLED:
        _exchange(lane, memory, stage, now_us)
    wire_rules.arbitrate(wire, now_us)
    return bool(told != REFUSED)


@kernel
def _is_alone(lane: np.void, memory: np.void, now_us: int) -> bool:
    """Whether nothing of the node's is due now."""
    if _left_alone_us(lane, memory) <= now_us or memory["due_us"] == now_us:
        return False
    return bool(lane["node_state"] == rules.OPERATIONAL or memory["beat_us"] != now_us)


@kernel
def _act(lane: np.void, node: np.void, memory: np.void, now_us: int) -> bool:
    """The node acts by itself."""
    if _left_alone_us(lane, memory) <= now_us:
        return False
    if lane["node_state"] == rules.OPERATIONAL:
        return _answer(node, memory, lane["wire"][0], now_us)
    return _beat(node, memory, lane, now_us)


@kernel
def _hear(lane: np.void, node: np.void, memory: np.void, frame: np.void, now_us: int) -> int:
    """A frame reaches the other side."""
    can_id, length, word = frame["can_id"], frame["length"], frame["word"]
    if frame["sender"] == AMPLIFIER:
        return HEARD if _keep(lane, frame) else REFUSED
    if lane["node_state"] == rules.DEAF:
        return HEARD
    if lane["node_state"] == rules.STOPPED:
        return HEARD if rules.on_frame_stopped(node, memory, can_id, length, word, now_us) else REFUSED
    if lane["node_state"] != rules.OPERATIONAL:
        if can_id == node["request_id"]:
            return HEARD if _serve(node, memory, lane["wire"][0], length, word, now_us) else REFUSED
        return HEARD if rules.on_frame_at_rest(node, memory, can_id, length, word, now_us) else REFUSED
    if can_id == node["drive_id"]:
        return HEARD if rules.on_drive(node, memory, length, word, now_us) else REFUSED
    if can_id == node["output_id"]:
        return HEARD if rules.on_digital(memory, length, word) else REFUSED
    if can_id == node["consumer_id"]:
        return HEARD if rules.on_heartbeat(node, memory, length, word, now_us) else REFUSED
    if can_id == node["sync_id"] and rules.on_sync(node, memory, length, word, now_us):
        return SAMPLED
    return REFUSED


@kernel
def _serve(node: np.void, memory: np.void, wire: np.void, length: int, word: int, now_us: int) -> bool:
    """An SDO request."""
    reply = rules.read(node, memory, length, word)
    if reply == 0:
        return False
    return bool(wire_rules.send(wire, AMPLIFIER, node["reply_id"], node["flags"], rules.LENGTH, reply, now_us))


@kernel
def _keep(lane: np.void, frame: np.void) -> bool:
    if lane["received"] == INBOX:
        return False
    _copy(frame, lane["inbox"][lane["received"]])
    lane["received"] += 1
    return True


@kernel
def _exchange(lane: np.void, memory: np.void, stage: Stage, now_us: int) -> None:
    """The converters take the output, and the sense combs are sampled."""
    output, count, target_us = memory["output"], memory["count"], now_us - lane["origin_us"]
    for comb in range(3):
        lane["commanded"][comb] = output[comb]
    count[0], count[1], count[2] = at_faulty_sync(
        stage[0], stage[1], stage[2], stage[3], stage[4], target_us, target_us - lane["plant_us"],
        output[0], output[1], output[2],
    )  # fmt: skip
    lane["plant_us"], lane["was_sampled"] = target_us, 1
    stage[2][0]["terminal_output"] = memory["digital"]


@kernel
def look(lane: np.void, stage: Stage, now_us: int) -> None:
    """The truth is brought to now, without a sample."""
    counts, target_us = lane["commanded"], now_us - lane["origin_us"]
    at_faulty_look(
        stage[0], stage[1], stage[2], stage[3], target_us, target_us - lane["plant_us"], lane["is_disturbed"] != 0,
        counts[0], counts[1], counts[2],
    )  # fmt: skip
    lane["plant_us"] = target_us


@kernel
def _answer(node: np.void, memory: np.void, wire: np.void, now_us: int) -> bool:
    """The node's sense PDO, and behind it its heartbeat if the next one would be too late, else the signature if it
    waits.
    """
    word, flags = rules.answer(node, memory), node["flags"]
    if not wire_rules.send(wire, AMPLIFIER, node["sense_id"], flags, rules.LENGTH, word, now_us):
        return False
    if rules.rides(node, memory, now_us):
        return bool(wire_rules.send(wire, AMPLIFIER, node["heartbeat_id"], flags, 1, rules.OPERATIONAL, now_us))
    if memory["signature_waits"] == 0:
        return True
    memory["signature_waits"] = 0
    return bool(wire_rules.send(wire, AMPLIFIER, node["signature_id"], flags, 2, node["signature"], now_us))


@kernel
def _beat(node: np.void, memory: np.void, lane: np.void, now_us: int) -> bool:
    """The heartbeat of a node at rest."""
    memory["beat_us"] = now_us + node["beat_period_us"]
    wire, state = lane["wire"][0], lane["node_state"]
    return bool(wire_rules.send(wire, AMPLIFIER, node["heartbeat_id"], node["flags"], 1, state, now_us))
