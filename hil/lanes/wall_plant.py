"""Amplifier node and plant at the machine's pace, behind any python-can bus: one thread that waits for frames.

Time is that of the frames: a SYNC acts when it was on the bus, by its time stamp, not when this process woke up. Where
nothing comes, alarms (heartbeats, their supervision) ring by the machine's clock. So the node's clock is the
discrete-event clock of lockstep, pulled along. On a bus whose loop lets time stand still, so does it (``standstill``).
"""

import struct
from collections.abc import Callable
from pathlib import Path

import can
import numpy as np

from hil.bus.clock import Lockstep
from hil.lanes.setup import Setup
from hil.lanes.standstill import AmplifierTime
from hil.node.amplifier import NmtState
from hil.node.wired import wired_node
from hil.plant.on_bus import PlantOnBus
from hil.plant.truth import TRUTH_BYTES
from pkxyz_ctrl.can import cob_id
from pkxyz_ctrl.can.codec import Counts
from pkxyz_ctrl.config.bus import CanConfig
from pkxyz_ctrl.io.can_port import CanPort
from pkxyz_ctrl.io.clocks import SPIN_US, WallClock
from pkxyz_ctrl.io.realtime import cores
from pkxyz_ctrl.loop.row import TRUTH_FIELDS
from sim.plant import Plant

TRUTH = np.dtype([("t_us", "i8"), *TRUTH_FIELDS, ("sense_count", "i4", (3,))])
"""A row of the truth: time of the sample since the process began, position, strokes and voltages at it, counts sent."""

_TRUTH_ROW = struct.Struct(f"<q{TRUTH_BYTES}s3i")
_IDLE_US = 20_000  # between looks at whether to end
_BACKLOG_US = 20_000  # no frame acts later than this: behind a flood, a node's watchdogs would live in the past
_IN_FLIGHT_US = 2_000  # a frame may still come that is so much older than now


class WitnessedPlant(PlantOnBus):
    """A plant on the bus that writes the truth at each sample to a file of rows of ``TRUTH``."""

    def __init__(self, plant: Plant, out: Path) -> None:
        super().__init__(plant)
        self._file = out.open("wb", buffering=0)  # readable while it grows, and whole whatever ends the process
        self._record_bytes = self.record.view(np.uint8).data

    def exchange(self, t_us: int, counts: Counts | None, *, sample: bool) -> Counts:
        """With each sample, what is true is written down."""
        sensed = super().exchange(t_us, counts, sample=sample)
        if sample:
            self._file.write(_TRUTH_ROW.pack(t_us, bytes(self._record_bytes[:TRUTH_BYTES]), *sensed))
        return sensed

    def close(self) -> None:
        """No more truth."""
        self._file.close()


class WallPlant:
    """Node and plant of ``setup`` on ``bus``. ``on_change`` is told each NMT state and whether combs are driven."""

    def __init__(
        self,
        setup: Setup,
        can_config: CanConfig,
        bus: can.BusABC,
        on_change: Callable[[float, str, bool], object],
        truth: Path | None = None,
    ) -> None:
        _warm_up(setup)
        self.wall = WallClock()
        self.clock = Lockstep()
        self.plant = PlantOnBus(setup.new_plant()) if truth is None else WitnessedPlant(setup.new_plant(), truth)
        spin_us = SPIN_US if cores() > 1 else 0  # or who sends voltages would have to wake us
        self._port = CanPort(bus, self.wall, spin_us)
        self.node = wired_node(can_config, self.clock, self._port.send, self.plant, switch=self.plant.switch)
        self._time = AmplifierTime(setup.bus.period_us, can_config.standstill_max_us)
        self._on_change = on_change
        self._shown = (NmtState.INITIALISING, False)

    def serve(self, leave: Callable[[], object]) -> None:
        """Serve until ``leave``, called at least every 20 ms, raises."""
        clock, wall, port, node, time = self.clock, self.wall, self._port, self.node, self._time
        node.power_on()
        moved_us = 0
        while True:
            leave()
            due_us = clock.next_event_us()
            idle_us = wall.now_us + _IDLE_US
            frame = port.receive(idle_us if due_us is None else min(idle_us, time.wall_us(due_us)))
            if frame is not None:
                wall_us = wall.now_us
                stamp_us = max(wall_us - _BACKLOG_US, min(port.last_us, wall_us))
                if frame.can_id == cob_id.SYNC:
                    time.sync(stamp_us, wall_us)
                t_us = max(clock.now_us, time.time_us(stamp_us))
                clock.run_until(t_us)
                node.on_frame(frame, t_us)
                self._show()
                continue
            if due_us is not None and due_us <= time.time_us(wall.now_us):
                clock.run_until(due_us)
            if wall.now_us > moved_us + _IDLE_US:
                moved_us = wall.now_us
                self._move_on()
            self._show()

    def _move_on(self) -> None:
        """Where no SYNC comes, keep the plant from falling behind: it would have to catch up at the next."""
        t_us = max(self.clock.now_us, self._time.time_us(self.wall.now_us) - _IN_FLIGHT_US)
        self.clock.run_until(t_us)
        self.plant.exchange(t_us, None, sample=False)

    def _show(self) -> None:
        shown = (self.node.state, any(self.node.outputs))
        if shown != self._shown:
            self._shown = shown
            self._on_change(self.clock.now_us * 1e-6, shown[0].name.lower().replace("_", "-"), shown[1])


def _warm_up(setup: Setup) -> None:
    """Load the compiled plant before it is waited for."""
    scratch = PlantOnBus(setup.new_plant())
    for t_us in (0, 500, 1000):
        scratch.exchange(t_us, (0, 0, 0), sample=True)
    scratch.exchange(1500, (0, 0, 0), sample=False)
