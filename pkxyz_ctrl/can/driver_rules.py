"""The driver at work, compiled: frames in, frames out, time passed in; why it gave up as a number.

A frame is its identifier, flags, length and ``word``, its first eight bytes as an integer, the first one lowest. What
is to be sent stands in ``memory["out"]``, ``memory["outgoing"]`` frames of it. The words are in ``driver``.
"""

from enum import Enum, IntEnum, auto
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.can import cob_id, process_pdo, sense_input
from pkxyz_ctrl.can.cob_id import NmtCommand, NmtState
from pkxyz_ctrl.can.frame import UNUSUAL
from pkxyz_ctrl.can.start_plan import START, START_MEMORY
from pkxyz_ctrl.compiled.division import into_period
from pkxyz_ctrl.compiled.kernel import kernel

Records = NDArray[np.void]


class DriverState(Enum):
    """Where the connection to the amplifier is."""

    OFF = auto()
    RESETTING = auto()
    IDENTIFYING = auto()
    CONFIGURING = auto()
    STARTING = auto()
    TRYING = auto()
    OPERATIONAL = auto()
    FAILED = auto()
    RELEASING = auto()
    RELEASED = auto()


class Failure(IntEnum):
    """Why the connection is lost."""

    NONE = 0
    HEARTBEAT_LOST = 1
    NOT_OPERATIONAL = 2
    REBOOTED = 3
    START_UP = 4


NODE_HEARTBEAT_LOST = 1
NODE_NOT_OPERATIONAL = 2
NODE_REBOOTED = 4
NODE_EMERGENCY = 8
FOREIGN_FRAME = 16
SAFETY_OBJECTS = 32

# what ``receive`` returns, one bit each
FRESH: Final = 1  # this tick's sense values are here
EMERGENCY: Final = 2  # one that counts: it stands in ``memory["emergency"]``
START_UP: Final = 4  # a frame for the start-up

NEVER_US: Final = 1 << 62
OUTGOING_MOST: Final = 6

OUTGOING = np.dtype(
    [
        ("data", "i8"),  # its first eight bytes as they lie in memory, little endian
        ("can_id", "i4"),
        ("flags", "i4"),  # 1: FD, 2: with bit-rate switch
        ("length", "i4"),
        ("reason", "i4"),  # why the gate does not let it out; 0: to be sent
    ],
    align=True,
)

DRIVER = np.dtype(
    [
        ("sense", sense_input.SENSE, (1,)),
        ("drive", process_pdo.PDO, (1,)),
        ("start", START, (1,)),
        ("node_id", "i4"),
        ("flags", "i4"),  # of the frames that we send
        ("our_heartbeat_id", "i4"),
        ("output_id", "i4"),  # of RPDO 1; -1: no digital outputs are asked for
        ("signature_id", "i4"),  # of the TPDO with the node's signature of its safety objects; -1: none is asked for
        ("signature_syncs", "i4"),  # between two of them
        ("short_frame_us", "i8"),  # what a frame of one byte takes at most
        ("period_us", "i8"),  # of the loop
        ("heartbeat_wait_us", "i8"),  # how long ours may be put off
        ("heartbeat_period_us", "i8"),  # of ours
        ("node_period_us", "i8"),  # of the node's
        ("node_timeout_us", "i8"),
    ],
    align=True,
)

DRIVER_MEMORY = np.dtype(
    [
        ("sense", sense_input.SENSE_MEMORY, (1,)),
        ("start", START_MEMORY, (1,)),
        ("out", OUTGOING, (OUTGOING_MOST,)),
        ("node_heartbeat_us", "i8"),  # when the node's last one came
        ("node_deadline_us", "i8"),  # of the next; far away while nobody is watched
        ("heartbeat_next_us", "i8"),  # when ours is due
        ("silent_us", "i8"),  # how much longer than its time-out the node had been silent when it was given up
        ("foreign_data", "i8"),  # first eight bytes of the first frame that only we may send, and did not
        ("emergency", "i8"),  # the eight bytes of the node's last
        ("emergency_us", "i8"),  # when it came
        ("outgoing", "i4"),  # frames in ``out``
        ("state", "i4"),
        ("failure", "i4"),  # the first cause
        ("failed_state", "i4"),  # what the node's heartbeat said then
        ("node_events", "i4"),
        ("node_state", "i4"),  # as its last heartbeat said; -1: none came
        ("drive_counter", "i4"),  # of the next drive frame
        ("sync_count", "i4"),  # of the last SYNC; 0: none
        ("sync_overflow", "i4"),  # SYNCs count from 1 to this; 0: they don't
        ("foreign_id", "i4"),  # -1: none
        ("foreign_length", "i4"),
        ("has_outputs", "i4"),  # 1: the node has the digital outputs that are asked for
        ("output", "i4"),  # bits that the node was sent last
        ("output_owed", "i4"),  # bits that rose and had to wait
        ("signature", "i4"),  # of what was read back at the start; -1: the node does not tell it at work
        ("signature_age", "i4"),  # SYNCs since it was told last
    ],
    align=True,
)

