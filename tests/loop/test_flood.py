"""A bus that never falls silent: a tick still ends in time, the fault says that it is a flood, and combs are at 0 V.

In lockstep, where each frame that is read costs a dose of time, and at a clock that counts reads instead of seconds.
"""

import itertools
import time

import can
import numpy as np
import pytest
from loop_rig import law, setup, shortened

from hil.lanes.blocks import Blocks
from hil.lanes.lockstep import LockstepRig
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.files import load
from pkxyz_ctrl.io.can_port import CanPort
from pkxyz_ctrl.io.clocks import TickClock, WallClock
from pkxyz_ctrl.loop.controller import Controller, StartUpError
from pkxyz_ctrl.loop.runtime import start
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.trips import Trip

pytestmark = pytest.mark.at_rate

TICKS, FLOOD_FROM, READ_US = 1200, 800, 7
STALE = 5  # ticks without a sense frame that are a fault: stale_count of the shipped controllers
FOREIGN = Frame(0x123, bytes(8), True, True)


class FloodedPort:
    """The controller's port on a bus where, once it is told to, somebody else's frame is always there to be read."""

    def __init__(self, port, clock):
        self._port, self._clock = port, clock
        self.send, self.unsent, self.discard_unsent = port.send, port.unsent, port.discard_unsent
        self.flooded, self.reads_in_a_row = False, 0

    def receive(self, deadline_us):
        if not self.flooded:
            return self._port.receive(deadline_us)
        self.reads_in_a_row += 1
        assert self.reads_in_a_row < 10_000, "the loop waits for the end of a flood"
        self._clock.spend(READ_US)
        return FOREIGN


def flooded_rows():
    """Rows (n,), the controller and the times at which ticks of a flooded run had read their last frame."""
    rig, found, ends_us = LockstepRig(shortened(setup(), TICKS), whole_ticks=False), [], []
    port = rig.port = FloodedPort(rig.port, rig.clock)
    compute = rig.controller.compute

    def computing(reference, overrun):
        ends_us.append(rig.clock.now_us)
        port.flooded, port.reads_in_a_row = len(ends_us) >= FLOOD_FROM, 0
        compute(reference, overrun)

    rig.controller.compute = computing
    period_us = rig.setup.bus.period_us
    rig.run(Blocks(rig.setup.trajectory, period_us, TICKS, lambda b: found.append(b.copy()), lambda done, total: None))
    return np.concatenate(found), rig.controller, np.array(ends_us)


def test_the_deadline_holds_and_the_fault_names_the_flood():
    rows, controller, ends_us = flooded_rows()
    assert (rows["mode"][600:FLOOD_FROM] == Mode.TRACKING).all()
    assert (rows["voltage_v"][FLOOD_FROM - 1] > 5.0).any()
    deadline_us = controller.can.sense_deadline_us
    late_us = ends_us - ends_us[0] - np.arange(TICKS) * controller.period_us  # the first tick is answered, and early
    assert deadline_us <= late_us[FLOOD_FROM:].max() + ends_us[0] % controller.period_us
    assert np.ptp(late_us[FLOOD_FROM:]) <= READ_US
    assert rows["overrun"].sum() == 0

    decided = FLOOD_FROM + STALE - 1
    assert rows["mode"][decided] == Mode.FAULT
    assert rows["trips"][decided] == Trip.SENSE_STALE
    assert (rows["mode"][decided:] == Mode.FAULT).all()
    assert (rows["drive_count"][decided:] == 0).all()
    assert (rows["voltage_v"][decided + 2 :] == 0.0).all()  # what is sent in a tick is applied at the next SYNC
    (reason,) = controller.faults
    assert "flooded" in reason
    assert "0x123" in reason


class Counted:
    """A clock that moves on by ``READ_US`` at each read of the bus, and else only where it is waited for."""

    def __init__(self):
        self.now_us = 0

    def wait_until(self, t_us):
        self.now_us = max(self.now_us, t_us)

    def spend(self, compute_us):
        """Computing is for nothing here."""


class Endless(can.BusABC):
    """A bus that always has one more frame."""

    def __init__(self, clock):
        super().__init__("endless")
        self.channel_info, self._clock, self.reads, self.sent = "endless", clock, 0, []

    def _recv_internal(self, timeout):
        self.reads += 1
        assert self.reads < 1_000_000, "somebody waits for the end of a flood"
        self._clock.now_us += READ_US
        return can.Message(arbitration_id=0x123, is_extended_id=False, timestamp=1.0), False

    def send(self, msg, timeout=None):
        self.sent.append(msg)


@pytest.fixture
def flood():
    clock = Counted()
    with Endless(clock) as bus:
        yield clock, bus, CanPort(bus, clock, spin_us=100)


def test_between_ticks_what_came_late_is_taken_until_the_next_begins(flood):
    clock, _, port = flood
    period_us, taken = 500, []

    def late_frames(until_us):
        while clock.now_us < until_us and (frame := port.receive(0)) is not None:
            taken.append(frame)

    ticks = TickClock(clock, period_us, latest_start_us=100, guard_us=60, late_frames=late_frames)
    for tick in range(1, 20):
        ticks.wait_until(tick * period_us)
        assert 0 <= clock.now_us - tick * period_us <= 2 * READ_US
        clock.now_us += 350
    assert len(taken) > 19 * 10  # most of what was left of each period went into emptying the queue


def test_a_start_up_in_a_flood_ends_and_says_so(flood):
    clock, bus, port = flood
    config = load("buses", "unix_2k", BusConfig)
    controller = Controller(law("unix_2k"), config, setup(bus_name="unix_2k").gate, port.send)
    assert config.can is not None
    with pytest.raises(StartUpError, match=r"no boot-up message.*flooded.*0x123"):
        start(clock, port, controller)
    resets = [message for message in bus.sent if message.arbitration_id == 0 and message.data[0] == 0x81]
    assert len(resets) == config.can.driver.retries + 1
    driver = config.can.driver
    longest_us = len(resets) * (driver.boot_timeout_us + driver.sdo_timeout_us + 2 * 20_000)
    assert clock.now_us < longest_us


@pytest.mark.parametrize("step_s", [-5.0, 5.0])
def test_a_wait_follows_the_monotonic_clock_where_the_time_of_day_is_set(monkeypatch, step_s):
    """python-can's own ``recv`` reckons by the time of day: set back by 5 s, it waits for 5 s longer."""
    clock = WallClock()
    with can.Bus(interface="virtual", channel="set back") as bus:
        port = CanPort(bus, clock)
        reads = itertools.count()
        monkeypatch.setattr("can.bus.time", lambda: time.time() + (step_s if next(reads) else 0.0))
        deadline_us = clock.now_us + 200_000
        assert port.receive(deadline_us) is None
        assert -1000 < clock.now_us - deadline_us < 2_000_000
