"""A plain CiA 401 module of another's making, on any bus: durand's CANopen stack.

The stack does the talking. What every maker of a module adds is here: converters behind 0x6411 and 0x6401, and what
the outputs do outside operational. durand has no heartbeat consumer, so the module gets one of its own, or none, or one
that only stores. Time and frames are handed in: in lockstep from the simulated wire, in the guest from a socket.
"""

from collections.abc import Callable
from typing import Any, Literal

import durand
from durand.datatypes import DatatypeEnum as Type
from durand.network import NetworkABC
from durand.object_dictionary import Record, Variable
from durand.scheduler import AbstractScheduler
from durand.services.nmt import StateEnum

from hil.node.alarm import Alarm, Scheduler
from hil.node.sense import Plant
from pkxyz_ctrl.can.frame import FD_FAST, UNUSUAL, Frame

VENDOR, PRODUCT, REVISION, SERIAL = 0x1234, 7, 2, 4711
DEVICE_TYPE = 0x000C0191
COMBS = (1, 2, 3)
Consumer = Literal["acts", "stores", "none"]


class LockstepScheduler(AbstractScheduler[list[Any]]):
    """durand's timers on a clock of ours."""

    def __init__(self, clock: Scheduler) -> None:
        self._clock = clock

    def add(self, delay: float, callback: Any, args: Any = (), kwargs: Any = None) -> list[Any]:
        entry = [callback]

        def ring() -> None:
            if entry:
                entry[0](*args, **(kwargs or {}))

        self._clock.call_at(self._clock.now_us + round(1e6 * delay), ring)
        return entry

    def cancel(self, entry: list[Any]) -> None:
        entry.clear()

    @property
    def lock(self) -> None:
        return None


class Wired(NetworkABC):
    """durand's way to a bus."""

    def __init__(self, send: Callable[[Frame], object], flags: int) -> None:
        self._send = send
        self._flags = flags
        self._receivers: dict[int, Callable[[int, bytes], None]] = {}

    def add_subscription(self, cob_id: int, callback: Callable[[int, bytes], None]) -> None:
        self._receivers[cob_id] = callback

    def remove_subscription(self, cob_id: int) -> None:
        self._receivers.pop(cob_id, None)

    def send(self, cob_id: int, msg: bytes) -> None:
        self._send(Frame._make((cob_id, bytes(msg), self._flags)))

    def on_frame(self, frame: Frame, t_us: int) -> None:
        receiver = self._receivers.get(frame.can_id)
        if receiver is not None and not frame.flags & UNUSUAL:
            receiver(frame.can_id, frame.data)


class DurandModule:
    """The module: ``power_on`` boots it, `on_frame` hands it what others sent."""

    def __init__(
        self,
        node_id: int,
        clock: Scheduler,
        send: Callable[[Frame], object],
        plant: Plant,
        *,
        fd: bool,
        consumer: Consumer = "acts",
        serial: int = SERIAL,
    ) -> None:
        durand.set_scheduler(LockstepScheduler(clock))
        self.node_id = node_id
        self.outputs = (0, 0, 0)
        self._clock, self._plant, self._consumer = clock, plant, consumer
        self._network = Wired(send, FD_FAST if fd else 0)
        self._alarm = Alarm(clock, self._controller_lost)
        self._serial = serial
        self.on_frame = self._network.on_frame

    def power_on(self) -> None:
        self.node = durand.MinimalNode(self._network, self.node_id)
        objects = self.node.object_dictionary
        objects.write(0x1000, 0, DEVICE_TYPE)
        for part, value in enumerate((VENDOR, PRODUCT, REVISION, self._serial), 1):
            objects.write(0x1018, part, value)
        for index, kind, access in (
            (0x6401, Type.INTEGER16, "ro"),
            (0x6411, Type.INTEGER16, "rw"),
            (0x6443, Type.UNSIGNED8, "rw"),
            (0x6444, Type.INTEGER32, "rw"),
        ):
            record = Record(name=f"{index:04X}")
            for comb in COMBS:
                record[comb] = Variable(kind, access, int(index == 0x6443), name=f"{index:04X} {comb}")
            objects[index] = record
        for comb in COMBS:
            objects.update_callbacks[0x6411, comb].add(self._drive)
        if self._consumer != "none":
            record = Record(name="Consumer heartbeat time")
            record[1] = Variable(Type.UNSIGNED32, "rw", 0, name="Consumer heartbeat time 1")
            objects[0x1016] = record
        if self._consumer == "acts":
            objects.update_callbacks[0x1016, 1].add(self._consume)
        self.node.sync.callbacks.add(self._sample)  # before the stack's own: a TPDO carries this SYNC's values
        self.node.nmt.state_callbacks.add(self._on_state)
        self.node.rpdo[1].mapping = [(0x6411, comb) for comb in COMBS]
        self.node.tpdo[1].mapping = [(0x6401, comb) for comb in COMBS]

    def _sample(self) -> None:
        if self.node.nmt.state == StateEnum.OPERATIONAL:
            sensed = self._plant.exchange(self._clock.now_us, None, sample=True)
            for comb, count in zip(COMBS, sensed, strict=True):
                self.node.object_dictionary.write(0x6401, comb, count)

    def _drive(self, value: int) -> None:
        if self.node.nmt.state == StateEnum.OPERATIONAL:
            a, b, c = (self.node.object_dictionary.read(0x6411, comb) for comb in COMBS)
            self._put((a, b, c))

    def _put(self, counts: tuple[int, int, int]) -> None:
        self.outputs = counts
        self._plant.exchange(self._clock.now_us, counts, sample=False)

    def _on_state(self, state: StateEnum) -> None:
        if state != StateEnum.OPERATIONAL and any(self.outputs):
            self._put((0, 0, 0))  # 0x6443 is 1 and 0x6444 is 0 as it leaves the factory

    def _consume(self, entry: int) -> None:
        self._timeout_us = 1000 * (entry & 0xFFFF)
        self._network.add_subscription(0x700 + (entry >> 16 & 0x7F), self._beaten)

    def _beaten(self, can_id: int, data: bytes) -> None:
        self._alarm.set(self._clock.now_us + self._timeout_us)

    def _controller_lost(self, now_us: int) -> None:
        self.node.emcy.set(0x8130, 0x11)
        if self.node.nmt.state == StateEnum.OPERATIONAL:
            self.node.nmt.set_state(StateEnum.PRE_OPERATIONAL)
