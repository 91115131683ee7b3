"""A controller alone with the frames of a recorded run: what driver, gate and cycle cost without a bus."""

from collections.abc import Sequence
from time import perf_counter_ns

import numpy as np

from hil.lanes.blocks import PREVIEW_ROWS, Blocks
from hil.lanes.lockstep import LockstepRig
from hil.lanes.setup import Setup
from pkxyz_ctrl.can import cob_id
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.loop.controller import Controller
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.loop.runtime import run, start

Stamped = tuple[Frame, int]


def recorded_frames(setup: Setup) -> tuple[list[Stamped], list[Frame]]:
    """One run in lockstep: the node's frames with their time of arrival in us, and the controller's in order."""
    node_id = setup.gate.node_id
    bases = (cob_id.SENSE_BASE, cob_id.SDO_RESPONSE_BASE, cob_id.HEARTBEAT_BASE, cob_id.EMCY_BASE)
    of_node = {base + node_id for base in bases} | {cob_id.sense(node_id, cob_id.SIGNATURE_PDO)}
    came: list[Stamped] = []
    went: list[Frame] = []

    def listen(frame: Frame, t_us: int) -> None:
        if frame.can_id in of_node:
            came.append((frame, t_us))
        else:
            went.append(frame)

    rig = LockstepRig(setup)
    rig.wire.attach("bench", listen, listen_only=True)
    rig.run(Blocks(setup.trajectory, setup.bus.period_us, setup.ticks, lambda block: None, lambda done, total: None))
    return came, went


class PlayedPort:
    """``runtime.Clock`` and ``runtime.Port`` in one: time is that of the recorded frames, which come when they came."""

    def __init__(self, came: Sequence[Stamped]) -> None:
        self.now_us = 0
        self.sent: list[Frame] = []
        self._came = came
        self._next = 0

    def send(self, frame: Frame) -> None:
        """Keep what the controller sends."""
        self.sent.append(frame)

    def wait_until(self, t_us: int) -> None:
        """It is ``t_us`` now."""
        self.now_us = t_us

    def spend(self, compute_us: int) -> None:
        """Computing takes time on a bus, too."""
        self.now_us += compute_us

    def receive(self, deadline_us: int) -> Frame | None:
        """The next recorded frame, or None once it is ``deadline_us``."""
        if self._next < len(self._came):
            frame, t_us = self._came[self._next]
            if t_us <= deadline_us:
                self._next += 1
                if t_us > self.now_us:
                    self.now_us = t_us
                return frame
        if deadline_us > self.now_us:
            self.now_us = deadline_us
        return None

    def unsent(self) -> int:
        """Nothing waits."""
        return 0


class TimedPort(PlayedPort):
    """One that notes how long it takes from a frame ``from_id`` handed to the controller to its frame ``to_id``."""

    def __init__(self, came: Sequence[Stamped], from_id: int, to_id: int) -> None:
        super().__init__(came)
        self.taken_ns: list[int] = []
        self._from_id, self._to_id = from_id, to_id
        self._since_ns = 0

    def send(self, frame: Frame) -> None:
        """Keep it, and the time since the frame before it came."""
        if frame.can_id == self._to_id:
            self.taken_ns.append(perf_counter_ns() - self._since_ns)
        self.sent.append(frame)

    def receive(self, deadline_us: int) -> Frame | None:
        """The next recorded frame; the stopwatch starts where it is handed out."""
        frame = super().receive(deadline_us)
        if frame is not None and frame.can_id == self._from_id:
            self._since_ns = perf_counter_ns()
        return frame


class Played:
    """A controller that has gone through the recorded start-up and is about to tick."""

    def __init__(self, setup: Setup, port: PlayedPort) -> None:
        self.setup = setup
        self.port = port
        self.controller = Controller(setup.law, setup.bus, setup.gate, port.send)
        self._reference = reference_rows(setup.trajectory.sample(0, setup.ticks + PREVIEW_ROWS, setup.bus.period_us))
        start(port, port, self.controller)

    def run(self) -> None:
        """All ticks of the run, without a record."""
        reference = self._reference
        run(self.port, self.port, self.controller, lambda tick: reference, self.setup.ticks, lambda tick: None)


def drive_counts(frames: Sequence[Frame], node_id: int) -> np.ndarray:
    """Counts (n, 3) of the drive PDOs among frames, which carry them little endian in their first six bytes."""
    data = b"".join(frame.data[:6] for frame in frames if frame.can_id == cob_id.DRIVE_BASE + node_id)
    return np.frombuffer(data, "<i2").reshape(-1, 3).astype(np.int32)
