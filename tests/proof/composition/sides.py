"""Shipped controller and shipped node, each by itself: what it does in each of its states, run once and kept.

A state has a number, and so has a frame. Asked what a side does, it is put into that state, does it, and
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
    LEVELS,
    MAXIMUM,
    NMT,
    NODE_ID,
    OUTPUTS,
    PERIOD_US,
    PERMITTED_BITS,
    SIGNATURE,
    STEP,
    SYNC,
    TOO_FAR,
    TURNAROUND_US,
    Configuration,
    bus_of,
    few_settings,
)
from fates import Plant, ViolationError, may_put_out, wishes_of
from frames import SYNCS, absolute, relative
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
from hil.node.amplifier import AmplifierNode, NmtState
from pkxyz_ctrl.can.codec import Counts
from pkxyz_ctrl.can.driver_rules import SAFETY_OBJECTS, DriverState
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.loop import controller as controller_module
from pkxyz_ctrl.loop.controller import Controller, StartUpError
from pkxyz_ctrl.safety.gate import GateConfig
from pkxyz_ctrl.safety.modes import MAY_ENERGISE, Event, Mode

controller_module.explain = cache(controller_module.explain)  # a sentence for each fault, which nobody reads
FAR_US: Final = 1 << 20
_RESET: Final = 0x81
_ANEW: Final = (0x80, SYNCS // 2)
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
            controller_node_id=CONTROLLER_ID, fd=driver.fd, digital_outputs=driver.digital_outputs,
        )  # fmt: skip
        settings = () if configuration.whole_dialogue else few_settings(driver, STEP)
        self.live = Controller(law, bus, gate, self._on_sent, settings=settings)
        self.live.driver.sense.record["syncs_uncountable"] = 4
        self.labels: list[tuple[int, ...]] = []
        self.kept = Kept()
        self._choices: dict[tuple[int, DriverState], int] = {}  # all that `wishes_of` goes by
        self._references = {counts: reference_for(law, counts) for counts in (*LEVELS, *TOO_FAR)}
        self._known, self._configuration = known, configuration
        self._room_us = bus.can.short_frame_us if configuration.has_room else 0
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
            self._finish(now_us)
        elif asked >= FRAME:
            frame = absolute(self._known.frames.things[(asked - FRAME) % DIALOGUE], bases)
            if asked - FRAME < DIALOGUE:
                return self._receive(frame, now_us)
            return self._dialogue(frame, now_us)
        elif asked == WAIT:
            return self._dialogue(None, now_us)
        else:
            event, counts, trips, bits = self._known.wishes.things[(asked - COMPUTE) // SKIPS]
            told = self._compute(event, counts, trips, (asked - COMPUTE) % SKIPS)
            live.outputs["bits"] = bits  # in place of what `loop.outputs` has decided
            return told
        return 0

    def _finish(self, now_us: int) -> None:
        live = self.live
        live.finish(now_us, now_us + self._room_us)
        live.outputs["bits"] = 0  # nobody reads it before the next is decided
        if [frame.can_id for frame in self._sent].count(DRIVE) != 1 or self._sent[0].can_id != DRIVE:
            raise ViolationError("the voltages of a tick are not what it sends first")

    def _receive(self, frame: Frame, now_us: int) -> int:
        driver: Any = self.live.driver.memory[0]
        told = FRESH if self.live.receive(frame, now_us) else 0
        if frame.can_id == SIGNATURE and self._goes_by_signature:
            is_right = frame.data == int(driver["signature"]).to_bytes(2, "little")
            if not is_right and not driver["node_events"] & SAFETY_OBJECTS:
                raise ViolationError("a wrong signature is taken")
        return told

    @property
    def _goes_by_signature(self) -> bool:
        driver = self.live.driver
        return driver.state is DriverState.OPERATIONAL and bool(driver.memory["signature"][0] >= 0)

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
        if live.driver.node_events & SAFETY_OBJECTS and MAY_ENERGISE[live.mode]:
            raise ViolationError(f"the signature is wrong or missing, and the mode is {Mode(live.mode).name}")
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
        if frame.can_id == OUTPUTS:
            self._look_at_outputs(frame)
        self._sent.append(frame)

    def _look_at_outputs(self, frame: Frame) -> None:
        """One frame in a tick, behind that with the voltages; in a mode and with bits that are permitted."""
        if not self._sent or self._sent[-1].can_id != DRIVE:
            raise ViolationError("digital outputs are sent, but not right behind the voltages")
        if not may_put_out(self.live.mode) or self.live.driver.state is not DriverState.OPERATIONAL:
            raise ViolationError(f"digital outputs are sent in {Mode(self.live.mode).name}")
        if len(frame.data) != 1 or frame.data[0] & ~PERMITTED_BITS:
            raise ViolationError(f"digital outputs {frame.data.hex()} are sent, which nobody may set")

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
        further = (bases.drive - was.drive) & 0xFF, (bases.sync - was.sync) % SYNCS
        if asked == BEGIN and bases.sync == 1 and any(f.can_id == NMT and f.data[0] == _RESET for f in self._sent):
            further = _ANEW
        self._sent.clear()
        return Answer(number, told, *further, frames=frames)

    def _label(self) -> tuple[int, ...]:
        live = self.live
        gate: Any = live.gate.memory[0]
        state, may_energise = live.driver.state, bool(MAY_ENERGISE[live.mode])
        choice = self._choices.get((live.mode, state))
        if choice is None:
            wishes = tuple(self._known.wishes.number(wish[1:]) for wish in wishes_of(live, self._configuration))
            choice = self._choices[live.mode, state] = self._known.choices.number(wishes)
        return (
            int(live.mode), state.value, may_energise,
            bool(gate["known"]) and not gate["latched"] and may_energise,
            self._known.counts.number(tuple(gate["count"].tolist())),
            choice,
            live.driver.memory["start"]["position"][0, 0] % 6 == 0,
            live.mode < Mode.IDLE and state not in (DriverState.FAILED, DriverState.OFF),
            may_put_out(live.mode), self._goes_by_signature,
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
        self._bits, self._is_sync = 0, False
        self.live = AmplifierNode(
            NODE_ID, self.clock, self._sent.append, self.plant, EDS,
            turnaround_us=TURNAROUND_US, fd=driver.fd, protection=driver.protection, error_hold_us=30_000,
            switch=self._on_switch,
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
                drive, sync = divmod(asked - SHIFT, SYNCS)
                self.bases = was._replace(drive=was.drive + drive & 0xFF, sync=(was.sync + sync) % SYNCS)
            elif asked >= FRAME:
                frame = absolute(self._known.frames.things[asked - FRAME], was)
                self._bits, self._is_sync = self.live.digital.bits, frame.can_id == SYNC
                self.live.on_frame(frame, was.now_us)
            else:
                self._bits, self._is_sync = self.live.digital.bits, False
                self.clock.run_until(was.now_us + asked - RUN)
            self._look_at_outputs()
        except ViolationError as violation:
            told = self._known.violation(violation)
        return self._answer(was, told)

    def _on_switch(self, bits: int, t_us: int) -> None:
        if bits & ~self._bits and not self._is_sync:
            raise ViolationError(f"digital outputs go from {self._bits:#04x} to {bits:#04x} without a SYNC")

    def _look_at_outputs(self) -> None:
        node = self.live
        if node.digital.bits and (node.state is not NmtState.OPERATIONAL or node._holds):
            raise ViolationError(f"digital outputs stay {node.digital.bits:#04x} in {node.state.name}")

    def _answer(self, was: Bases, told: int) -> Answer:
        counts = self.plant.counts
        self.bases = bases = self.bases._replace(now_us=self.clock.now_us, sense=self.live._sense.counter)
        key = self._state.key(bases, counts)
        number, is_new = self.kept.number(key, lambda: (self._state.take(), counts), bases)
        if is_new:
            next_us = self._next_us() - bases.now_us
            self.labels.append((self._known.counts.number(counts), next_us, self.live.digital.bits))
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
