"""Frames to compare: what a good controller sends, all that can be wrong about it, and what nobody should send."""

import random
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.can.process_pdo import encode
from pkxyz_ctrl.compiled.direct_call import direct
from pkxyz_ctrl.export.calls import CALL, Call
from pkxyz_ctrl.safety import gate_rules
from pkxyz_ctrl.safety.gate_rules import Reason, new_gate_memory
from pkxyz_ctrl.safety.modes import Mode

Records = NDArray[np.void]

CLEAR = -1
"""In place of a mode: the gate is cleared, and no frame judged."""
_OBJECTS = (0x1005, 0x1016, 0x1017, 0x1019, 0x1029, 0x1400, 0x1401, 0x1601, 0x1801, 0x1A01, 0x2010, 0x2011, 0x6444)


class Judged(NamedTuple):
    """``frames`` (n,) of ``calls.CALL`` as they were asked about, the ``reasons`` (n,) given here, and the memory (1,)
    of the gate after the last.
    """

    frames: Records
    reasons: NDArray[np.int32]
    memory: Records


def judged(config: Records, count: int, seed: int) -> Judged:
    """So many frames through the gate of this machine. ``config`` (1,) of ``exchange.EXCHANGE``."""
    draw = random.Random(seed)
    gate, memory = config["gate"][0], new_gate_memory()
    check = direct(gate_rules.check, gate, memory, *[0] * 6)
    frames, reasons = np.zeros(count, CALL), np.zeros(count, np.int32)
    sender = Sender(config, draw)
    for n in range(count):
        t_us, data, can_id, flags, length, kind, mode = sender.frame()
        if memory[0]["latched"] and draw.random() < 0.5:
            mode = CLEAR
        frames[n] = t_us, data, can_id, flags, length, kind, mode
        if mode == CLEAR:
            gate_rules.clear(memory)
        else:
            reasons[n] = check(gate, memory, can_id, flags, length, data, mode, t_us)
            sender.answered(int(reasons[n]))
    return Judged(frames, reasons, memory)


def missing(found: Judged) -> list[str]:
    """Reasons that no frame was given; all but what only the latch hides."""
    given = {int(reason) for reason in np.unique(found.reasons)}
    return [reason.name for reason in Reason if reason not in given and reason != Reason.NOT_NOW]


class Sender:
    """A controller that errs: it keeps to what it was answered, so that its next frame is a good one more often."""

    def __init__(self, config: Records, draw: random.Random) -> None:
        self._gate, self._drive, self._draw = config[0]["gate"][0], config[0]["driver"][0]["drive"], draw
        self._most, self._slew = int(self._gate["count_max"]), int(self._gate["count_slew_max"])
        self._period_us = int(self._gate["period_us"])
        self._t_us, self._counter, self._mode = 0, 0, int(Mode.TRACKING)
        self._held, self._asked = (0, 0, 0), (0, 0, 0)
        self._is_sync_next, self._is_drive = False, False

    def answered(self, reason: int) -> None:
        """The gate's answer to the last frame."""
        if self._is_drive and reason == 0:
            self._held, self._counter = self._asked, self._counter + 1 & 0xFF
        elif self._is_drive:
            self._held = (0, 0, 0)

    def frame(self) -> tuple[int, ...]:
        """The next one, as fields of ``calls.CALL``."""
        draw = self._draw
        if draw.random() < 0.01:
            self._mode = draw.choice((*map(int, Mode), int(Mode.TRACKING), int(Mode.TRACKING), 99))
        self._t_us += self._period_us // 2
        self._is_sync_next, self._is_drive = not self._is_sync_next, False
        if draw.random() < 0.15:
            return self._odd()
        if self._is_sync_next:
            return self._made(0x080, draw.choice((1, 240, 7)) if draw.random() < 0.99 else 241, 1)
        return self._drive_frame()

    def _made(self, can_id: int, data: int, length: int, flags: int = 3) -> tuple[int, ...]:
        signed = data - (1 << 64) if data >= 1 << 63 else data
        return self._t_us, signed, can_id, flags, length, int(Call.JUDGE), self._mode

    def _drive_frame(self) -> tuple[int, ...]:
        draw, slew, self._is_drive = self._draw, self._slew, True
        wrong = draw.random() < 0.1
        step = slew + 1 if wrong and draw.random() < 0.3 else draw.randint(0, slew)
        least = -1 if wrong and draw.random() < 0.3 else 0
        most = self._most + (1 if wrong and draw.random() < 0.3 else 0)
        a, b, c = (min(max(count + draw.choice((-step, 0, step)), least), most) for count in self._held)
        self._asked = (a, b, c) if draw.random() < 0.8 else (0, 0, 0)
        counter = self._counter if not wrong or draw.random() < 0.7 else draw.randint(0, 255)
        data = encode(self._drive, *self._asked, counter) & (1 << 64) - 1
        if wrong and draw.random() < 0.3:
            data ^= 1 << draw.randint(0, 63)
        self._t_us -= self._period_us - 1 if wrong and draw.random() < 0.3 else 0
        return self._made(int(self._gate["drive_id"]), data, 8 if not wrong or draw.random() < 0.8 else 7)

    def _odd(self) -> tuple[int, ...]:
        draw, gate = self._draw, self._gate
        kind = draw.randint(0, 7)
        if kind == 0:
            return self._made(draw.randint(0, 0x7FF), draw.getrandbits(64), draw.randint(0, 64), draw.randint(0, 31))
        if kind == 1:
            node = int(gate["node_id"]) if draw.random() < 0.9 else draw.randint(0, 127)
            return self._made(0x000, draw.choice((1, 2, 0x80, 0x81, 0x82, 9)) | node << 8, 2)
        if kind == 2:
            return self._made(int(gate["heartbeat_id"]), draw.choice((5, 5, 4, 0)), 1)
        if kind == 3:
            return self._made(0x080, draw.randint(0, 255), draw.randint(0, 2))
        if kind == 4:
            return self._made(int(gate["drive_id"]), draw.getrandbits(64), 8)
        if kind == 5:
            length = 1 if draw.random() < 0.9 else draw.randint(0, 8)
            return self._made(int(gate["output_id"]), draw.getrandbits(draw.choice((3, 6, 8))), length)
        index, value = draw.choice(_OBJECTS), draw.choice((0, 1, 2, 0x80, 240, 1000, draw.getrandbits(32)))
        command = draw.choice((0x2F, 0x2B, 0x27, 0x23, 0x40, 0x60, 0x80, draw.randint(0, 255)))
        data = command | index << 8 | draw.randint(0, 4) << 24 | value << 32
        return self._made(int(gate["sdo_id"]), data, 8 if draw.random() < 0.95 else 7)
