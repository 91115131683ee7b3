"""The transmit gate: the last word on every frame that is to be sent. What is not permitted here, does not go out.

Deny by default. It trusts nobody: it reads the bytes of the frame, not what someone meant, with its own CRC and its own
reading of the standard, and it remembers what it let through. The rules are compiled, in ``gate_rules``; here are their
settings, and their words.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.compiled.direct_call import direct
from pkxyz_ctrl.safety import gate_rules, sdo_rules
from pkxyz_ctrl.safety.gate_rules import GATE, FrameKind, Reason, crc_start, new_gate_memory
from pkxyz_ctrl.safety.modes import Mode

_HEAD: Final = 8  # bytes of a frame that the rules look at: nothing that may be sent is longer


@dataclass(frozen=True, slots=True)
class GateConfig:
    """What the gate holds the frames to.

    ``count_max`` and ``count_slew_max`` are drive counts (the scale of the wire, INTEGER16; 0 counts = 0 V), the latter
    per drive frame. ``spacing_min_us`` is the shortest time between two drive frames; None: half a period, so that
    jitter passes and a second frame in the same tick does not. ``fd``: the bus can carry FD frames. Time-outs that are
    written to the node may be at most ``heartbeat_timeout_max_ms``. The drive frame is that of RPDO ``drive_pdo``, and
    carries channels ``drive_channels`` of 0x6411. ``digital_outputs``: RPDO 1 may carry 0x6200:1. Raises ValueError if
    a value is out of range.
    """

    count_max: int
    count_slew_max: int
    period_us: int
    node_id: int = 10
    controller_node_id: int = 127
    protection: bool = True
    fd: bool = True
    spacing_min_us: int | None = None
    heartbeat_timeout_max_ms: int = 1000
    drive_pdo: int = 2
    drive_channels: tuple[int, int, int] = (1, 2, 3)
    digital_outputs: bool = False

    def __post_init__(self) -> None:
        ranges = {
            "count_max": (0, 32767),
            "count_slew_max": (1, 32767),
            "period_us": (2, 1_000_000),
            "node_id": (1, 127),
            "controller_node_id": (1, 127),
            "heartbeat_timeout_max_ms": (1, 65535),
            "drive_pdo": (1, 4),
        }
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            if not isinstance(value, int) or not low <= value <= high:
                raise ValueError(f"gate: {name} = {value!r} must be an integer in {low}..{high}")
        if self.node_id == self.controller_node_id:
            raise ValueError(f"gate: node_id and controller_node_id are both {self.node_id}")
        if self.spacing_min_us is not None and not 0 <= self.spacing_min_us <= self.period_us:
            raise ValueError(f"gate: spacing_min_us = {self.spacing_min_us} must be in 0..{self.period_us} (a period)")

    @property
    def record(self) -> NDArray[np.void]:
        """(1,) of ``GATE``, as the compiled rules read it."""
        record = np.zeros(1, GATE)
        to = record[0]
        for name in ("period_us", "count_max", "count_slew_max", "node_id", "fd"):
            to[name] = getattr(self, name)
        to["spacing_us"] = self.period_us // 2 if self.spacing_min_us is None else self.spacing_min_us
        to["drive_id"] = 0x100 + 0x100 * self.drive_pdo + self.node_id  # predefined connection set
        to["drive_length"] = 8 if self.protection else 6
        to["output_id"] = 0x200 + self.node_id if self.digital_outputs else -1
        to["sdo_id"] = 0x600 + self.node_id
        to["heartbeat_id"] = 0x700 + self.controller_node_id
        to["crc_start"] = crc_start(int(to["drive_id"]))
        writes = to["writes"]
        for name in ("node_id", "controller_node_id", "count_slew_max"):
            writes[name] = getattr(self, name)
        writes["timeout_max_ms"] = self.heartbeat_timeout_max_ms
        writes["drive_index"] = 0x1400 + self.drive_pdo - 1
        writes["drive_id"], writes["output_id"] = to["drive_id"], to["output_id"]
        writes["drive_channel"] = self.drive_channels
        record.setflags(write=False)
        return record


class TransmitGate:
    """Holds every frame against ``gate_rules.PERMITTED``, the limits of its config, and the drive frames that went
    before.

    The first frame that it blocks latches it: until :meth:`clear`, only ``gate_rules.ALWAYS`` passes. ``latched`` is
    that first reason, empty if there is none. What the combs hold counts as unknown at the beginning, after any NMT
    command, and after a SYNC that found no drive frame, since the node takes the next one for a late one; then only
    0 V passes, and after that the slew limit starts from 0. A voltage passes once for each SYNC, and there must have
    been one, so that every step that passed is a step that the combs make, if nothing is lost on the way. What is, the
    gate can't know; the node does, and holds its own steps to the same limit (0x2011).

    ``memory`` (1,) of ``gate_rules.GATE_MEMORY`` is all that it remembers.
    """

    def __init__(
        self, config: GateConfig, record: NDArray[np.void] | None = None, memory: NDArray[np.void] | None = None
    ) -> None:
        """``record`` and ``memory``: where they are to stand."""
        self.config = config
        self.latched = ""
        self.record = config.record
        if record is not None:
            record[0] = self.record[0]
            self.record = record
            self.record.setflags(write=False)
        self.memory = new_gate_memory() if memory is None else memory
        self._check = direct(gate_rules.check, self.record, self.memory, *[0] * 6)

    @property
    def blocked_frames(self) -> int:
        """How many were not let through."""
        return int(self.memory["blocked_frames"][0])

    def check(self, frame: Frame, mode: int, t_us: int) -> str | None:
        """None: send it. Otherwise the reason why it must not be sent, and the gate is latched."""
        can_id, data, flags = frame
        length = len(data)
        word = int.from_bytes(data if length <= _HEAD else data[:_HEAD], "little", signed=True)
        reason = self._check(self.record, self.memory, can_id, flags, length, word, mode, t_us)
        return None if reason == 0 else self.blocked(frame, mode, reason, self.memory[0], t_us)

    def clear(self) -> None:
        """Let the mode's frames pass again. What was sent last stays remembered, so the slew limit holds across it."""
        self.latched = ""
        gate_rules.clear(self.memory)

    def blocked(self, frame: Frame, mode: int, reason: int, held: np.void, t_us: int) -> str:
        """The words for a frame that was not let through; ``held``: the memory that it was held against."""
        word = int.from_bytes(frame.data[:_HEAD], "little", signed=True)
        known_mode = Mode(mode).name if mode in list(Mode) else f"unknown mode {mode}"
        words = _words(reason, self.record[0], held, len(frame.data), word, t_us)
        if reason == Reason.LATCHED and self.latched:
            words += f" since this {self.latched}"
        told = f"frame 0x{frame.can_id:03X} [{bytes(frame.data).hex(' ')}] blocked in {known_mode}: {words}"
        self.latched = self.latched or told
        return told


