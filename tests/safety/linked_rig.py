"""Gate, driver and node as shipped, joined by a bus on which a script decides about each frame. No law and no modes:
what is asked for is the test's affair, and the mode given to the gate stays where the test puts it.
"""

from collections.abc import Iterable

from node_rig import EDS, NODE_ID, RecordingPlant

from hil.bus.clock import Lockstep
from hil.node.amplifier import AmplifierNode, NmtState
from pkxyz_ctrl.can.codec import Counts
from pkxyz_ctrl.can.driver import AmplifierDriver
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.driver_rules import DriverState
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.safety.gate import GateConfig, TransmitGate
from pkxyz_ctrl.safety.modes import Mode

PERIOD_US = 200
STEP = 3276  # 20 V
FATES = ("arrives", "lost", "twice", "late", "damaged")


class Linked:
    """``tick`` is one period: SYNC, then a drive frame. A frame that is late arrives behind
    the next one that does, of whatever kind."""

    def __init__(self, count_step_max: int = STEP) -> None:
        self.clock = Lockstep()
        self.plant = RecordingPlant()
        self.gate = TransmitGate(GateConfig(32767, count_step_max, PERIOD_US))
        self.driver = AmplifierDriver(DriverConfig(), count_step_max)
        self.node = AmplifierNode(
            NODE_ID, self.clock, self._answer, self.plant, EDS, turnaround_us=2, fd=True, protection=True
        )
        self.mode = Mode.BOOT
        self.blocked: list[str] = []
        self._answers: list[Frame] = []
        self._late: list[Frame] = []
        self._start()

    def _answer(self, frame: Frame) -> None:
        self._answers.append(frame)

    def _start(self) -> None:
        self.node.power_on()
        self.send(self.driver.start(self.clock.now_us))
        while self.driver.state is not DriverState.OPERATIONAL and self.clock.now_us < 500_000:
            self.pass_time(1000)
            self.send(self.driver.poll(self.clock.now_us))
            self._beat()
        assert self.driver.state is DriverState.OPERATIONAL, self.driver.failure
        assert self.node.state is NmtState.OPERATIONAL
        self.mode = Mode.ENABLED
        for _ in range(2):
            self.tick((0, 0, 0))
        self.plant.driven.clear()

    def pass_time(self, us: int) -> None:
        self.clock.run_until(self.clock.now_us + us)
        while self._answers:
            self.send(self.driver.receive(self._answers.pop(0), self.clock.now_us))

    def send(self, frames: Iterable[Frame], fate: str = "arrives") -> bool:
        """Whether the gate let all of them pass."""
        for frame in frames:
            reason = self.gate.check(frame, int(self.mode), self.clock.now_us)
            if reason is not None:
                self.blocked.append(reason)
                self.gate.clear()
                return False
            self._deliver(frame, fate)
        return True

    def _deliver(self, frame: Frame, fate: str) -> None:
        if fate == "late":
            self._late.append(frame)
        elif fate != "lost":
            for _ in range(2 if fate == "twice" else 1):
                data = frame.data if fate != "damaged" else bytes((frame.data[0] ^ 0x40,)) + frame.data[1:]
                self.node.on_frame(frame._replace(data=data), self.clock.now_us)
            late, self._late = self._late, []
            for held in late:
                self.node.on_frame(held, self.clock.now_us)

    def tick(self, counts: Counts | None, sync: str = "arrives", drive: str = "arrives") -> bool:
        """One period; ``counts`` None sends no drive frame. Whether the drive frame passed the gate."""
        self.send((self.driver.sync(self.clock.now_us),), sync)
        self.pass_time(100)
        passed = True
        if counts is not None:
            passed = self.send((self.driver.drive(counts, self.clock.now_us),), drive)
            if not passed:
                self.driver.revoke_drive()
        self._beat()
        self.pass_time(PERIOD_US - 100)
        return passed

    def _beat(self) -> None:
        heartbeat = self.driver.heartbeat_due(self.clock.now_us)
        if heartbeat is not None:
            self.send((heartbeat,))
            self.driver.heartbeat_sent(self.clock.now_us)

    def worst_step(self) -> int:
        """Largest change of a count from one voltage to the next, releases to 0 V excepted."""
        worst, held = 0, (0, 0, 0)
        for _, counts in self.plant.driven:
            if any(counts):
                worst = max(worst, *(abs(b - a) for a, b in zip(held, counts, strict=True)))
            held = counts
        return worst
