"""The node's part of a tick in which all is as it should be, compiled: SYNC, drive PDO, sense PDO; and what it does in
pre-operational, where it answers what a start-up reads, and stopped.

Each kernel looks before it acts. What is out of the ordinary it leaves alone and says so: that is for the node itself.
A payload is its bytes as an integer of 64 bits, the first one lowest.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.node.crc import STEP, crc8h2f
from pkxyz_ctrl.compiled.kernel import kernel

Records = NDArray[np.void]

OBJECTS_MOST: Final = 192

OBJECT = np.dtype([("key", "i4"), ("reply", "i8")], align=True)
"""What answers an SDO upload of an object; ``key``: index, and sub-index above it, as a request has them."""

NODE = np.dtype(
    [
        ("objects", OBJECT, (OBJECTS_MOST,)),
        ("objects_count", "i4"),
        ("sync_id", "i4"),
        ("drive_id", "i4"),
        ("sense_id", "i4"),
        ("heartbeat_id", "i4"),
        ("request_id", "i4"),  # of SDO, and of what is answered
        ("reply_id", "i4"),
        ("output_id", "i4"),  # of the digital outputs' PDO; -1: not in use
        ("consumer_id", "i4"),  # whose heartbeat is waited for
        ("flags", "i4"),  # of the frames that it sends
        ("drive_crc_start", "i4"),  # what the identifier and the constants of the CRC leave, for seven bytes behind it
        ("sense_crc_start", "i4"),
        ("limit", "i4"),  # largest count
        ("step_max", "i4"),
        ("sync_overflow", "i4"),  # SYNCs count from 1 to this; 0: they don't
        ("signature", "i4"),  # as it is now
        ("signature_id", "i4"),
        ("signature_every", "i4"),  # SYNCs
        ("turnaround_us", "i8"),
        ("drive_timeout_us", "i8"),
        ("beat_period_us", "i8"),
        ("consumer_time_us", "i8"),
    ],
    align=True,
)

NODE_MEMORY = np.dtype(
    [
        ("drive_deadline_us", "i8"),
        ("beat_us", "i8"),  # when the heartbeat is due
        ("consumer_us", "i8"),  # when the one that is waited for is
        ("good_us", "i8"),  # from here on a good frame ends an error that is present
        ("sync_us", "i8"),  # of the last SYNC
        ("cycle_us", "i8"),  # between the last two
        ("due_us", "i8"),  # of the frame that waits for the response time; NEVER_US: none does
        ("output", "i4", (3,)),  # what the converters have
        ("pending", "i4", (3,)),
        ("is_pending", "i4"),
        ("drive_counter", "i4"),  # of the last frame with a correct CRC
        ("drive_crc", "i4"),
        ("sync_expected", "i4"),
        ("count", "i4", (3,)),  # last sample
        ("sense_counter", "i4"),
        ("sense_crc", "i4"),
        ("digital", "i4"),  # bits at the digital outputs ...
        ("digital_pending", "i4"),  # ... and those that wait for the SYNC; -1: none
        ("served_key", "i4"),  # of the last object that was read; -1: none
        ("signature_left", "i4"),  # SYNCs until the signature is due; 0: never
        ("signature_waits", "i4"),  # 1: it is due, and has not gone yet
    ],
    align=True,
)

NEVER_US: Final = 1 << 62
DEAF: Final = 0  # a node that boots: it takes nothing
OPERATIONAL: Final = 5
STOPPED: Final = 4
UNKNOWN: Final = -1
"""In ``sync_expected``: any may come."""
_LEAVE: Final = 128  # NMT: to pre-operational
_COMMAND, _UPLOAD = 0xE0, 0x40  # bits of an SDO request
_KEY: Final = 0xFFFFFF
LENGTH: Final = 8  # of a process PDO with counter and CRC
_CRC_BYTES: Final = 7
_STEP: Final = np.frombuffer(STEP, np.uint8)


def crc_start(cob_id: int) -> int:
    """CRC of the identifier with seven bytes of 0 behind it: a CRC is linear, so the payload's own is added to it."""
    return crc8h2f(cob_id.to_bytes(2, "little") + bytes(_CRC_BYTES))


@kernel
def crc_of(start: int, word: int) -> int:
    """CRC of a payload's first seven bytes."""
    register = np.uint8(0)
    for place in range(_CRC_BYTES):
        register = _STEP[register ^ (word >> 8 * place & 0xFF)]
    return int(np.int64(register) ^ start)


@kernel
def next_alarm_us(memory: np.void) -> int:
    """When the node acts by itself, if nothing comes before."""
    return min(memory["drive_deadline_us"], memory["beat_us"], memory["consumer_us"])


@kernel
def on_drive(config: np.void, memory: np.void, length: int, word: int, t_us: int) -> bool:
    """A drive PDO. False, and nothing is done, for one that is refused or that ends an error."""
    counter, crc = word >> 48 & 0xFF, word >> 56 & 0xFF
    if length != LENGTH or crc != crc_of(config["drive_crc_start"], word) or t_us >= memory["good_us"]:
        return False
    if counter != memory["drive_counter"] + 1 & 0xFF:
        return False
    for place in range(3):
        if word >> 16 * place & 0xFFFF > config["limit"]:
            return False
    for place in range(3):
        memory["pending"][place] = word >> 16 * place & 0xFFFF
    memory["is_pending"], memory["drive_counter"], memory["drive_crc"] = 1, counter, crc
    return True


