"""An interface that goes down while the loop works: the fault says so."""

import errno

import can
import numpy as np
from loop_rig import setup, shortened

from hil.lanes.blocks import Blocks
from hil.lanes.lockstep import LockstepRig
from pkxyz_ctrl.io.can_port import CanPort
from pkxyz_ctrl.loop.controller import Controller
from pkxyz_ctrl.safety.modes import Mode

TICKS, DOWN_FROM, CLEAR_AT = 1500, 800, 1000


class DeadInterface(can.BusABC):
    """What the kernel says to whoever sends while the link is down."""

    def __init__(self):
        super().__init__("can0")
        self.channel_info = "can0"

    def send(self, msg, timeout=None):
        raise can.CanOperationError("Failed to transmit: Network is down", errno.ENETDOWN)


class Down:
    """The controller's port: the wire, until the interface is down."""

    def __init__(self, port, clock):
        self._port, self._clock = port, clock
        self._down = CanPort(DeadInterface(), clock)
        self.is_down = False

    def send(self, frame):
        return self._down.send(frame) if self.is_down else self._port.send(frame)

    def receive(self, deadline_us):
        if not self.is_down:
            return self._port.receive(deadline_us)
        self._clock.wait_until(max(deadline_us, self._clock.now_us))
        return None

    def unsent(self):
        return 0

    @property
    def complaint(self):
        return self._down.complaint


def test_a_fault_names_the_interface_that_is_down():
    rig, rows = LockstepRig(shortened(setup(), TICKS), whole_ticks=False), []
    port = rig.port = Down(rig.port, rig.clock)
    shipped = rig.setup
    controller = rig.controller = Controller(
        shipped.law, shipped.bus, shipped.gate, port.send, lambda: None, lambda: port.complaint
    )

    def watch(block):
        rows.append(block.copy())

    compute, ticks = controller.compute, iter(range(TICKS))

    def computing(reference, overrun):
        tick = next(ticks)
        port.is_down = tick >= DOWN_FROM
        if tick == CLEAR_AT:
            controller.clear()
        compute(reference, overrun)

    controller.compute = computing
    rig.run(Blocks(shipped.trajectory, shipped.bus.period_us, TICKS, watch, lambda done, total: None))
    mode = np.concatenate(rows)["mode"]
    assert mode[DOWN_FROM - 1] == Mode.TRACKING
    assert mode[DOWN_FROM + 20] == Mode.FAULT
    assert mode[CLEAR_AT + 100] < Mode.IDLE  # starting anew, and nobody answers
    (fault,) = controller.faults
    assert "; the interface refuses frames (Failed to transmit: Network is down" in fault
    assert fault.endswith("; it is down: ip link set ... up)")