_FIXED: Final = {
    Reason.UNUSUAL: "not a plain data frame with an 11-bit identifier",
    Reason.FORMAT: "frame format that this bus does not carry",
    Reason.SYNC: "SYNC must be empty, or one byte, 1..240",
    Reason.HEARTBEAT: "our heartbeat must be the one byte 0x05",
    Reason.IDENTIFIER: "identifier is not in the list of those that we may send",
    Reason.NMT: "not an NMT command",
    Reason.DRIVE_UNKNOWN: "what the combs hold is unknown (start, NMT command or pause): "
    "a frame with 0 V must come first",
    Reason.OUTPUT_SECOND: "a second frame with digital outputs in one tick: no SYNC went out since the one before",
    Reason.DRIVE_SECOND: "a second drive PDO in one tick: no SYNC went out since the one before",
    Reason.LATCHED: "the gate is latched",
}


def _words(reason: int, config: np.void, memory: np.void, length: int, word: int, t_us: int) -> str:
    """A reason's words. What was blocked left no trace in ``memory``, which still tells what it was held against."""
    if reason >= Reason.NOT_NOW:
        return f"{FrameKind(reason - Reason.NOT_NOW).name} is not permitted now"
    if reason in _FIXED:
        return _FIXED[Reason(reason)]
    a, b, c = ((word >> place & 0xFFFF ^ 0x8000) - 0x8000 for place in (0, 16, 32))
    counts, counter = f"drive counts {a}, {b}, {c}", word >> 48 & 0xFF
    was = ", ".join(str(count) for count in memory["count"])
    match Reason(reason):
        case Reason.NMT_NODE:
            return f"NMT command to node {word >> 8 & 0xFF}; only node {config['node_id']} is ours, never all"
        case Reason.DRIVE_LENGTH:
            return f"drive PDO has {length} bytes instead of {config['drive_length']}"
        case Reason.DRIVE_REPEATED:
            return f"drive PDO repeats alive counter {counter}: the node would ignore it"
        case Reason.DRIVE_TOO_SOON:
            since_us, least_us = t_us - memory["time_us"], config["spacing_us"]
            return f"drive PDO {since_us} us after the one before, at least {least_us} us apart"
        case Reason.DRIVE_RANGE:
            return f"{counts} are not all in 0..{config['count_max']}"
        case Reason.DRIVE_STEP:
            return f"{counts} after {was}: a step beyond {config['count_slew_max']}"
        case Reason.DRIVE_COUNTER:
            return f"drive PDO has alive counter {counter} instead of {memory['counter_next']}"
        case Reason.DRIVE_CRC:
            return f"drive PDO has a wrong CRC, 0x{word >> 56 & 0xFF:02X}"
        case Reason.OUTPUT_LENGTH:
            return f"the digital outputs' PDO has {length} bytes instead of 1"
        case Reason.OUTPUT_BITS:
            return f"digital outputs 0x{word & 0xFF:02X} beyond 0x{gate_rules.OUTPUT_BITS:02X}"
        case Reason.SDO_LENGTH:
            return f"SDO request has {length} bytes instead of 8"
    return sdo_rules.write_words(sdo_rules.write_refusal(config["writes"], word), word)