# CiA 301 and DriverState, as the kernels use them
_NMT, _SYNC, _EMCY, _SDO_IN = cob_id.NMT, cob_id.SYNC, cob_id.EMCY_BASE, cob_id.SDO_RESPONSE_BASE
_SDO_OUT, _HEARTBEAT = cob_id.SDO_REQUEST_BASE, cob_id.HEARTBEAT_BASE
_BOOT_UP, _OPERATIONAL = int(NmtState.BOOT_UP), int(NmtState.OPERATIONAL)
_PRE_OPERATIONAL, _RESET = int(NmtCommand.PRE_OPERATIONAL), int(NmtCommand.RESET_NODE)
OFF, RESETTING, IDENTIFYING, CONFIGURING, STARTING, TRYING, RUNNING, FAILED, RELEASING, RELEASED = (
    state.value for state in DriverState
)
_LOST, _LEFT, _REBOOTED = int(Failure.HEARTBEAT_LOST), int(Failure.NOT_OPERATIONAL), int(Failure.REBOOTED)
_APART_US: Final = 1000  # of heartbeats: some ticks; where a tick is longer, both fit into it
_HEARTBEAT_ERROR: Final = 0x8130  # EMCY: what the node has to say in the trial
_SYNC_COUNTER_OVERFLOW: Final = cob_id.SYNC_COUNTER_OVERFLOW


@kernel
def put(config: np.void, memory: np.void, can_id: int, length: int, data: int) -> None:
    """One more frame to send."""
    place = memory["outgoing"]
    if place < OUTGOING_MOST:
        out = memory["out"][place]
        out["data"], out["can_id"], out["flags"], out["length"] = data, can_id, config["flags"], length
        out["reason"] = 0
        memory["outgoing"] = place + 1


@kernel
def start(memory_array: Records) -> None:
    """Counters, events and failure anew; the start-up begins."""
    memory = memory_array[0]
    sense_input.reset(memory["sense"])
    memory["failure"] = memory["node_events"] = memory["sync_count"] = memory["drive_counter"] = 0
    memory["node_state"] = memory["foreign_id"] = memory["signature"] = -1
    memory["has_outputs"] = memory["output"] = memory["output_owed"] = memory["signature_age"] = 0
    fall_silent(memory)


@kernel
def switch_on(memory_array: Records) -> None:
    """Nothing has been sent or received, ever."""
    memory = memory_array[0]
    start(memory_array)
    memory["state"] = OFF
    memory["sync_overflow"] = _SYNC_COUNTER_OVERFLOW
    memory["outgoing"] = 0
    memory["node_heartbeat_us"] = 0


@kernel
def fall_silent(memory: np.void) -> None:
    """Nobody is watched, and our heartbeat stays away."""
    memory["node_deadline_us"] = memory["heartbeat_next_us"] = NEVER_US


@kernel
def stop(config_array: Records, memory_array: Records) -> None:
    """0 V, then NMT pre-operational, where the node's outputs take their error value (0 V). State OFF."""
    config, memory = config_array[0], memory_array[0]
    fall_silent(memory)
    memory["state"] = OFF
    drive(config_array, memory_array, 0, 0, 0)
    put_nmt(config, memory, _PRE_OPERATIONAL)


@kernel
def release(config_array: Records, memory_array: Records, t_us: int) -> None:
    """What takes the node out of operational, again and again, until its heartbeat says that it has left; from then on
    our heartbeat. One whose safety objects were changed is reset, since its error values may be voltages by now.
    """
    config, memory = config_array[0], memory_array[0]
    if memory["state"] == RELEASED:
        if t_us >= memory["heartbeat_next_us"]:
            heartbeat(config_array, memory_array, t_us)
        return
    fall_silent(memory)
    is_changed = memory["state"] == RUNNING and memory["node_events"] & SAFETY_OBJECTS != 0
    memory["state"], memory["output"], memory["output_owed"] = RELEASING, 0, 0
    put_nmt(config, memory, _RESET if is_changed else _PRE_OPERATIONAL)


