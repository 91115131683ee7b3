"""The lockstep lane: controller, driver, gate, simulated bus, amplifier node and plant, with time owned by a scheduler.

No threads, no machine clock: the same bits from run to run.
"""

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.bus.clock import Lockstep
from hil.bus.endpoint import Endpoint
from hil.bus.frame_log import FrameLog
from hil.bus.wire import Wire
from hil.faults.clock import ControllerKilledError
from hil.faults.injection import Injection, plant_of
from hil.lanes.blocks import Blocks
from hil.lanes.setup import Setup
from hil.node.wired import wired_node
from hil.plant.on_bus import RECORD
from hil.plant.truth import TRUTH_BYTES
from hil.whole_ticks.stretches import Stretches
from pkxyz_ctrl.can.cob_id import SYNC
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.config.bus import CanConfig
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.core.demand import PREDICTIVE
from pkxyz_ctrl.loop.controller import Controller
from pkxyz_ctrl.loop.reference import REFERENCE
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.loop.runtime import Clock, Port, go_on, start
from pkxyz_ctrl.safety.modes import Mode

_ROW_BYTES: Final = ROW.itemsize
_TRUTH_AT: Final = ROW.itemsize - TRUTH_BYTES
_FEW_MOST: Final = 4  # ticks until whole ones are tried again


class WirePort:
    """``runtime.Port`` on the simulated wire, without the cost of python-can's messages.

    ``latency_us`` is that of a slow adapter: whatever is not a SYNC leaves so much later.
    """

    def __init__(self, endpoint: Endpoint, clock: Lockstep | None = None, latency_us: int = 0) -> None:
        self.send: Callable[[Frame], object] = endpoint.send
        self.receive = endpoint.receive
        self.unsent = endpoint.pending
        self.discard_unsent = endpoint.flush
        if clock is not None and latency_us > 0:

            def send_late(frame: Frame) -> None:
                if frame.can_id == SYNC:
                    endpoint.send(frame)
                else:
                    clock.call_at(clock.now_us + latency_us, partial(endpoint.send, frame))

            self.send = send_late


class _Draining:
    """A clock for plain PDOs, which carry no counter: what came after a tick had given up is taken before the next
    SYNC, or every later sense frame would be taken a tick too late.
    """

    def __init__(self, clock: Clock, endpoint: Endpoint, controller: Controller) -> None:
        self._clock, self._endpoint, self._controller = clock, endpoint, controller
        self.spend = clock.spend

    @property
    def now_us(self) -> int:
        return self._clock.now_us

    def wait_until(self, t_us: int) -> None:
        self._clock.wait_until(t_us)
        while (late := self._endpoint.receive_nowait()) is not None:
            self._controller.receive(late[0], self._clock.now_us)


class LockstepRig:
    """Everything between controller and plant, wired up for one run.

    ``whole_ticks``: those in which nothing else happens may run in one go; else each runs event by event, to the same
    bits. ``controller``: which of them, where one is to note its calls.
    """

    def __init__(
        self,
        setup: Setup,
        frame_log: Path | None = None,
        *,
        whole_ticks: bool = True,
        controller: type[Controller] = Controller,
    ) -> None:
        if setup.bus.can is None:
            raise ConfigError(
                f"bus {setup.bus.name!r} has no [can]: the lockstep lane is all about frames; use the fast lane"
            )
        can: CanConfig = setup.bus.can
        self.setup = setup
        self.clock = Lockstep()
        self.wire = Wire(self.clock, can.nominal_bitrate_bit_per_s, can.data_bitrate_bit_per_s, setup.seed)
        self.plant = plant_of(setup.new_plant(), setup.faults, setup.bus, setup.seed)
        amplifier = self.wire.attach("amplifier")
        self.node = wired_node(can, self.clock, amplifier.send, self.plant, switch=self.plant.switch)
        amplifier.on_frame = self.node.on_frame
        latency_us = (setup.bus.delay_periods - 1) * setup.bus.period_us
        self._endpoint = self.wire.attach("controller")
        self.port: Port = WirePort(self._endpoint, self.clock, latency_us)
        self.controller = controller(setup.law.copy(), setup.bus, setup.gate, self.port.send, self.port.discard_unsent)
        self.controller.outputs[0] = setup.new_outputs()[0]
        self.injection = _injection_of(self) if setup.faults or setup.clear_s is not None else None
        self.log = FrameLog(frame_log, can.channel) if frame_log is not None else None
        if self.log is not None:
            self.log.attach(self.wire)
        self._stretches = self._stretches_of() if whole_ticks else None

    def run(self, blocks: Blocks) -> tuple[int, float]:
        """Start the amplifier and run all ticks; returns how many were missed, and the bus load since the first."""
        injection = self.injection
        if injection is not None:
            injection.before_power_on()
        self.node.power_on()
        self._bring_up()
        before = self.wire.statistics()
        reference, record = _exchange_in_blocks(self, blocks)
        try:
            clock: Clock = self.clock
            taking: Callable[[int], object] = record
            if injection is not None:
                clock, taking = injection.arm(), injection.taking(record, reference.begin_anew)
            with _seldom_collected():
                self._run_ticks(clock, reference, taking, record)
        except ControllerKilledError:
            assert injection is not None
            injection.outlive(blocks.ticks)
        finally:
            record.finish()
            if self.log is not None:
                self.log.close()
        return self.controller.missed_ticks, self.wire.bus_load(before)

    def _bring_up(self) -> None:
        """The amplifier, to operation. Raises ``StartUpError``."""
        start(self.clock, self.port, self.controller)

    def _run_ticks(
        self, clock: Clock, reference: "_Reference", taking: Callable[[int], object], record: "_Recorder"
    ) -> None:
        """Whole ticks as long as they can be played; the others event by event."""
        if not self.controller.can.driver.protection:
            clock = _Draining(clock, self._endpoint, self.controller)
        ticks, tick, t_us = record.ticks, 0, self.clock.now_us + self.controller.period_us
        injection, stretches = self.injection, self._stretches
        watched, clearing = (None, None) if injection is None else (injection.watched, injection.clearing)
        if stretches is not None:
            stretches.keep(begun_anew=clearing is not None, watched=watched is not None)
        few = 1
        while tick < ticks:
            if stretches is not None:
                done = 0
                if stretches.may_begin(t_us, injection):
                    rows = reference(tick)
                    most = min(reference.left(tick), ticks - 1 - tick)
                    if clearing is not None and self.controller.mode in (Mode.FAULT, Mode.BOOT):
                        most = min(most, clearing.room)
                    done = stretches.run(rows, record.room(most), t_us)
                if done:
                    record.skip(done)
                    if clearing is not None:
                        clearing.skip(done)
                    if watched is not None:
                        watched += [(a, b, c) for a, b, c in stretches.watched_v[:done].tolist()]
                tick, t_us = tick + done, t_us + done * self.controller.period_us
                few = 1 if done else min(2 * few, _FEW_MOST)
            some = range(tick, min(tick + few, ticks))
            t_us = go_on(clock, self.port, self.controller, reference, some, taking, t_us)
            tick = some.stop

    def _stretches_of(self) -> Stretches | None:
        """What runs whole ticks, loaded; None for a law, a bus or a plant that has none."""
        law, can = self.controller.law["tick"], self.controller.can
        is_slow = self.setup.bus.delay_periods > 1
        if law["kind"][0] == PREDICTIVE or not can.driver.protection or is_slow:
            return None
        return Stretches(
            self.clock, self.wire, self._endpoint, self.node, self.plant, self.controller, self.log,
            self.wire.endpoints, self.injection,
        )  # fmt: skip