@kernel
def on_sync(config: np.void, memory: np.void, length: int, word: int, t_us: int) -> bool:
    """A SYNC: what is pending becomes the output, and a sample is due. False, and nothing is done, for one that is out
    of step, finds nothing pending or would make too large a step.
    """
    overflow, counter = config["sync_overflow"], word & 0xFF
    if length != (1 if overflow else 0) or counter != memory["sync_expected"]:
        return False
    if memory["is_pending"] == 0 or t_us >= memory["good_us"] or memory["due_us"] != NEVER_US:
        return False
    pending, output, step = memory["pending"], memory["output"], config["step_max"]
    if pending[0] != 0 or pending[1] != 0 or pending[2] != 0:
        for comb in range(3):
            if not -step <= pending[comb] - output[comb] <= step:
                return False
    for comb in range(3):
        output[comb] = pending[comb]
    memory["sync_expected"] = counter % overflow + 1 if overflow else 0
    memory["is_pending"] = 0
    if memory["signature_left"] > 0:
        memory["signature_left"] -= 1
        if memory["signature_left"] == 0:
            memory["signature_left"], memory["signature_waits"] = config["signature_every"], 1
    if memory["digital_pending"] >= 0:
        memory["digital"], memory["digital_pending"] = memory["digital_pending"], -1
    memory["drive_deadline_us"] = t_us + config["drive_timeout_us"]
    memory["cycle_us"] = t_us - memory["sync_us"]
    memory["sync_us"] = t_us
    memory["due_us"] = t_us + config["turnaround_us"]
    return True


@kernel
def on_digital(memory: np.void, length: int, word: int) -> bool:
    """A frame with digital outputs. False for one that has not their length."""
    if length != 1:
        return False
    memory["digital_pending"] = word & 0xFF
    return True


@kernel
def on_heartbeat(config: np.void, memory: np.void, length: int, word: int, t_us: int) -> bool:
    """The controller's. False for one that says anything else than that it works."""
    if length != 1 or word & 0xFF == 0:
        return False
    memory["consumer_us"] = t_us + config["consumer_time_us"]
    return True


@kernel
def answer(config: np.void, memory: np.void) -> int:
    """The payload of the sense PDO, a number with sign."""
    counter = np.int64(memory["sense_counter"]) + 1 & 0xFF
    count, word = memory["count"], counter << 48
    for place in range(3):
        word |= (np.int64(count[place]) & 0xFFFF) << 16 * place
    crc = crc_of(config["sense_crc_start"], word)
    memory["due_us"], memory["sense_counter"], memory["sense_crc"] = NEVER_US, counter, crc
    return int(word | ((crc ^ 0x80) - 0x80) << 56)


@kernel
def rides(config: np.void, memory: np.void, t_us: int) -> bool:
    """Whether the heartbeat goes along with the sense PDO, since behind the next one it would be too late."""
    if t_us + memory["cycle_us"] < memory["beat_us"]:
        return False
    memory["beat_us"] = t_us + config["beat_period_us"]
    return True


@kernel
def on_frame_at_rest(config: np.void, memory: np.void, can_id: int, length: int, word: int, t_us: int) -> bool:
    """A frame that comes in pre-operational. False, and nothing is done, for one that is for the node itself."""
    if can_id == config["sync_id"]:
        return _count_sync(config, memory, length, word)
    if can_id == config["consumer_id"]:  # one that nobody waits for has been missed, and ends that
        return memory["consumer_us"] != NEVER_US and bool(on_heartbeat(config, memory, length, word, t_us))
    if can_id == 0:  # NMT
        return length == 2 and word & 0xFF == _LEAVE
    return bool(can_id == config["drive_id"] or can_id == config["output_id"])  # not taken in this state


@kernel
def on_frame_stopped(config: np.void, memory: np.void, can_id: int, length: int, word: int, t_us: int) -> bool:
    """A frame that comes to a stopped node, likewise."""
    if can_id == config["consumer_id"]:
        return memory["consumer_us"] != NEVER_US and bool(on_heartbeat(config, memory, length, word, t_us))
    return bool(can_id != 0)  # NMT is all that it takes besides


@kernel
def read(config: np.void, memory: np.void, length: int, word: int) -> int:
    """The reply to an SDO request, a number with sign. 0, and nothing is done, for one that is no upload, or of an
    object whose value has to be looked up.
    """
    if length != LENGTH or word & _COMMAND != _UPLOAD:
        return 0
    key = word >> 8 & _KEY
    for place in range(config["objects_count"]):
        found = config["objects"][place]
        if found["key"] == key:
            if found["reply"] != 0:
                memory["served_key"] = key
            return int(found["reply"])
    return 0


@kernel
def _count_sync(config: np.void, memory: np.void, length: int, word: int) -> bool:
    overflow, counter = config["sync_overflow"], word & 0xFF
    if length != (1 if overflow else 0) or (overflow and not 1 <= counter <= overflow):
        return False
    if memory["sync_expected"] != UNKNOWN and counter != memory["sync_expected"]:
        return False
    memory["sync_expected"] = counter % overflow + 1 if overflow else 0
    return True
