"""What a target has to compute from a recorded exchange, to the last bit: digests of rows, frames and memories."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.can.process_pdo import encode
from pkxyz_ctrl.compiled.direct_call import direct
from pkxyz_ctrl.export import planned
from pkxyz_ctrl.export.calls import CALL, Call
from pkxyz_ctrl.export.planned import begins, is_planned, memory_of, whole
from pkxyz_ctrl.export.stored import stored_in_exchange
from pkxyz_ctrl.export.words import FNV_OFFSET, canonical, digest
from pkxyz_ctrl.loop import exchange
from pkxyz_ctrl.loop.exchange import EXCHANGE, EXCHANGE_MEMORY
from pkxyz_ctrl.safety.modes import Mode

Records = NDArray[np.void]

EVERY = 100
"""Periods between two digests, so that a difference has a place."""
_DAMAGED, _LOST, _SEED = 97, 131, 13
_IDENTIFIERS = (0x000, 0x080, 0x123)


class SelfTest(NamedTuple):
    """``calls`` (n,) of ``calls.CALL``, and ``tried`` (m,), of frames that a second gate is asked about, one a period;
    ``digests`` of all that came of them up to every ``EVERY``-th period, and last of the memories.
    """

    calls: Records
    tried: Records
    digests: tuple[int, ...]


def self_test(config: Records, reference: Records, calls: Records) -> SelfTest:
    """Go through the calls (n,) of an exchange on this machine, now and then with a sense frame that is damaged or
    lost. ``config`` (1,) of ``EXCHANGE``.
    """
    calls = damaged(config, calls)
    ticks = int(np.count_nonzero(calls["kind"] == Call.PERIOD))
    if ticks == 0 or ticks % EVERY:
        raise ValueError(f"a self-test has a multiple of {EVERY} periods, not {ticks}")
    tried, board = _frames_to_try(config, ticks), Board(config, reference)
    doubtful = Board(config, reference)
    state, digests, done = FNV_OFFSET, [], 0
    for call in calls:
        words = [board.play(call)]
        if call["kind"] == Call.PERIOD:
            words.append(doubtful.play(tried[done]))
            if done % 2:
                doubtful.clear()
            done += 1
        state = digest(state, np.concatenate(words))
        if call["kind"] == Call.PERIOD and done % EVERY == 0:
            digests.append(state)
    return SelfTest(calls, tried, (*digests, digest(state, np.concatenate([board.held(), doubtful.held()]))))


class Board:
    """What ``main.c`` does with a call, over memories of its own."""

    def __init__(self, config: Records, reference: Records) -> None:
        self._whole = whole(config)
        self._whole_memory = memory_of(self._whole)
        self._config, self._reference = begins(self._whole, EXCHANGE), reference
        self.memory = begins(self._whole_memory, EXCHANGE_MEMORY)
        self._driver, self._cycle = self.memory["driver"][0], self.memory["cycle"][0]
        self._held = stored_in_exchange(self._config["law"][0]).memory
        exchange.switch_on(self.memory)
        c, m = self._config, self.memory
        self._begin, self._finish = direct(exchange.begin, c, m, 0), direct(exchange.finish, c, m, 0, 0)
        self._on_frame, self._prepare = direct(exchange.on_frame, c, m, *[0] * 5), direct(exchange.prepare, c, m)
        period = planned.period if is_planned(self._config["law"][0]) else exchange.period
        self._period = direct(period, self._whole, self._whole_memory, reference, 0)

    def play(self, call: np.void) -> NDArray[np.uint64]:
        """Words that come of one of ``CALL``: what was told; frames, or the row of a period."""
        kind = int(call["kind"])
        told = self._called(kind, call)
        told_words = np.array([told], np.int64).view(np.uint64)
        if kind in (Call.COME_UP, Call.REQUEST, Call.CLEAR, Call.PREPARE):
            return told_words
        if kind == Call.PERIOD:
            return np.concatenate([told_words, canonical(self.row)])
        return np.concatenate([told_words, canonical(self._driver["out"][0, : self._driver["outgoing"][0]])])

    def _called(self, kind: int, call: np.void) -> int:
        config, memory = self._config, self.memory
        t_us, data = int(call["t_us"]), int(call["data"])
        can_id, flags, length = int(call["can_id"]), int(call["flags"]), int(call["length"])
        told: Any = 0
        if kind == Call.FRAME:
            told = self._on_frame(config, memory, can_id, flags, length, data, t_us)
        elif kind == Call.BEGIN:
            told = self._begin(config, memory, t_us)
        elif kind == Call.PERIOD:
            told = self._period(self._whole, self._whole_memory, self._reference, data)
        elif kind == Call.FINISH:
            told = self._finish(config, memory, t_us, data)
        elif kind == Call.PREPARE:
            self._prepare(config, memory)
        elif kind == Call.COME_UP:
            told = exchange.come_up(memory)
        elif kind == Call.JUDGE:
            self._driver["out"][0, 0] = (data, can_id, flags, length, 0)
            self._driver["outgoing"], self._cycle["mode"] = 1, call["mode"]
            told = exchange.judge(config[0], memory[0], 0, t_us)
        elif kind == Call.REQUEST:
            memory["event"] = data
        elif kind == Call.CLEAR:
            memory["clearing"] = data
        else:
            told = {Call.START: exchange.start, Call.WAIT: exchange.wait, Call.STOP: exchange.stop}[Call(kind)](
                config, memory, t_us
            )
        return int(told)

    @property
    def row(self) -> Records:
        """(1,) of the last period."""
        row: Records = self._cycle["row"]
        return row

    def clear(self) -> None:
        """Let the gate pass the mode's frames again."""
        self.memory["gate"]["latched"] = 0

    def held(self) -> NDArray[np.uint64]:
        """Words of what a board holds of the memory. Raises ``AssertionError`` if this law used more."""
        words = canonical(self._whole_memory)
        assert not words[self._held // 8 :].any()
        return words[: self._held // 8]


def damaged(config: Records, calls: Records) -> Records:
    """Each so many-th sense frame with a bit turned over, and others lost."""
    is_sense = (calls["kind"] == Call.FRAME) & (
        calls["can_id"] == config["driver"][0, 0]["sense"][0]["pdo"][0]["cob_id"]
    )
    places, changed = np.flatnonzero(is_sense), calls.copy()
    for n in range(_DAMAGED - 1, len(places), _DAMAGED):
        changed[places[n]]["data"] ^= 1 << n % 48
    lost = places[_LOST - 1 :: _LOST]
    return np.delete(changed, lost)


def _frames_to_try(config: Records, ticks: int) -> Records:
    """Frames of all identifiers that the gate knows, well-formed or not, in every mode."""
    random = np.random.default_rng(_SEED)
    gate, drive = config[0]["gate"][0], config[0]["driver"][0]["drive"]
    frames = np.zeros(ticks, CALL)
    frames["kind"] = Call.JUDGE
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
