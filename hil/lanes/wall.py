"""The wall-clock lane: the same controller and the same loop at the machine's pace, over any python-can bus."""

import dataclasses
import time
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from hil.bus.unix_bus import UnixBus
from hil.lanes.ending import Ending
from hil.lanes.live_reference import LiveReference
from hil.lanes.setup import Setup
from hil.lanes.standstill import WaitingPort
from hil.lanes.streamed_reference import StreamedReference
from pkxyz_ctrl.can import cob_id
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.config.bus import BusConfig, CanConfig
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.io.can_port import CanPort, open_bus
from pkxyz_ctrl.io.clocks import HISTOGRAM_US, TickClock, WallClock, count_us
from pkxyz_ctrl.io.realtime import go_real_time, leave_real_time, settle_memory
from pkxyz_ctrl.learning import Learner
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.controller import Controller, StartUpError
from pkxyz_ctrl.loop.reference import standing_still
from pkxyz_ctrl.loop.row import TRUTH_FIELDS
from pkxyz_ctrl.loop.runtime import Reference, run, start
from pkxyz_ctrl.safety.gate import GateConfig
from pkxyz_ctrl.safety.modes import LOOP_CLOSED, Event, Mode

COMPANY_S = 30.0
"""For which an empty bus is given time."""
_LOOK_S = 0.02
GUARDS_PER_PERIOD = 8
SILENT_US = 500_000  # after a fault, for so long without its heartbeat, the amplifier is gone
NO_END = 1 << 60  # ticks
_LANDED_TICKS = 2  # that begin and end a way down
_LAST_FRAMES_S = 0.02  # 0 V and pre-operational leave even a slow adapter before it is closed


class AmplifierGoneError(Exception):
    """The amplifier has fallen silent, and nobody here could start it again."""


def require_real_bus(bus: BusConfig) -> CanConfig:
    """The bus's [can]. Raises ``ConfigError`` if other processes can't be reached there."""
    if bus.can is None:
        raise ConfigError(
            f"bus {bus.name!r} has no [can]: nothing to control over; give another --bus, such as unix_2k"
        )
    if bus.can.interface == "pkxyz-sim":
        raise ConfigError(
            f'bus {bus.name!r} is simulated (can.interface = "pkxyz-sim") and ends with its process; '
            "use `pkxyz sil`, or give a --bus with another interface, such as unix_2k"
        )
    return bus.can


