"""Shipped controller and shipped node, each by itself: what it does in each of its states, run once and kept.

A state has a number, and so has a frame (`Frames`). Asked what a side does, it is put into that state, does it, and
the answer becomes a row of `Rows`: the state behind it, what it said, the frames that it sent. The composition
(`product`) goes by these rows. They are asked for when they are needed, so nothing is run that can't happen.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, Final, NamedTuple

from any_law import any_law, bend, reference_for
from configurations import (
    CONTROLLER_ID,
    DRIVE,
    EMCY,
    LEVELS,
    MAXIMUM,
    NMT,
    NODE_ID,
    PERIOD_US,
    SENSE,
    STEP,
    SYNC,
    TOO_FAR,
    TURNAROUND_US,
    Configuration,
    bus_of,
    few_settings,
)
from fates import Plant, ViolationError, wishes_of
from node_rig import EDS
from product import (
    BEGIN,
    CLOSES,
    COMPUTE,
    DIALOGUE,
    DONE,
    FAILED,
    FINISH,
    FRAME,
    FRESH,
    PASS,
    QUIET,
    RUN,
    SHIFT,
    SKIPS,
    WAIT,
)
from snapshot import attributes_of
from states import Bases, ControllerState, NodeState

from hil.bus.clock import Lockstep
from hil.node.amplifier import AmplifierNode
from pkxyz_ctrl.can.codec import Counts, ProcessCodec
from pkxyz_ctrl.can.driver_rules import DriverState
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.loop import controller as controller_module
from pkxyz_ctrl.loop.controller import Controller, StartUpError
from pkxyz_ctrl.safety.gate import GateConfig
from pkxyz_ctrl.safety.modes import MAY_ENERGISE, Event, Mode

_CODECS: Final = {DRIVE: ProcessCodec(DRIVE, True), SENSE: ProcessCodec(SENSE, True)}
_SYNCS: Final = 240
controller_module.explain = cache(controller_module.explain)  # a sentence for each fault, which nobody reads
FAR_US: Final = 1 << 20
_RESET: Final = 0x81
_ANEW: Final = (0x80, _SYNCS // 2)
"""Where counters start anew, at a reset of the node: far from all that was on its way or is remembered."""


class Numbered:
    """Things that can be told apart, in the order in which they were first seen."""

    def __init__(self) -> None:
        self.things: list[Any] = []
        self._numbers: dict[Any, int] = {}

    def number(self, thing: Any) -> int:
        found = self._numbers.get(thing)
        if found is None:
            found = self._numbers[thing] = len(self.things)
            self.things.append(thing)
        return found


class Relative(NamedTuple):
    """A frame without its history: its payload, or what a process PDO or a SYNC holds, counted from `Bases`."""

    can_id: int
    flags: int
    payload: tuple[Any, ...] | bytes


def relative(frame: Frame, bases: Bases) -> Relative:
    can_id, data, flags = frame
    if can_id in _CODECS and len(data) == 8:
        a, b, c, counter, is_right = _CODECS[can_id].decode(data)
        base = bases.drive if can_id == DRIVE else bases.sense
        return Relative(can_id, flags, (a, b, c, (counter - base) & 0xFF, is_right))
    if can_id == SYNC and len(data) == 1:
        return Relative(can_id, flags, ((data[0] - bases.sync) % _SYNCS,))
    if can_id == EMCY:  # its code decides, the rest is words
        return Relative(can_id, flags, data[:2] + bytes(len(data) - 2))
    return Relative(can_id, flags, data)


def absolute(frame: Relative, bases: Bases) -> Frame:
    can_id, flags, payload = frame
    if isinstance(payload, bytes):
        return Frame._make((can_id, payload, flags))
    if can_id == SYNC:
        return Frame._make((can_id, bytes(((payload[0] + bases.sync - 1) % _SYNCS + 1,)), flags))
    a, b, c, counter, is_right = payload
    base = bases.drive if can_id == DRIVE else bases.sense
    data = _CODECS[can_id].encode((a, b, c), (counter + base) & 0xFF)
    return Frame._make((can_id, data if is_right else data[:7] + bytes((data[7] ^ 1,)), flags))


class Answer(NamedTuple):
    """What a side did: its state then, bits of what it said or minus the number of a violation, how much further its
    own counters are, and its frames.
    """

    to: int
    told: int
    drive: int = 0
    sync: int = 0
    sense: int = 0
    frames: tuple[int, ...] = ()


class Kept:
    """The states of a side by number, each as it was when it was first met."""

    def __init__(self) -> None:
        self._numbers: dict[bytes, int] = {}
        self.taken: list[tuple[Any, Bases]] = []

    @property
    def count(self) -> int:
        return len(self.taken)

    def number(self, key: bytes, take: Callable[[], Any], bases: Bases) -> tuple[int, bool]:
        """Its number, and whether it is new."""
        found = self._numbers.get(key)
        if found is not None:
            return found, False
        self._numbers[key] = len(self.taken)
        self.taken.append((take(), bases))
        return len(self.taken) - 1, True


class ControllerSide:
    """The shipped controller. ``labels``: of each of its states what the composition looks at."""

    def __init__(self, configuration: Configuration, known: "Known") -> None:
        bus = bus_of(configuration)
        assert bus.can is not None
        driver = bus.can.driver
        law = any_law(PERIOD_US, homing_ticks=2)
        gate = GateConfig(
            count_max=MAXIMUM, count_slew_max=STEP, period_us=PERIOD_US, node_id=NODE_ID,
            controller_node_id=CONTROLLER_ID, fd=driver.fd,
        )  # fmt: skip
        settings = () if configuration.whole_dialogue else few_settings(driver, STEP)
        self.live = Controller(law, bus, gate, self._on_sent, settings=settings)
        self.live.driver.sense.record["syncs_uncountable"] = 4
        self.labels: list[tuple[int, ...]] = []
        self.kept = Kept()
        self._references = {counts: reference_for(law, counts) for counts in (*LEVELS, *TOO_FAR)}
        self._known = known
        self._sent: list[Frame] = []
        self.bases = Bases()
        self.live.start(0)
        self._state = ControllerState(self.live)
        self.first = self._answer(self.bases, 0, 0, WAIT)

    def answer(self, state: int, asked: int) -> Answer:
        """What it does in a state."""
        taken, self.bases = self.kept.taken[state]
        self._state.put(taken)
        return self.go_on(asked)

    def go_on(self, asked: int) -> Answer:
        """What it does in the state in which it is."""
        was, told, now_us = self.bases, 0, self.bases.now_us
        try:
            if PASS <= asked < FRAME:
                now_us += asked - PASS
            elif asked >= SHIFT:
                self.bases = was._replace(sense=was.sense + asked - SHIFT & 0xFF)
            else:
                told = self._do(asked, now_us, was)
        except ViolationError as violation:
            told = self._known.violation(violation)
        return self._answer(was, now_us, told, asked)

    def _do(self, asked: int, now_us: int, bases: Bases) -> int:
        live = self.live
        if asked == BEGIN:
            live.begin(now_us)
        elif asked == FINISH:
            live.finish(now_us, now_us)
        elif asked >= FRAME:
            frame = absolute(self._known.frames.things[(asked - FRAME) % DIALOGUE], bases)
            if asked - FRAME < DIALOGUE:
                return FRESH if live.receive(frame, now_us) else 0
            return self._dialogue(frame, now_us)
        elif asked == WAIT:
            return self._dialogue(None, now_us)
        else:
            event, counts, trips = self._known.wishes.things[(asked - COMPUTE) // SKIPS]
            return self._compute(event, counts, trips, (asked - COMPUTE) % SKIPS)
        return 0

    def _dialogue(self, frame: Frame | None, now_us: int) -> int:
        try:
            return DONE if self.live.dialogue(frame, now_us) else 0
        except StartUpError:
            return FAILED

    def _compute(self, event: Event, counts: Counts, trips: int, skipped: int) -> int:
        live = self.live
        if event is Event.CLEAR:
            live.clear()
        elif event is not Event.NONE:
            live.request(event)
        reference = self._references[counts]
        memory: Any = live.memory[0]
        memory["setpoint"] = reference["motion"][0]
        if live.mode == Mode.LANDING:
            memory["landing_from"][6:9] = reference["motion"][0, 6:9] / bend(int(memory["landing_age"]) + 1)
        memory["input"]["trips"] |= trips
        was, fresh = live.mode, live.driver.sense.fresh
        live.compute(reference, skipped)
        told = CLOSES if MAY_ENERGISE[live.mode] and not MAY_ENERGISE[was] else 0
        return told | QUIET if fresh and not live.memory["tick"]["count"][0, 0].any() else told

    def _on_sent(self, frame: Frame) -> None:
        """What the gate has let through."""
        if frame.can_id == DRIVE and any(frame.data[:6]):
            live = self.live
            if not MAY_ENERGISE[live.mode] or not live.memory["homed"][0]:
                raise ViolationError(f"a voltage is sent in {Mode(live.mode).name}, homed {live.memory['homed'][0]}")
            if live.driver.state is not DriverState.OPERATIONAL:
                raise ViolationError(f"a voltage is sent while the driver is {live.driver.state.name}")
        self._sent.append(frame)

    def _answer(self, was: Bases, now_us: int, told: int, asked: int) -> Answer:
        driver: Any = self.live.driver.memory[0]
        self.bases = bases = Bases(now_us, int(driver["drive_counter"]), self.bases.sense, int(driver["sync_count"]))
        live = self.live
        del live.faults[:-1]
        live.driver.emergencies.clear()
        number, is_new = self.kept.number(self._state.key(bases), self._state.take, bases)
        if is_new:
            self.labels.append(self._label())
        frames = tuple(self._known.frames.number(relative(frame, bases)) for frame in self._sent)
        further = (bases.drive - was.drive) & 0xFF, (bases.sync - was.sync) % _SYNCS
        if asked == BEGIN and bases.sync == 1 and any(f.can_id == NMT and f.data[0] == _RESET for f in self._sent):
            further = _ANEW
        self._sent.clear()
        return Answer(number, told, *further, frames=frames)

    def _label(self) -> tuple[int, ...]:
        live = self.live
        gate: Any = live.gate.memory[0]
        state, may_energise = live.driver.state, bool(MAY_ENERGISE[live.mode])
        wishes = tuple(self._known.wishes.number(wish[1:]) for wish in wishes_of(live))
        return (
            int(live.mode), state.value, may_energise,
            bool(gate["known"]) and not gate["latched"] and may_energise,
            self._known.counts.number(tuple(gate["count"].tolist())),
            self._known.choices.number(wishes),
            live.driver.memory["start"]["position"][0, 0] % 6 == 0,
            live.mode < Mode.IDLE and state not in (DriverState.FAILED, DriverState.OFF),
        )  # fmt: skip


class NodeSide:
    """The shipped node, and what it drives."""

    def __init__(self, configuration: Configuration, known: "Known") -> None:
        bus = bus_of(configuration)
        assert bus.can is not None
        driver = bus.can.driver
        self.clock = Lockstep()
        self.plant = Plant(lambda: self.live.state)
        self._sent: list[Frame] = []
        self.live = AmplifierNode(
            NODE_ID, self.clock, self._sent.append, self.plant, EDS,
            turnaround_us=TURNAROUND_US, fd=driver.fd, protection=driver.protection, error_hold_us=30_000,
        )  # fmt: skip
        self.labels: list[tuple[int, ...]] = []
        self.kept = Kept()
        self._known = known
        self.bases = Bases()
        self.live.power_on()
        parts = attributes_of([self.live])
        self._alarms = [part for part, kind, name in parts if kind == "Alarm" and name == "due_us"]
        self._state = NodeState(self.live, self.clock)
        self.first = self._answer(self.bases, 0)

    def answer(self, state: int, asked: int) -> Answer:
        """What it does in a state."""
        (taken, self.plant.counts), self.bases = self.kept.taken[state]
        self._state.put(taken)
        return self.go_on(asked)

    def go_on(self, asked: int) -> Answer:
        """What it does in the state in which it is."""
        was, told = self.bases, 0
        try:
            if asked >= SHIFT:
                drive, sync = divmod(asked - SHIFT, _SYNCS)
                self.bases = was._replace(drive=was.drive + drive & 0xFF, sync=(was.sync + sync) % _SYNCS)
            elif asked >= FRAME:
                self.live.on_frame(absolute(self._known.frames.things[asked - FRAME], was), was.now_us)
            else:
                self.clock.run_until(was.now_us + asked - RUN)
        except ViolationError as violation:
            told = self._known.violation(violation)
        return self._answer(was, told)

    def _answer(self, was: Bases, told: int) -> Answer:
        counts = self.plant.counts
        self.bases = bases = self.bases._replace(now_us=self.clock.now_us, sense=self.live._sense.counter)
        key = self._state.key(bases, counts)
        number, is_new = self.kept.number(key, lambda: (self._state.take(), counts), bases)
        if is_new:
            self.labels.append((self._known.counts.number(counts), self._next_us() - bases.now_us))
        frames = tuple(self._known.frames.number(relative(frame, bases)) for frame in self._sent)
        self._sent.clear()
        return Answer(number, told, sense=(bases.sense - was.sense) & 0xFF, frames=frames)

    def _next_us(self) -> int:
        """When it acts by itself, if nothing comes before; far away if it never does."""
        due = (*(alarm.due_us for alarm in self._alarms), self.live._sense.due_us)
        return min((due_us for due_us in due if due_us is not None), default=self.clock.now_us + FAR_US)


class Known:
    """What both sides speak of, by number."""

    def __init__(self) -> None:
        self.frames, self.counts, self.wishes, self.choices, self.violations = (Numbered() for _ in range(5))
        self.counts.number((0, 0, 0))  # 0 is 0 V
        self.violations.number("")

    def violation(self, violation: ViolationError) -> int:
        """The number by which a row says so."""
        return -self.violations.number(str(violation))
