"""The composition that is explored: shipped controller and shipped node, a wire that may do anything, any law, anybody.

Controller (driver, modes, monitors, cycle, gate) and amplifier node are the classes that run everywhere else. Their
frames meet here without a bus: `World` does in one tick what ``loop.runtime`` does, and stops wherever something is
not decided by the code. There `options` tells what may happen, and `take` lets one of them happen.

What is small here and large elsewhere: the period is 20 ms, so that the shipped time-outs in ms are two or three
SYNCs; node and driver wait for some ticks only; the sense input gives up counting after 4 SYNCs (255), and the node's
errors last 30 ms (100). Each of these is compared with a count or an age and has no other effect, so a longer one
adds ticks in which the same things happen, and none else; that each order in which they can run out occurs is a
matter of the sizes in `CONFIGURATIONS`.
"""

from collections import deque
from functools import cache
from typing import Any

from any_law import LANDING_TICKS, any_law, bend, reference_for
from configurations import (
    CONTROLLER_ID,
    CUTS,
    DRIVE,
    EMCY,
    FROM_US,
    LATE_TICKS,
    LEVELS,
    MAXIMUM,
    NODE_ID,
    PERIOD_US,
    POLL_US,
    REQUEST,
    SENSE,
    SETTLED,
    STEP,
    SYNC,
    TOO_FAR,
    TURNAROUND_US,
    Configuration,
    bus_of,
    few_settings,
)
from fates import Held, Option, Plant, ViolationError, damaged, fates_of, wishes_of
from node_rig import EDS
from snapshot import Attributes, Bases, Snapshot

from hil.bus.clock import Lockstep
from hil.node.amplifier import AmplifierNode
from pkxyz_ctrl.can.codec import Counts, ProcessCodec
from pkxyz_ctrl.can.driver_rules import DriverState
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.loop.controller import Controller, StartUpError
from pkxyz_ctrl.safety.gate import GateConfig
from pkxyz_ctrl.safety.modes import MAY_ENERGISE, Event, Mode