def wall_gate(gate: GateConfig) -> GateConfig:
    """The gate for a loop that may be late: drive frames a guard apart, which ``TickClock`` keeps, not half a period.

    The SYNC between two voltages, which bounds the steps of the combs, it demands as ever.
    """
    return dataclasses.replace(gate, spacing_min_us=gate.period_us // GUARDS_PER_PERIOD)


def alone(company_s: float) -> str:
    """What is said on an empty bus."""
    return f"nobody else is on the bus yet: waiting {company_s:g} s for an amplifier, such as `pkxyz plant`"


class TakesFrames(Protocol):
    """Whoever takes note of what is sent and received."""

    def frame(self, frame: Frame, t_us: int) -> None:
        """A frame that was sent or received at ``t_us``."""


class TakesTicks(TakesFrames, Protocol):
    """... and of each tick."""

    def row(self, row: memoryview) -> None:
        """The bytes of a tick's record of ``ROW``."""


class _LoggedPort:
    """A port whose frames go to the recorder, too. ``heartbeat_us``: when the node said last that it is there.

    ``answer_us`` counts answers by whole microseconds from a sense frame that was read to the drive frame that was
    handed over, where that is the next to be sent; the last entry all beyond.
    """

    def __init__(self, port: CanPort, clock: WallClock, recorder: TakesFrames, driver: DriverConfig) -> None:
        self._port, self._clock, self._log = port, clock, recorder.frame
        self._heartbeat_id = cob_id.HEARTBEAT_BASE + driver.node_id
        self._sense_id = cob_id.sense(driver.node_id, driver.sense_pdo)
        self._drive_id = cob_id.drive(driver.node_id, driver.drive_pdo)
        self._sensed_ns = 0  # 0: nothing is to be answered
        self.answer_us = [0] * HISTOGRAM_US
        self.heartbeat_us = 0
        self.unsent = port.unsent

    def send(self, frame: Frame) -> None:
        sensed_ns, self._sensed_ns = self._sensed_ns, 0
        if self._port.send(frame):
            if sensed_ns and frame.can_id == self._drive_id:
                count_us(self.answer_us, (time.monotonic_ns() - sensed_ns) // 1000)
            self._log(frame, self._clock.now_us)

    def receive(self, deadline_us: int) -> Frame | None:
        frame = self._port.receive(deadline_us)
        if frame is not None:
            if frame.can_id == self._sense_id:
                self._sensed_ns = time.monotonic_ns()
            self._log(frame, self._port.last_us)
            if frame.can_id == self._heartbeat_id:
                self.heartbeat_us = self._port.last_us
        return frame


class WallRig:
    """Controller, clock and port of one run. ``close`` takes the combs to 0 V, whatever happened before."""

    def __init__(self, setup: Setup, recorder: TakesTicks, ending: Ending) -> None:
        self.setup = setup
        self._recorder = recorder
        self._ending = ending
        can_config = require_real_bus(setup.bus)
        law = setup.law.copy()  # a stage in operation may be given another
        learner = setup.new_learner()
        self.live = None if learner is None else LiveReference(setup.trajectory, setup.bus.period_us, learner)
        _warm_up(law, standing_still() if self.live is None else self.live.rows)
        self._bus = open_bus(can_config, setup.bus.name)
        self.clock = WallClock()
        self.can_port = CanPort(self._bus, self.clock, can_config.sense_deadline_us // 2)
        self.port = _LoggedPort(self.can_port, self.clock, recorder, can_config.driver)
        waits = can_config.standstill_max_us > 0
        self._port_of_ticks = WaitingPort(self.port, self.clock, setup.bus) if waits else self.port
        self.controller = Controller(
            law, setup.bus, wall_gate(setup.gate), self.port.send, self.can_port.discard_unsent,
            lambda: self.can_port.complaint,
        )  # fmt: skip
        self.controller.outputs[0] = setup.new_outputs()[0]
        for name, *_ in TRUTH_FIELDS:
            self.controller.memory["row"][name] = np.nan  # nobody here knows it
        self._guard_us = setup.bus.period_us // GUARDS_PER_PERIOD
        self.ticks = TickClock(
            self.clock,
            setup.bus.period_us,
            latest_start_us=can_config.sense_deadline_us // 2,
            guard_us=self._guard_us,
            standstill_us=can_config.standstill_max_us,
            late_frames=self._take_late_frames,
            leave=self._leave,
        )
        self._started = False

    @property
    def refused_frames(self) -> int:
        """Frames that the bus did not take."""
        return self.can_port.refused

    @property
    def lateness_us(self) -> list[int]:
        """Wake-ups by whole microseconds of lateness, the last entry all beyond."""
        return self.ticks.lateness_us

    @property
    def answer_us(self) -> list[int]:
        """Answers to a sense frame by whole microseconds, the last entry all beyond."""
        return self.port.answer_us

    @property
    def stood_us(self) -> int:
        """For how long time stood still."""
        return self.clock.stood_us

    @property
    def complaint(self) -> str:
        """``; ...``: what stands in the way of frames."""
        return self.can_port.complaint

    @property
    def learner(self) -> Learner | None:
        """Of a run that learns while it goes on."""
        return None if self.live is None else self.live.learner

    @property
    def is_amplifier_a_process(self) -> bool:
        """Whether the amplifier is another process of this machine."""
        return self.others is not None

    @property
    def others(self) -> int | None:
        """How many others are on the bus; None where that is not known."""
        return self._bus.others if isinstance(self._bus, UnixBus) else None

    @property
    def dropped_frames(self) -> int | None:
        """Frames that a bus among processes lost because a receiver stood still; None on other buses."""
        return self._bus.dropped if isinstance(self._bus, UnixBus) else None

    def wait_for_others(self, say: Callable[[str], object], company_s: float = COMPANY_S) -> None:
        """Until somebody else is on the bus, where that is known: a plant that was started in the same moment takes
        some seconds until it is there. Raises ``Ended``.
        """
        end_s = time.monotonic() + company_s
        if self.others == 0:
            say(alone(company_s))
        while self.others == 0 and time.monotonic() < end_s:
            self._ending.check()
            time.sleep(_LOOK_S)

    def go_real_time(self) -> str:
        """Ask the system for what a loop at rate needs; in a line what it gave."""
        words = go_real_time()
        settle_memory()
        return words

    def start(self, say: Callable[[str], object] = lambda words: None) -> None:
        """Start the amplifier; ``say`` is told which protections are lacking. Raises ``StartUpError`` and ``Ended``."""
        self._started = True
        try:
            start(self.clock, _Interruptible(self.port, self._ending), self.controller)
        except StartUpError:
            port = self.can_port
            if port.sent or not port.refused:
                raise
            raise StartUpError(port.refusal) from None
        for lacking in self.controller.driver.lost:
            say(f"this amplifier lacks a protection: {lacking}")

    def run(self) -> None:
        """Run all ticks of an amplifier that is started, and lead the stage down. Raises ``AmplifierGoneError`` and
        ``Ended``.
        """
        row, take = self.controller.row, self._recorder.row
        live, memory = self.live, self.controller.memory
        setup, last = self.setup, self.setup.ticks - 1
        streamed = StreamedReference(setup.trajectory, setup.bus.period_us, memory, setup.excitation)

        prepare = streamed.prepare if live is None else lambda: live.after(memory)
        controller, fault = self.controller, int(Mode.FAULT)
        ticks = setup.ticks + int(setup.law["landing_ticks"][0]) + _LANDED_TICKS

        def record(tick: int) -> None:
            if tick <= last:
                take(row)
                prepare()
            if tick == last and LOOP_CLOSED[controller.mode]:
                controller.request(Event.DISABLE)
            if controller.mode == fault:
                self._require_amplifier()

        rows = None if live is None else live.rows
        reference: Reference = streamed if rows is None else lambda tick: rows
        run(self.ticks, self._port_of_ticks, controller, reference, ticks, record)

    def operate(self, reference: Reference, after: Callable[[int], object]) -> None:
        """Run until somebody ends it: set-points are handed in, and ``after`` is called after each tick. Raises
        ``Ended``.
        """
        run(self.ticks, self._port_of_ticks, self.controller, reference, NO_END, after)

    def close(self) -> None:
        """0 V, pre-operational, off the bus, and an ordinary process again."""
        try:
            if self._started:
                self.clock.wait_until(self.clock.now_us + self._guard_us)  # or the gate calls it a babbling node
                self.controller.stop(self.clock.now_us)
                time.sleep(_LAST_FRAMES_S)
        finally:
            self._bus.shutdown()
            leave_real_time()

    def _leave(self) -> None:
        """Between two ticks: raise ``Ended`` if somebody asked for the end, once the stage has been led down."""
        mode = self.controller.mode
        if self._ending.signal_number and LOOP_CLOSED[mode]:
            self.controller.request(Event.DISABLE)
        elif mode != Mode.LANDING:
            self._ending.check()

    def _require_amplifier(self) -> None:
        if self.clock.now_us - self.port.heartbeat_us > SILENT_US:
            raise AmplifierGoneError

    def _take_late_frames(self, until_us: int) -> None:
        """What waits, as far as there is time for it: on a flooded bus there is always more."""
        port, controller, clock = self.port, self.controller, self.clock
        while clock.now_us < until_us and (frame := port.receive(0)) is not None:
            controller.receive(frame, clock.now_us)


class _Interruptible:
    """A port for the start-up, which can be ended while it waits."""

    def __init__(self, port: _LoggedPort, ending: Ending) -> None:
        self._port, self._ending = port, ending
        self.send, self.unsent = port.send, port.unsent

    def receive(self, deadline_us: int) -> Frame | None:
        self._ending.check()
        return self._port.receive(deadline_us)


def _warm_up(law: Any, reference: Any) -> None:
    """Load the compiled cycle before it is waited for."""
    memory = cycling.new_memory()
    for _ in range(3):
        cycling.cycle(law, memory, reference)
