"""What a target has to compute from recorded frames, to the last bit: digests of rows, frames and memories."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.can.process_pdo import encode
from pkxyz_ctrl.compiled.direct_call import direct
from pkxyz_ctrl.export import wire as wiring
from pkxyz_ctrl.export.words import FNV_OFFSET, canonical, digest
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.period import period_of
from pkxyz_ctrl.safety.modes import Mode

Records = NDArray[np.void]

EVERY = 100
"""Ticks between two digests, so that a difference has a place."""
BEGINS_IN = Mode.IDLE
"""As every run: the node is operational, and nothing is known."""
_DAMAGED, _LOST, _SEED = 97, 131, 13
_SYNC_ID, _SYNCS = 0x080, 240
_IDENTIFIERS = (0x000, 0x080, 0x123)


class SelfTest(NamedTuple):
    """``frames`` (n,) of ``wire.FRAME``, the sense frame of each tick, and ``tried`` (n,), frames that a second gate
    is asked about; ``digests`` of all that came of them up to every ``EVERY``-th, and last of the memories.
    """

    frames: Records
    tried: Records
    digests: tuple[int, ...]


def self_test(law: Records, wire: Records, reference: Records, inputs: Records) -> SelfTest:
    """Run the sense counts of inputs (n,), n a multiple of ``EVERY``, from frame to frame on this machine."""
    if len(inputs) == 0 or len(inputs) % EVERY:
        raise ValueError(f"a self-test has a multiple of {EVERY} ticks, not {len(inputs)}")
    frames, tried = _sense_frames(wire, inputs), _frames_to_try(wire, len(inputs))
    board = Board(law, wire, reference)
    state, digests = FNV_OFFSET, []
    for n in range(len(frames)):
        state = digest(state, np.concatenate([canonical(part) for part in board.tick(n, frames, tried)]))
        if (n + 1) % EVERY == 0:
            digests.append(state)
    last = np.concatenate([canonical(part) for part in (board.memory, board.wire_memory, board.doubtful)])
    return SelfTest(frames, tried, (*digests, digest(state, last)))


class Board:
    """What ``main.c`` does: SYNC, sense frame, period, drive frame, each through the gate; and a gate beside, which is
    asked about anything.
    """

    def __init__(self, law: Records, wire: Records, reference: Records) -> None:
        self.memory, self.frame = cycling.new_memory(BEGINS_IN), np.zeros(1, wiring.FRAME)
        self.wire_memory, self.doubtful = wiring.new_wire_memory(), wiring.new_wire_memory()
        self._law, self._wire, self._reference = law, wire, reference
        self._cycle = period_of(law, reference)
        self._judge = direct(wiring.judge, wire, self.wire_memory, self.frame)

    def tick(self, n: int, frames: Records, tried: Records) -> tuple[Records, ...]:
        """Row, drive frame and the frame that was tried, as they are to be digested."""
        frame, wire = self.frame, self._wire
        t_us = n * int(self._law["period_us"][0])
        frame[0] = (t_us, n % _SYNCS + 1, _SYNC_ID, wire["flags"][0], 1, self.memory["mode"][0], n & 0xFF, 0)
        self._judge(wire, self.wire_memory, frame)
        wiring.sync(wire, self.wire_memory)
        wiring.receive(wire, self.wire_memory, frames[n : n + 1])
        wiring.take(self.wire_memory, self.memory)
        self._cycle(self._law, self.memory, self._reference)
        wiring.drive(wire, self.memory, frame)
        self._judge(wire, self.wire_memory, frame)
        doubtful = tried[n : n + 1].copy()
        self._judge(wire, self.doubtful, doubtful)
        if n % 2:
            wiring.clear(self.doubtful)
        return self.memory["row"].copy(), frame, doubtful


def _sense_frames(wire: Records, inputs: Records) -> Records:
    """Each tick's sense frame; now and then one is damaged, or is lost and leaves an empty one of nobody's."""
    frames = np.zeros(len(inputs), wiring.FRAME)
    pdo = wire[0]["sense"][0]["pdo"]
    for n, counts in enumerate(inputs["sense_count"].tolist()):
        frames[n]["can_id"], frames[n]["length"] = pdo[0]["cob_id"], pdo[0]["length"]
        frames[n]["data"] = encode(pdo, *counts, n & 0xFF) ^ (1 << n % 48 if n % _DAMAGED == _DAMAGED - 1 else 0)
        if n % _LOST == _LOST - 1:
            frames[n] = np.zeros((), wiring.FRAME)
    return frames


def _frames_to_try(wire: Records, ticks: int) -> Records:
    """Frames of all identifiers that the gate knows, well-formed or not, in every mode."""
    random = np.random.default_rng(_SEED)
    gate, drive = wire[0]["gate"][0], wire[0]["drive"]
    frames = np.zeros(ticks, wiring.FRAME)
    requests = (0x2F, 0x2B, 0x23, 0x40, 0x60, 0x80)
    objects = (0x1016, 0x1017, 0x1400, 0x1401, 0x1600, 0x1801, 0x1A00, 0x2010, 0x2011, 0x2012, 0x6443, 0x6444)
    ours = (int(gate[name]) for name in ("sdo_id", "heartbeat_id", "drive_id", "drive_id"))
    known = (*_IDENTIFIERS, *ours)
    for n in range(ticks):
        f, can_id = frames[n], int(random.choice(known))
        f["t_us"], f["can_id"] = n * int(gate["period_us"]), can_id
        f["flags"], f["mode"] = random.choice((0, 0, 0, 1, 3, 3, 4)), random.integers(-1, len(Mode) + 1)
        if can_id == gate["drive_id"]:
            small = random.integers(0, 1 + int(gate["count_slew_max"]), 3) * random.integers(0, 2)
            f["data"], f["length"] = encode(drive, *small.tolist(), n & 0xFF), drive[0]["length"]
        elif can_id == gate["sdo_id"]:
            index, value = int(random.choice(objects)), int(random.choice((0, 1, 240, 1000, int(gate["drive_id"]))))
            f["length"] = 8
            f["data"] = int(random.choice(requests)) | index << 8 | int(random.integers(0, 4)) << 24 | value << 32
        else:
            f["length"] = random.integers(0, 4)
            f["data"] = int(random.choice((0, 1, 2, 5, 0x80, 0x81))) | int(gate["node_id"]) << 8
    return frames