class World:
    """One state of the composition at a time; see the module."""

    def __init__(self, configuration: Configuration, attributes: Attributes | None = None) -> None:
        self.configuration = configuration
        bus = bus_of(configuration)
        assert bus.can is not None
        driver = bus.can.driver
        self.law = any_law(PERIOD_US, homing_ticks=2)
        self._references = {counts: reference_for(self.law, counts) for counts in (*LEVELS, *TOO_FAR)}
        gate = GateConfig(
            count_max=MAXIMUM, count_slew_max=STEP, period_us=PERIOD_US, node_id=NODE_ID,
            controller_node_id=CONTROLLER_ID, fd=driver.fd,
        )  # fmt: skip
        self.clock = Lockstep()
        self.wire: deque[Frame] = deque()
        self.received: deque[Frame] = deque()  # by the controller's port, not read yet
        self.held: tuple[Held, ...] = ()
        self.plant = Plant(lambda: self.node.state)
        settings = () if configuration.whole_dialogue else few_settings(driver, STEP)
        self.controller = Controller(self.law, bus, gate, self._from_controller, settings=settings)
        self.controller.driver.sense.record["syncs_uncountable"] = 4
        self.node = AmplifierNode(
            NODE_ID, self.clock, self.wire.append, self.plant, EDS,
            turnaround_us=TURNAROUND_US, fd=driver.fd, protection=driver.protection, error_hold_us=30_000,
        )  # fmt: skip
        self._codecs = {DRIVE: ProcessCodec(DRIVE, True), SENSE: ProcessCodec(SENSE, True)}
        self.faults_left = configuration.faults
        self.phase = "start"
        self.tick_us = 0
        self.skipped = 0
        self.since_decision = 0  # ticks since it was decided that the combs go to 0 V, while they are not there
        self.quiet = 0  # ticks in a row with 0 V commanded and this tick's sense values there
        self.apart = 0  # ticks since the combs hold something else than what the gate takes them to hold
        self.believed: Counts = (0, 0, 0)  # by the gate, before its last frame
        self.cut: frozenset[int] = frozenset()  # what no longer gets through
        self.landing = 0  # ticks in a row in which the stage was led down
        self.longest = self.longest_apart = 0
        self.node.power_on()
        self.controller.start(0)
        if attributes is not None:
            parts = attributes.of(self.parts())
            self._snapshot = Snapshot(parts, self.controller, self.node)

    def parts(self) -> list[object]:
        """What everything else can be reached from."""
        return [self.controller, self.node, self.clock]

    # -- state ---------------------------------------------------------------------------------------------------

    def take_state(self) -> tuple[Any, ...]:
        mine = (
            tuple(self.wire), tuple(self.received), self.held, self.plant.counts, self.faults_left, self.phase,
            self.tick_us, self.skipped, self.since_decision, self.quiet,
            self.apart, self.believed, self.cut, self.landing,
        )  # fmt: skip
        return mine, self._snapshot.take()

    def put_state(self, state: tuple[Any, ...]) -> None:
        mine, rest = state
        (
            wire, received, self.held, self.plant.counts, self.faults_left, self.phase,
            self.tick_us, self.skipped, self.since_decision, self.quiet,
            self.apart, self.believed, self.cut, self.landing,
        ) = mine  # fmt: skip
        self.wire.clear()
        self.wire.extend(wire)
        self.received.clear()
        self.received.extend(received)
        self._snapshot.put(rest)

    def bases(self) -> Bases:
        driver: Any = self.controller.driver.memory[0]
        counters = int(driver["drive_counter"]), self.node._sense.counter, int(driver["sync_count"])
        return Bases(self.clock.now_us, *counters)

    def key(self, state: tuple[Any, ...]) -> bytes:
        mine, rest = state
        bases = self.bases()
        wire, received, held, counts, left, phase, tick_us, skipped, since, quiet, apart, believed, cut, down = mine
        more = (
            tuple(self._frame_key(f, bases) for f in wire),
            tuple(self._frame_key(f, bases) for f in received),
            tuple(sorted((self._frame_key(h.frame, bases), h.ticks_left) for h in held)),
            counts, left, phase, tick_us - bases.now_us, skipped, since, quiet,
            apart, believed, tuple(sorted(cut)), down,
        )  # fmt: skip
        return self._snapshot.key(rest, bases, more)

    def _frame_key(self, frame: Frame, bases: Bases) -> tuple[Any, ...]:
        can_id, data, _ = frame
        if can_id in self._codecs and len(data) == 8:
            a, b, c, counter, is_right = self._codecs[can_id].decode(data)
            base = bases.drive if can_id == DRIVE else bases.sense
            return can_id, repr((a, b, c, (counter - base) & 0xFF, is_right))
        if can_id == SYNC and len(data) == 1:
            return can_id, repr((data[0] - bases.sync) % 240)
        if can_id == EMCY:
            return can_id, repr(int.from_bytes(data[:2], "little") >= 0x100)
        return can_id, data.hex()

    def is_landmark(self) -> bool:
        """Where ways meet again although nothing is to be decided: before a tick, and now and then in the dialogue."""
        if self.wire:
            return self.wire[0].can_id == REQUEST and self.controller.driver.memory["start"]["position"][0, 0] % 6 == 0
        return self.phase == "before"

    # -- what may happen -----------------------------------------------------------------------------------------

    def options(self) -> list[Option]:
        """Everything that may happen now; the first is what happens when nothing goes wrong. Empty: it has ended."""
        if self.phase == "ended":
            return []
        if self.wire:
            return fates_of(self.wire[0], self.configuration.kinds if self.faults_left else frozenset(), self.cut)
        if self.phase in ("before", "after"):
            options: list[Option] = [("go",)]
            if self.phase == "before" and self.faults_left and "skip" in self.configuration.kinds:
                options.append(("skip",))
            if self.phase == "before" and self.faults_left and "cut" in self.configuration.kinds and not self.cut:
                options += [("cut", name) for name in CUTS]
            if self.phase == "before" and self.cut:
                options.append(("mend",))
            options += [("release", place) for place in range(len(self.held))]
            return options
        if self.phase == "compute":
            return wishes_of(self.controller)
        return [("go",)]

    # -- what happens --------------------------------------------------------------------------------------------

    def take(self, option: Option) -> None:
        """Let one of `options` happen. Raises `ViolationError`."""
        match option[0]:
            case "deliver":
                self._deliver(self.wire.popleft())
            case "lose":
                self.faults_left -= 1
                self.wire.popleft()
            case "late":
                self.faults_left -= 1
                self.held = (*self.held, Held(self.wire.popleft(), LATE_TICKS))
            case "repeat":
                self.faults_left -= 1
                frame = self.wire.popleft()
                self.held = (*self.held, Held(frame, LATE_TICKS))
                self._deliver(frame)
            case "damage":
                self.faults_left -= 1
                self._deliver(damaged(self.wire.popleft())[option[1]])
            case "release":
                place = option[1]
                frame = self.held[place].frame
                self.held = self.held[:place] + self.held[place + 1 :]
                self._deliver(frame)
            case "vanish":
                self.wire.popleft()
            case "cut":
                self.faults_left -= 1
                self.cut = CUTS[option[1]]
            case "mend":
                self.cut = frozenset()
            case "skip":
                self.faults_left -= 1
                self.skipped += 1
                self._pass_tick()
            case "tick":
                self._compute(*option[1:])
            case _:
                self._go_on()

    def _from_controller(self, frame: Frame) -> None:
        """What the gate has let through."""
        if frame.can_id == DRIVE and any(frame.data[:6]):
            controller = self.controller
            if not MAY_ENERGISE[controller.mode] or not controller.memory["homed"][0]:
                raise ViolationError(
                    f"a voltage is sent in {Mode(controller.mode).name}, homed {controller.memory['homed'][0]}"
                )
            if controller.driver.state is not DriverState.OPERATIONAL:
                raise ViolationError(f"a voltage is sent while the driver is {controller.driver.state.name}")
        self.wire.append(frame)

    def _deliver(self, frame: Frame) -> None:
        if frame.can_id in FROM_US:
            self.node.on_frame(frame, self.clock.now_us)
        else:
            self.received.append(frame)

    def _go_on(self) -> None:
        match self.phase:
            case "start":
                self._start()
            case "before":
                self.controller.begin(self.tick_us)
                self.phase = "sync"
            case "sync":
                self.clock.run_until(self.tick_us + TURNAROUND_US)
                self.phase = "sense"
            case "sense":
                self.phase = "after"
            case "after":
                self.phase = "read"
            case "read":
                self._read()
            case "finish":
                self.clock.run_until(self.tick_us + PERIOD_US // 2)
                if not self.wire:
                    now_us = self.clock.now_us
                    self.controller.finish(now_us, now_us)
                    self.phase = "rest"
            case "rest":
                self._rest()

    def _start(self) -> None:
        """As ``loop.runtime.start``."""
        try:
            if self.received:
                done = self.controller.dialogue(self.received.popleft(), self.clock.now_us)
            else:
                next_us = self.clock.next_event_us()
                until_us = self.clock.now_us + POLL_US
                self.clock.run_until(until_us if next_us is None else min(until_us, next_us))
                if self.wire:
                    return
                done = self.controller.dialogue(None, self.clock.now_us)
        except StartUpError:
            self.phase = "ended"
            if any(self.plant.counts):
                raise ViolationError("a start-up that failed leaves a voltage") from None
            return
        if done:
            self.tick_us = self.clock.now_us + PERIOD_US
            self.phase = "rest"
            self.tick_us -= PERIOD_US

    def _read(self) -> None:
        while self.received:
            if self.controller.receive(self.received.popleft(), self.clock.now_us):
                self.phase = "compute"
                return
            if self.wire:
                return
        self.phase = "compute"

    def _compute(self, event: Event, counts: Counts, trips: int) -> None:
        controller = self.controller
        if event is Event.CLEAR:
            controller.clear()
        elif event is not Event.NONE:
            controller.request(event)
        reference = self._references[counts]
        memory: Any = controller.memory[0]
        memory["setpoint"] = reference["motion"][0]
        if controller.mode == Mode.LANDING:
            memory["landing_from"][6:9] = reference["motion"][0, 6:9] / bend(int(memory["landing_age"]) + 1)
        memory["input"]["trips"] |= trips
        was, fresh = controller.mode, controller.driver.sense.fresh
        controller.compute(reference, self.skipped)
        self.skipped = 0
        if MAY_ENERGISE[controller.mode] and not MAY_ENERGISE[was] and self.quiet < SETTLED:
            raise ViolationError(f"the loop is closed after {self.quiet} quiet ticks, {SETTLED} are asked for")
        is_quiet = fresh and not controller.memory["tick"]["count"][0, 0].any()
        self.quiet = min(self.quiet + 1, SETTLED) if is_quiet else 0
        self.phase = "finish"

    def _rest(self) -> None:
        next_us = self.clock.next_event_us()
        end_us = self.tick_us + PERIOD_US
        if next_us is not None and next_us <= end_us:
            self.clock.run_until(next_us)
            return
        self._pass_tick()

    def _pass_tick(self) -> None:
        self.tick_us += PERIOD_US
        self.clock.run_until(self.tick_us)
        self._compare_beliefs()
        self.landing = self.landing + 1 if self.controller.mode == Mode.LANDING else 0
        if self.landing > LANDING_TICKS + 1 + self.configuration.faults:  # a fault may be a tick that is missed
            raise ViolationError(f"the stage has been led down for {self.landing} ticks")
        if MAY_ENERGISE[self.controller.mode] or not any(self.plant.counts):
            self.since_decision = 0
        else:
            self.since_decision += 1
            self.longest = max(self.longest, self.since_decision)
            if self.since_decision > self.configuration.settle_ticks:
                raise ViolationError(
                    f"{self.since_decision} ticks after the decision the combs hold {self.plant.counts}"
                )
        self.held = tuple(Held(h.frame, h.ticks_left - 1) for h in self.held if h.ticks_left > 1)
        self.phase = "before"

    def _compare_beliefs(self) -> None:
        """Do energised combs hold what the gate takes them to hold? It may be wrong while it can't know better.

        Combs at 0 V that the gate takes for energised (no drive frame arrives) are the business of the loop's monitors.
        """
        gate: Any = self.controller.gate.memory[0]
        believes = gate["known"] and not gate["latched"] and MAY_ENERGISE[self.controller.mode]
        if not believes or not any(self.plant.counts) or self.plant.counts == self.believed:
            self.apart = 0
        else:
            self.apart += 1
            self.longest_apart = max(self.longest_apart, self.apart)
            if self.apart > self.configuration.agree_ticks:
                raise ViolationError(
                    f"for {self.apart} ticks the gate takes combs at {self.plant.counts} to be at {self.believed}"
                )
        self.believed = tuple(gate["count"].tolist()) if believes else (0, 0, 0)

    @property
    def is_running(self) -> bool:
        """The loop is closed: where every state has to have a way to."""
        return self.controller.mode == Mode.ENABLED

    @property
    def is_starting(self) -> bool:
        """On the way from NMT reset to IDLE."""
        return self.controller.mode < Mode.IDLE and self.controller.driver.state not in (
            DriverState.FAILED,
            DriverState.OFF,
        )


@cache
def learnt(configuration: Configuration) -> Attributes:
    """What may change, learnt from a world that has been through what goes well."""
    model = World(configuration)
    wishes = [Event.HOME, *[Event.NONE] * 4, Event.ENABLE, Event.NONE, Event.DISABLE, *[Event.NONE] * 3]
    while wishes:
        if model.phase == "compute":
            model.take(("tick", wishes.pop(0), LEVELS[0], 0))
        else:
            model.take(model.options()[0])
    return Attributes(model.parts())
