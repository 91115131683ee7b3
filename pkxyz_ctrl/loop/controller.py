"""The controller of one stage: driver, cycle and gate around one law. Frames in, frames out; time is handed in.

It owns no clock and no bus. ``runtime`` drives it, whoever owns the time.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.can.driver import AmplifierDriver
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.can.other_traffic import OtherTraffic
from pkxyz_ctrl.can.start_sequence import DriverState
from pkxyz_ctrl.config.bus import BusConfig, CanConfig
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.period import period_on
from pkxyz_ctrl.loop.reference import REFERENCE, standing_still
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.gate import GateConfig, TransmitGate
from pkxyz_ctrl.safety.modes import NODE_EXPECTED, Event, Mode, next_mode
from pkxyz_ctrl.safety.trips import Trip, explain

Send = Callable[[Frame], object]

_IDLE, _FAULT = int(Mode.IDLE), int(Mode.FAULT)


class StartUpError(RuntimeError):
    """The amplifier could not be brought to operation; the message says what was expected, what came and what to do."""


class Controller:
    """One stage under control.

    ``send`` takes every frame that may go out; ``discard_unsent`` drops those that still wait, so that no voltage of
    before follows a fault decision; ``port_complaint`` says, as ``; ...``, what stands in the way of frames.
    ``faults`` collects a sentence for each fault decision. ``memory`` is the (1,) array of ``cycle.MEMORY`` that the
    cycle works on, ``row`` the bytes of its latest record.
    """

    def __init__(
        self,
        law: NDArray[np.void],
        bus: BusConfig,
        gate: GateConfig,
        send: Send,
        discard_unsent: Callable[[], object] = lambda: None,
        port_complaint: Callable[[], str] = lambda: "",
        driver: AmplifierDriver | None = None,
    ) -> None:
        if bus.can is None:
            raise ValueError(f"bus {bus.name!r} has no [can]: nothing to control over")
        self.can: CanConfig = bus.can
        self.driver = driver or AmplifierDriver(bus.can.driver, gate.count_slew_max)
        self.gate = TransmitGate(gate)
        self.faults: list[str] = []
        self.missed_ticks = 0
        """skipped, late on the wire, or without the sample that the node owed"""
        self.law = law
        self.memory = cycling.new_memory(Mode.BOOT)
        self._send = send
        self._discard_unsent = discard_unsent
        self._port_complaint = port_complaint
        row_at = dict(cycling.MEMORY.fields or {})["row"][1]
        self.row = self.memory.view(np.uint8).data[row_at : row_at + ROW.itemsize]
        # The cycle's memory holds mode and counts; looking at them there takes 40 ns this way.
        self._mode = self.memory["mode"].data
        self._count = self.memory["tick"]["count"][0, 0].data
        self.period_us = bus.period_us
        self._event = int(Event.NONE)
        self._clearing = False  # a clear was asked for, and is not done yet
        self._restart_due = False
        self._restarting = False
        self._blocked = 0
        self._sense = self.driver.sense
        self._others = OtherTraffic(bus.can.driver)
        self._begun_us = 0
        self._reference = standing_still()  # the latest that was handed in
        self._cycle = period_on(law, self._reference)
        self._cycle(law, cycling.new_memory(Mode.BOOT), self._reference, *[0] * 7)  # loaded now, not in the first tick

    @property
    def mode(self) -> int:
        """The mode after the last tick, a ``Mode``."""
        return self._mode[0]

    # -- start and stop ---------------------------------------------------------------------------------------------

    def start(self, t_us: int) -> None:
        """Begin the start-up dialogue with the amplifier."""
        self._others.forget(t_us)
        for frame in self.driver.start(t_us):
            self.send(frame, t_us)

    def dialogue(self, frame: Frame | None, t_us: int) -> bool:
        """One step of the start-up: a frame that came, or None if none came for a
        while. True once the node is operational.

        Raises ``StartUpError``, also for a frame that our own gate blocks: nobody would ever answer it.
        """
        driver = self.driver
        if frame is not None:
            self._others.note(frame, t_us)
        for reply in driver.poll(t_us) if frame is None else driver.receive(frame, t_us):
            self.send(reply, t_us)
        if self._blocked:
            raise StartUpError(self.faults[-1])
        if driver.state is DriverState.FAILED:
            raise StartUpError(f"{driver.failure}{self._complaints}")
        if driver.state is DriverState.CONFIGURING and self.mode == Mode.BOOT:
            self._apply(Event.NODE_FOUND)
        if driver.state is not DriverState.OPERATIONAL:
            return False
        self._apply(Event.NODE_READY)
        return True

    def stop(self, t_us: int) -> None:
        """0 V and pre-operational, whatever the mode."""
        for frame in self.driver.stop(t_us):
            self.send(frame, t_us)

    def request(self, event: Event) -> None:
        """Ask for an event at the next tick: HOME, ENABLE, TRACK, HOLD, DISABLE."""
        self._event = int(event)

    def hold_quietly(self, quiet: bool) -> None:
        """Ask for quiet holds, or no longer: less noise and less rejection while the set-point stands still."""
        self.memory["input"]["quiet"] = quiet

    def clear(self) -> None:
        """Ask to forget the fault. Once the combs have been at 0 V for long enough, gate, driver and node start anew,
        tick by tick, while the loop goes on; where that failed, it is tried again. Without a fault nothing happens.
        """
        self._clearing = self.mode == Mode.FAULT or (self.mode < _IDLE and self.driver.state is DriverState.FAILED)

    # -- one tick ---------------------------------------------------------------------------------------------------

    def begin(self, t_us: int) -> None:
        """The tick begins: SYNC, on which the amplifier applies the last voltages and samples. In FAULT the node is
        taken out of operational besides.
        """
        if self._mode[0] < _IDLE:
            self._go_on_starting(t_us)
        self._begun_us = t_us
        self.send(self.driver.sync(t_us), t_us)
        if self._mode[0] == _FAULT:  # 0 V in a drive frame acts at a SYNC only
            for frame in self.driver.release(t_us):
                self.send(frame, t_us)

    def receive(self, frame: Frame, t_us: int) -> bool:
        """Take a frame from the bus; True once this tick's sense values are there."""
        for reply in self.driver.receive(frame, t_us):
            self.send(reply, t_us)
        if self._sense.fresh:
            return True
        self._others.note(frame, t_us)
        return False

    def compute(self, reference: NDArray[np.void], overrun: int) -> None:
        """Run the cycle on what has come since the SYNC. ``reference`` (n,) of ``REFERENCE``;
        ``overrun`` ticks skipped before this one. Raises ValueError for another reference.
        """
        mode = self._mode
        was = mode[0]
        if self._clearing:
            self._event = int(Event.CLEAR) if was == _FAULT else self._event
        self.missed_ticks += overrun
        c1, c2, c3, status = self._sense.take()
        if status & 1:
            self.missed_ticks += int(NODE_EXPECTED[was])  # a node that we took out of operation owes none
        else:
            self._others.forget(self._begun_us)
        if self._blocked:
            self.memory["input"]["trips"] = self._blocked
            self._blocked = 0
        if reference is not self._reference:
            _require_rows(reference)
            self._reference = reference
        self._cycle(self.law, self.memory, reference, self._event, status, self.driver.node_events, overrun, c1, c2, c3)
        self._event = 0
        if mode[0] != was:
            self._enter(was)

    def finish(self, t_us: int, heartbeat_until_us: int) -> None:
        """Send the voltages of this tick, and our heartbeat behind them if it is due
        and still fits before the next SYNC.
        """
        driver = self.driver
        a, b, c = self._count
        self.send(driver.drive((a, b, c), t_us), t_us)
        heartbeat = driver.heartbeat_due(t_us)
        if heartbeat is not None and t_us <= heartbeat_until_us:
            self.send(heartbeat, t_us)
            driver.heartbeat_sent(t_us)

    def send(self, frame: Frame, t_us: int) -> None:
        """Send a frame, if the gate lets it pass; a voltage that it blocks becomes 0 V, and the next tick a fault."""
        reason = self.gate.check(frame, self._mode[0], t_us)
        if reason is None:
            self._send(frame)
            return
        self.faults.append(reason)
        self._blocked = int(Trip.GATE_BLOCKED)
        if frame.can_id == self.driver.drive_id:
            self.driver.revoke_drive()
            discharged = self.driver.drive((0, 0, 0), t_us)
            if self.gate.check(discharged, self._mode[0], t_us) is None:
                self._send(discharged)

    # -- modes ------------------------------------------------------------------------------------------------------

    def _go_on_starting(self, t_us: int) -> None:
        """After a clear: one step of the start-up at the beginning of a tick, without waiting for anything."""
        driver = self.driver
        if self._restart_due or (self._clearing and driver.state is DriverState.FAILED):
            self._restart_due = self._clearing = False
            self._restarting = True
            self.gate.clear()
            frames = driver.start(t_us)
        else:
            frames = driver.poll(t_us)
        for frame in frames:
            self.send(frame, t_us)
        if driver.state is DriverState.FAILED and self._restarting:
            self._restarting = False
            self.faults.append(f"start-up after a clear: {driver.failure}{self._complaints}")
            self._event = int(Event.NODE_LOST)
        elif driver.state is DriverState.CONFIGURING or (
            driver.state is DriverState.OPERATIONAL and self.mode == Mode.BOOT  # found and configured within one tick
        ):
            self._event = int(Event.NODE_FOUND)
        elif driver.state is DriverState.OPERATIONAL:
            self._event = int(Event.NODE_READY)

    def _apply(self, event: Event) -> None:
        """Let an event of the start-up act on the mode, before there are ticks."""
        self._mode[0] = next_mode(self.mode, int(event))

    def _enter(self, was: int) -> None:
        if was == Mode.FAULT:
            self._restart_due = True
        if self.mode == Mode.FAULT:
            self._discard_unsent()
            row = self.memory["row"][0]
            reason = explain(int(row["trips"]))
            emergencies = "".join(f"\n{e.told_at(self._begun_us)}." for e in self.driver.emergencies)
            detail = "".join(f" [{words}]" for words in (self.driver.failure, self.driver.foreign) if words)
            self.faults.append(f"at {row['t_us'] * 1e-6:.4f} s: {reason}{detail}{emergencies}{self._complaints}")

    @property
    def _complaints(self) -> str:
        return f"{self._others.complaint}{self._port_complaint()}"


def _require_rows(reference: NDArray[np.void]) -> None:
    """The compiled cycle doesn't look at what it is given, so it is looked at here, once for each block of rows."""
    if reference.dtype != REFERENCE or reference.ndim != 1 or len(reference) == 0:
        raise ValueError(f"a reference is (n,) of REFERENCE with n > 0, not {reference.shape} {reference.dtype}")
    if not reference.flags.c_contiguous:
        raise ValueError("the rows of a reference must follow one another in memory (numpy.ascontiguousarray)")