def _injection_of(rig: LockstepRig) -> Injection:
    setup = rig.setup
    return Injection(
        setup.faults, setup.clear_s, setup.bus.period_us, setup.seed,
        rig.clock, rig.wire, rig.node, rig.plant, rig.controller,
    )  # fmt: skip


@contextmanager
def _seldom_collected() -> Iterator[None]:
    """Let Python look for cyclic garbage every some thousand ticks only: frames make none, and looking costs 3 %."""
    usual = gc.get_threshold()
    gc.set_threshold(50_000, *usual[1:])
    try:
        yield
    finally:
        gc.set_threshold(*usual)


class _Recorder:
    """Puts the controller's row of each tick into the block, and the truth behind it."""

    def __init__(self, rig: LockstepRig, blocks: Blocks) -> None:
        self._blocks = blocks
        self._rows = blocks.rows.view(np.uint8).data
        self._row = rig.controller.row[:_TRUTH_AT]
        self._truth = rig.plant.record.view(np.uint8).data[:TRUTH_BYTES]
        self._plant, self._clock = rig.plant, rig.clock
        self._at = 0
        self.ticks = blocks.ticks

    def room(self, ticks: int) -> NDArray[np.void]:
        """Where the rows of the next ticks go."""
        first = self._at // _ROW_BYTES
        return self._blocks.rows[first : first + ticks]

    def skip(self, ticks: int) -> None:
        """So many of them are whole."""
        self._at += ticks * _ROW_BYTES

    def __call__(self, tick: int) -> None:
        rows, at = self._rows, self._at
        truth_at, end = at + _TRUTH_AT, at + _ROW_BYTES
        if not self._plant.was_sampled:  # a node that is not operational does not sample; what is true goes on
            self._plant.look(self._clock.now_us)
        self._plant.was_sampled = False
        rows[at:truth_at] = self._row
        rows[truth_at:end] = self._truth
        self._at = end  # last: a row counts once it is whole

    def finish(self) -> None:
        """Hand on the rows that wait."""
        self._at, count = 0, self._at // _ROW_BYTES
        self._blocks.hand_on(count)


class _Reference:
    """The rows of the trajectory for the present block; the record of the one before is handed on first."""

    def __init__(self, rig: LockstepRig, blocks: Blocks, recorder: _Recorder) -> None:
        self._memory = rig.controller.memory
        self._blocks = blocks
        self._finish = recorder.finish
        self._next = 0
        self._rows = np.zeros(0, REFERENCE)

    def __call__(self, tick: int) -> NDArray[np.void]:
        if tick == self._next:
            self._finish()
            self._next += self._blocks.next_count(self._memory)
            self._rows = self._blocks.reference(self._memory)
        return self._rows

    def left(self, tick: int) -> int:
        """Ticks from this one on for which the rows last."""
        return self._next - tick

    def begin_anew(self, tick: int) -> None:
        """The trajectory starts over after ``tick``: the block ends here, since its rows do not reach back so far."""
        self._next = tick + 1


def _exchange_in_blocks(rig: LockstepRig, blocks: Blocks) -> tuple[_Reference, _Recorder]:
    leads, ends = (dict(d.fields or {})["position_m"][1] for d in (RECORD, ROW))
    assert (leads, ends) == (0, _TRUTH_AT), "the truth leads the exchange and ends the row"
    recorder = _Recorder(rig, blocks)
    return _Reference(rig, blocks, recorder), recorder
