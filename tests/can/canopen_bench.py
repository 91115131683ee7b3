"""The amplifier driver and canopen's LocalNode on one wire, in lockstep."""

from pathlib import Path

import can
import canopen

from pkxyz_ctrl.can.driver import AmplifierDriver
from pkxyz_ctrl.can.driver_config import DriverConfig
from pkxyz_ctrl.can.driver_rules import DriverState
from pkxyz_ctrl.can.frame import Frame

EDS = str(Path(__file__).resolve().parents[2] / "configs" / "comb_amplifier.eds")
FRAME_US = 100


class PeriodicTask:
    """A cyclic transmission as canopen asks for one; ``due`` hands it out when the test's time has come."""

    def __init__(self, message: can.Message, period_s: float) -> None:
        self.message, self.period_us, self.next_us = message, round(1e6 * period_s), 0

    def stop(self) -> None:
        self.next_us = 1 << 62

    def modify_data(self, message: can.Message) -> None:
        self.message = message


class MemoryBus:
    """What canopen.Network needs of a bus: it collects what is sent."""

    channel_info = "memory"

    def __init__(self) -> None:
        self.sent: list[Frame] = []
        self.tasks: list[PeriodicTask] = []

    def send(self, message: can.Message) -> None:
        self.sent.append(to_frame(message))

    def send_periodic(self, message: can.Message, period: float) -> PeriodicTask:
        self.tasks.append(PeriodicTask(message, period))
        return self.tasks[-1]


def to_frame(message: can.Message) -> Frame:
    return Frame(message.arbitration_id, bytes(message.data), message.is_fd, is_remote=message.is_remote_frame)


class Bench:
    """Driver and LocalNode on one wire; every frame takes 100 us. canopen stores 0x1016 and does nothing with it:
    ``consumes`` has this file do what it says.
    """

    def __init__(self, config: DriverConfig, boots: bool = True, consumes: bool = True) -> None:
        self.t_us = 0
        self.boots = boots
        self.consumes = consumes
        self.beat_us = 1 << 62
        self.driver = AmplifierDriver(config)
        self.bus = MemoryBus()
        self.network = canopen.Network(self.bus)
        self.node = self.network.create_node(config.node_id, EDS)

    def to_node(self, frame: Frame) -> None:
        self.t_us += FRAME_US
        self.network.notify(frame.can_id, bytearray(frame.data), self.t_us * 1e-6)
        if frame.can_id == 0x77F:
            self.beat_us = self.t_us
        if frame.can_id == 0 and self.boots:
            if frame.data[0] == 0x81:
                self.node.nmt.send_command(129)  # canopen sends the boot-up message here
            self.node.nmt.send_command({0x81: 128, 0x01: 1, 0x80: 128}[frame.data[0]])

    def from_node(self) -> list[Frame]:
        if self.consumes and self.t_us >= self.beat_us + 50_000:
            self.beat_us = 1 << 62
            self.node.nmt.send_command(128)
        for task in self.bus.tasks:
            if self.t_us >= task.next_us:
                self.bus.sent.append(to_frame(task.message))
                task.next_us = self.t_us + task.period_us
        sent, self.bus.sent = self.bus.sent, []
        return sent

    def settle(self, frames: tuple[Frame, ...], limit_us: int) -> None:
        """Everything that is said until both are quiet and the time is over, or the driver has come to an end."""
        waiting = list(frames)
        end_us = self.t_us + limit_us
        while self.t_us < end_us and self.driver.state not in (DriverState.OPERATIONAL, DriverState.FAILED):
            if waiting:
                self.to_node(waiting.pop(0))
            else:
                self.t_us += FRAME_US
            for frame in self.from_node():
                waiting += self.driver.receive(frame, self.t_us)
            waiting += self.driver.poll(self.t_us)
        for frame in waiting:
            self.to_node(frame)

    def start(self) -> None:
        self.settle(self.driver.start(self.t_us), 20_000_000)