@kernel
def sync(config_array: Records, memory_array: Records, t_us: int) -> None:
    """The SYNC that begins a tick. What was received before is old from now on."""
    config, memory = config_array[0], memory_array[0]
    watch(memory, t_us)
    sense_input.on_sync(config["sense"], memory["sense"])
    if memory["signature"] >= 0:
        memory["signature_age"] += 1
        if memory["signature_age"] > 2 * config["signature_syncs"] + 2 and memory["state"] == RUNNING:
            memory["node_events"] |= SAFETY_OBJECTS
    overflow = memory["sync_overflow"]
    if overflow == 0:
        put(config, memory, _SYNC, 0, 0)
        return
    memory["sync_count"] = memory["sync_count"] + 1 if memory["sync_count"] < overflow else 1
    put(config, memory, _SYNC, 1, memory["sync_count"])


@kernel
def drive(config_array: Records, memory_array: Records, first: int, second: int, third: int) -> None:
    """The drive PDO, with its alive counter. A count that has no room in it becomes -1, which no gate lets pass."""
    config, memory = config_array[0], memory_array[0]
    pdo, counter = config["drive"], int(memory["drive_counter"])
    word = process_pdo.encode(pdo, _in_range(first), _in_range(second), _in_range(third), counter)
    put(config, memory, pdo[0]["cob_id"], pdo[0]["length"], word)
    memory["drive_counter"] = counter + 1 & 0xFF


@kernel
def _in_range(count: int) -> int:
    return int(count) if -32768 <= count <= 32767 else -1


@kernel
def revoke_drive(memory_array: Records) -> None:
    """The last drive PDO is not sent after all: its alive counter is the next one's."""
    memory_array[0]["drive_counter"] = memory_array[0]["drive_counter"] - 1 & 0xFF


@kernel
def heartbeat(config_array: Records, memory_array: Records, t_us: int) -> None:
    """Ours; the next one is due a period after this one was due. Periods that were missed are skipped whole."""
    put(config_array[0], memory_array[0], config_array[0]["our_heartbeat_id"], 1, _OPERATIONAL)
    heartbeat_sent(config_array, memory_array, t_us)


@kernel
def heartbeat_sent(config_array: Records, memory_array: Records, t_us: int) -> None:
    """Ours went out at ``t_us``."""
    config, memory = config_array[0], memory_array[0]
    if t_us >= memory["heartbeat_next_us"]:
        period_us = config["heartbeat_period_us"]
        memory["heartbeat_next_us"] = t_us + period_us - into_period(t_us - memory["heartbeat_next_us"], period_us)
        _keep_away(config, memory, t_us)


@kernel
def _keep_away(config: np.void, memory: np.void, t_us: int) -> None:
    """A tick has room for one heartbeat: where ours would meet one of the node's, it goes out a little earlier, but not
    now, where the node's has just come.
    """
    if memory["state"] == RUNNING:
        period_us = config["node_period_us"]
        after_us = into_period(memory["heartbeat_next_us"] - memory["node_heartbeat_us"] + _APART_US, period_us)
        is_near = after_us < 2 * _APART_US < period_us
        if is_near and memory["heartbeat_next_us"] - after_us > t_us:
            memory["heartbeat_next_us"] -= after_us


@kernel
def watch(memory: np.void, t_us: int) -> None:
    """Give up a node that was silent for too long."""
    if t_us > memory["node_deadline_us"]:
        memory["node_events"] |= NODE_HEARTBEAT_LOST
        memory["silent_us"] = t_us - memory["node_deadline_us"]
        _fail(memory, _LOST)


@kernel
def receive(
    config_array: Records, memory_array: Records, can_id: int, flags: int, length: int, word: int, t_us: int
) -> int:
    """Takes any frame from the bus; returns bits of FRESH, EMERGENCY, START_UP."""
    config, memory = config_array[0], memory_array[0]
    node_id, sense, told = config["node_id"], memory["sense"], 0
    if flags & UNUSUAL:
        pass
    elif can_id == config["sense"][0]["pdo"][0]["cob_id"]:
        sense_input.receive(config["sense"], sense, length, word)
    elif can_id == _HEARTBEAT + node_id:
        if length == 1:
            told = _on_heartbeat(config, memory, word & 0x7F, t_us)  # bit 7 is the toggle bit of node guarding
    elif can_id == _SDO_IN + node_id:
        told = START_UP if is_starting_up(memory["state"]) else 0
    elif can_id == _EMCY + node_id:
        if length == 8:
            told = _on_emergency(memory, word, t_us)
    elif can_id == config["signature_id"]:
        if length == 2 and word & 0xFFFF == memory["signature"]:
            memory["signature_age"] = 0
        elif memory["state"] == RUNNING and memory["signature"] >= 0:
            memory["node_events"] |= SAFETY_OBJECTS
    elif _is_for_us_to_send(config, can_id):
        told = _on_foreign(config, memory, can_id, length, word)
    return told | (FRESH if sense[0]["fresh"] != 0 else 0)


@kernel
def _is_for_us_to_send(config: np.void, can_id: int) -> bool:
    if can_id == _NMT or can_id == config["drive"][0]["cob_id"] or can_id == config["output_id"]:
        return True
    return can_id == _SYNC or can_id == _SDO_OUT + config["node_id"] or can_id == config["our_heartbeat_id"]


@kernel
def is_starting_up(state: int) -> bool:
    """Whether the start-up decides what comes next."""
    return RESETTING <= state <= TRYING


@kernel
def _on_heartbeat(config: np.void, memory: np.void, node_state: int, t_us: int) -> int:
    memory["node_state"] = node_state
    state = memory["state"]
    if state >= RELEASING:
        if node_state == _OPERATIONAL:  # not yet, or somebody has started it again
            fall_silent(memory)
            memory["state"] = RELEASING
        elif state == RELEASING:
            memory["state"] = RELEASED
            memory["heartbeat_next_us"] = t_us
        return 0
    if is_starting_up(state):
        return START_UP
    if node_state == _BOOT_UP and RUNNING <= state <= FAILED:
        memory["node_events"] |= NODE_REBOOTED | NODE_NOT_OPERATIONAL
        _fail(memory, _REBOOTED)
    if memory["state"] == RUNNING:
        heard(config, memory, node_state, t_us)
    return 0


@kernel
def heard(config: np.void, memory: np.void, node_state: int, t_us: int) -> None:
    """A heartbeat of the node's while it ought to be operational."""
    memory["node_deadline_us"] = t_us + config["node_timeout_us"]
    memory["node_heartbeat_us"] = t_us
    _keep_away(config, memory, t_us)
    if node_state != _OPERATIONAL:
        memory["node_events"] |= NODE_NOT_OPERATIONAL
        _fail(memory, _LEFT)


@kernel
def _on_emergency(memory: np.void, word: int, t_us: int) -> int:
    code, state = word & 0xFFFF, memory["state"]
    if STARTING <= state <= TRYING and (code == _HEARTBEAT_ERROR or code < 0x0100):
        return 0  # as it should be
    memory["emergency"], memory["emergency_us"] = word, t_us
    if code >= 0x0100:  # below, an error is over
        memory["node_events"] |= NODE_EMERGENCY
    return EMERGENCY


@kernel
def _on_foreign(config: np.void, memory: np.void, can_id: int, length: int, word: int) -> int:
    """A frame that only we may send, and that we did not, since a controller does not receive its own.

    What comes before the node is configured, a predecessor's last heartbeat perhaps, the configuration undoes; what
    comes while the node is tried, and we are silent, ends the start.
    """
    state, node = memory["state"], word >> 8 & 0xFF
    if not CONFIGURING <= state <= RUNNING:
        return 0
    if can_id == _NMT and (length != 2 or (node != 0 and node != config["node_id"])):
        return 0  # to another node
    memory["node_events"] |= FOREIGN_FRAME
    if memory["foreign_id"] < 0:
        memory["foreign_id"], memory["foreign_length"], memory["foreign_data"] = can_id, length, word
    return START_UP if STARTING <= state <= TRYING else 0


@kernel
def _fail(memory: np.void, failure: int) -> None:
    if memory["failure"] == 0:  # the first cause counts
        memory["failure"] = failure
        memory["failed_state"] = memory["node_state"]
    fall_silent(memory)
    memory["state"] = FAILED


@kernel
def put_nmt(config: np.void, memory: np.void, command: int) -> None:
    """An NMT command to the node."""
    put(config, memory, _NMT, 2, command | config["node_id"] << 8)
