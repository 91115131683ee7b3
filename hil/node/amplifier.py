"""The amplifier node: a CiA 301 device with the analogue part of CiA 401, between the bus and the plant.

It shares nothing with the controller but the `Frame`. It does what the canopen library's LocalNode leaves to others:
SYNC-driven PDOs, NMT gating, boot-up after resets, heartbeats both ways, emergencies, output error values.
"""

from collections.abc import Callable
from enum import IntEnum
from pathlib import Path

from hil.node.alarm import Alarm, Scheduler
from hil.node.digital import DigitalOutputs, Switch
from hil.node.drive import DriveReceiver, Outputs
from hil.node.emergency import HOLD_US, EmergencyProducer, ErrorCode, FrameErrors
from hil.node.heartbeat import HeartbeatConsumer, HeartbeatProducer
from hil.node.object_dictionary import ObjectDictionary
from hil.node.objects import NodeObjects
from hil.node.pdo import PdoParameters
from hil.node.sdo_server import SdoServer
from hil.node.sense import Plant, SenseTransmitter
from hil.node.signature import SIGNATURE, SignatureTransmitter, signature
from pkxyz_ctrl.can.frame import FD_FAST, UNUSUAL, Frame

BOOT_US = 2_000  # from reset to boot-up message; a small microcontroller takes a few ms
_COMMUNICATION_PROFILE = (0x1000, 0x1FFF)
_new_tuple = tuple.__new__  # a Frame without its keyword defaults: 0.2 us less in every cycle

Receiver = Callable[[bytes, int], None]


class NmtState(IntEnum):
    """Values as in the heartbeat (CiA 301, 7.2.8.3.2.2)."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class AmplifierNode:
    """One device. `power_on` boots it; then frames come in by `on_frame` and leave through ``send``.

    ``node_id`` 1 to 127; ``turnaround_us`` from the end of the SYNC to the queueing of the sense PDO; ``fd``: send FD
    frames with bit-rate switch (both formats are accepted); ``protection``: the drive PDO must carry alive counter and
    CRC, and nothing but that PDO can set a drive count other than 0; ``error_hold_us``: how long an error in a frame
    lasts after the last such frame; ``switch`` is told what its digital outputs put out.
    """

    def __init__(
        self,
        node_id: int,
        clock: Scheduler,
        send: Callable[[Frame], object],
        plant: Plant,
        eds_path: str | Path,
        *,
        turnaround_us: int,
        fd: bool,
        protection: bool,
        boot_us: int = BOOT_US,
        error_hold_us: int = HOLD_US,
        switch: Switch = lambda bits, t_us: None,
    ) -> None:
        if not 1 <= node_id <= 127:
            raise ValueError(f"node id {node_id}: CiA 301 allows 1 to 127")
        self.node_id = node_id
        self.state = NmtState.INITIALISING
        self.outputs: Outputs = (0, 0, 0)  # what the amplifier was last told
        self._clock = clock
        self._send = send
        self._plant = plant
        self._flags = FD_FAST if fd else 0
        self._protection = protection
        self._boot_us = boot_us
        self._boot_alarm = Alarm(clock, self._boot)
        self._receivers: dict[int, Receiver] = {}  # by COB-ID, only what the present state lets in
        self._holds: set[int] = set()  # errors that keep the outputs at their error values
        self._silent_syncs = self._step_max = self._drive_timeout_us = 0
        self._drive_deadline = Alarm(clock, self._drive_overdue)
        self._sync_following: dict[bytes, bytes] = {}
        self._sync_expected: bytes | None = None

        self.od = od = ObjectDictionary.from_eds(eds_path, node_id)
        self._drive_pdo = PdoParameters(od, "receive", 2, values=0x6411, protection=0x2000, protected=protection)
        self._sense_pdo = PdoParameters(od, "transmit", 2, values=0x6401, protection=0x2001, protected=protection)
        self.digital = DigitalOutputs(od, PdoParameters.plain(od, "receive", 1, 0x6200), switch)
        signature_pdo = PdoParameters.plain(od, "transmit", 3, 0x2020)
        self.signature = SignatureTransmitter(od, signature_pdo, self._transmit)
        self.emergency = EmergencyProducer(od, clock, self._transmit)
        self._sync_errors = FrameErrors(self.emergency, error_hold_us)
        self._drive_errors = FrameErrors(self.emergency, error_hold_us)
        self._heartbeat = HeartbeatProducer(clock, self._send_heartbeat)
        self._consumers = [
            HeartbeatConsumer(clock, self._controller_lost, lambda: self._release(ErrorCode.HEARTBEAT_LOST))
            for _ in range(od[0x1016, 0])
        ]
        self._drive = DriveReceiver(od, self._drive_pdo, self._drive_errors, lambda: self.outputs)
        self._sense = SenseTransmitter(
            od, self._sense_pdo, clock, plant, self._transmit, self._heartbeat, self.signature, turnaround_us
        )
        self._sdo = SdoServer(self._objects(signature_pdo))

    def _objects(self, signature_pdo: PdoParameters) -> NodeObjects:
        return NodeObjects(
            self.od,
            (self._drive_pdo, self._sense_pdo, self.digital.parameters, signature_pdo),
            refresh=self._refresh,
            changed=self._configure,
            may_drive=lambda: not self._protection and self.state is NmtState.OPERATIONAL and not self._holds,
            is_operational=lambda: self.state is NmtState.OPERATIONAL,
        )

    # -- from outside ------------------------------------------------------------------------------------------------

    def power_on(self) -> None:
        """Start as after power-up or reset: outputs at 0, all objects at their defaults, boot-up message to come."""
        self._holds.clear()
        self._restart(0x0000, 0xFFFF)
        self._set_outputs((0, 0, 0), self._clock.now_us)
        self.digital.put_out(0, self._clock.now_us)

    def on_frame(self, frame: Frame, t_us: int) -> None:
        """A frame of somebody else has ended on the wire at ``t_us`` (now)."""
        can_id, data, flags = frame
        receiver = self._receivers.get(can_id)
        if receiver is not None and not flags & UNUSUAL:
            receiver(data, t_us)

    def amplifier_fault(self, code: int) -> None:
        """The amplifier reports a fault (an EMCY ``code``, say 0x2310): outputs at their error values until cleared."""
        self._hold(code, b"")

    def clear_amplifier_fault(self, code: int) -> None:
        """The fault is gone; the next valid drive PDO is applied again."""
        self._release(code)

    @property
    def work_alarms(self) -> list[Alarm]:
        """Those that each cycle puts off."""
        return [self._drive_deadline, self._heartbeat.alarm, *(consumer.alarm for consumer in self._consumers)]

    # -- NMT ---------------------------------------------------------------------------------------------------------

    def _on_nmt(self, data: bytes, t_us: int) -> None:
        if len(data) != 2 or data[1] not in (0, self.node_id):
            return
        match data[0]:
            case 1:
                self._enter(NmtState.OPERATIONAL)
            case 2:
                self._enter(NmtState.STOPPED)
            case 128:
                self._enter(NmtState.PRE_OPERATIONAL)
            case 129:
                self.power_on()
            case 130:
                self._restart(*_COMMUNICATION_PROFILE)

    def _enter(self, state: NmtState) -> None:
        if state is self.state:
            return
        if self.state is NmtState.OPERATIONAL:
            self._sense.stop()
            self._drive_deadline.cancel()
            self._outputs_to_error_value()
            self.digital.to_error_value(self._clock.now_us)
        self.state = state
        self._sync_expected = None
        if state is NmtState.OPERATIONAL:
            self._drive.start()
            self._silent_syncs = 0
            self.signature.start()
            self._sense.start()
        self._admit()
        self.emergency.permit(state in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL))

    def _restart(self, first: int, last: int) -> None:
        """Reset the objects from ``first`` to ``last`` and boot."""
        self._enter(NmtState.INITIALISING)
        self.od.reset(first, last)
        self._sdo.reset()
        self._heartbeat.configure(0, beat_now=False)
        for consumer in self._consumers:
            consumer.configure(0)
        self._sync_errors.forget()
        self._drive_errors.forget()
        self.emergency.reset()
        for code in sorted(self._holds):
            self.emergency.begin(code)
        self._drive.reset()
        self._boot_alarm.set(self._clock.now_us + self._boot_us)

    def _boot(self, now_us: int) -> None:
        self._send_heartbeat()  # state 0: the boot-up message
        for index in (0x1005, 0x1016, 0x2011):
            self._configure(index)
        self._heartbeat.configure(1000 * self.od[0x1017, 0], beat_now=False)
        self._enter(NmtState.PRE_OPERATIONAL)

    def _admit(self) -> None:
        """Rebuild the table of what is received in this state (CiA 301, table 36)."""
        receivers = dict(self.digital.receivers) if self.state is NmtState.OPERATIONAL else {}
        if self.state is NmtState.OPERATIONAL and self._drive_pdo.in_use and not self._holds:
            synchronous = self._drive_pdo.transmission_type <= 240
            receivers[self._drive_pdo.cob_id] = self._drive.receive if synchronous else self._on_drive_event
        if self.state in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL):
            sync_id = self.od[0x1005, 0] & 0x7FF
            receivers[sync_id] = self._on_sync if self.state is NmtState.OPERATIONAL else self._check_sync
            receivers[0x600 + self.node_id] = self._on_sdo
        if self.state is not NmtState.INITIALISING:
            for consumer in self._consumers:
                if consumer.cob_id is not None:
                    receivers[consumer.cob_id] = consumer.receive
            receivers[0x000] = self._on_nmt
        self._receivers = receivers

    # -- process data ------------------------------------------------------------------------------------------------

    def _on_sync(self, data: bytes, t_us: int) -> None:
        """Apply the last valid drive PDO, sample, and have the sense PDO sent after the response time."""
        if data != self._sync_expected and not self._is_sync(data, t_us):
            self._count_silence(t_us)
            return
        self._sync_expected = self._sync_following[data]
        self.digital.on_sync(t_us)
        self.signature.on_sync()
        outputs, pending = None, self._drive.pending
        if pending is not None:
            outputs = self._apply(pending, t_us)
        else:
            self._drive.miss()
            self._count_silence(t_us)
        if self._sync_errors.present:
            self._sync_errors.good(t_us)
        self._sense.on_sync(data, t_us, outputs)

    def _check_sync(self, data: bytes, t_us: int) -> None:
        if data == self._sync_expected or self._is_sync(data, t_us):
            self._sync_expected = self._sync_following[data]

    def _is_sync(self, data: bytes, t_us: int) -> bool:
        """A SYNC other than the expected one. Out of step it is a SYNC all the same: it marks the instant. But what was
        meant for one that was missed is not applied at another: combs that are energised, or were to be, go to 0 V.
        """
        expected = self._sync_expected
        if data not in self._sync_following:  # length not as configured, or a counter that cannot be
            self._sync_errors.bad(ErrorCode.SYNC_DATA, t_us, bytes((len(data),)) + data[:1])
            return False
        if expected is not None:
            self._sync_errors.bad(ErrorCode.SYNC_DATA, t_us, bytes((len(data),)) + data + expected)
            if any(self.outputs) or any(self._drive.pending or ()):
                self._release_combs()
        return True

    def _on_drive_event(self, data: bytes, t_us: int) -> None:
        """Transmission types 254 and 255: applied on reception."""
        self._drive.receive(data, t_us)
        if self._drive.pending is not None:
            outputs = self._apply(self._drive.pending, t_us)
            if outputs is not None:
                self._plant.exchange(t_us, outputs, sample=False)

    def _apply(self, counts: Outputs, t_us: int) -> Outputs | None:
        """What the converters take: 0 V from anywhere, else no further from what is there than 0x2011 says."""
        a, b, c = counts
        if a or b or c:
            step = self._step_max
            was_a, was_b, was_c = self.outputs
            if not (-step <= a - was_a <= step and -step <= b - was_b <= step and -step <= c - was_c <= step):
                over = (abs(new - old) > step for new, old in zip(counts, self.outputs, strict=True))
                self._drive_errors.bad(
                    ErrorCode.DRIVE_STEP, t_us, bytes((sum(1 << comb for comb, is_over in enumerate(over) if is_over),))
                )
                self._release_combs()
                return None
        self._drive_deadline.set(t_us + self._drive_timeout_us)
        self._drive.pending = None
        self._silent_syncs = 0
        self.outputs = counts
        return counts

    def _count_silence(self, t_us: int) -> None:
        """A cycle without a valid drive PDO. After as many as object 0x2010 says it is told, and energised combs are
        released.
        """
        self._silent_syncs = silent = self._silent_syncs + 1
        if silent == self.od[0x2010, 0]:
            self._miss_drive(t_us, bytes((silent,)))

    def _drive_overdue(self, now_us: int) -> None:
        """Nothing was applied for as long as 0x2012 says, whatever has become of SYNC."""
        self._miss_drive(now_us, b"")

    def _miss_drive(self, t_us: int, info: bytes) -> None:
        self._drive_errors.bad(ErrorCode.DRIVE_MISSING, t_us, info)
        if any(self.outputs):
            self._release_combs()

    def _release_combs(self) -> None:
        """By the node's own decision; energised again only after a drive PDO with 0 V."""
        self._outputs_to_error_value()
        self._drive.demand_zero()

    def _set_outputs(self, counts: Outputs, t_us: int) -> None:
        self._drive.pending = None
        self.outputs = counts
        self._plant.exchange(t_us, counts, sample=False)

    def _outputs_to_error_value(self) -> None:
        """CiA 401: error mode 1 takes the error value (0x6444, in counts of 0x6411), mode 0 keeps what is there."""
        od = self.od
        a, b, c = (od[0x6444, i] if od[0x6443, i] else self.outputs[i - 1] for i in (1, 2, 3))
        self._set_outputs((a, b, c), self._clock.now_us)

    # -- errors ------------------------------------------------------------------------------------------------------

    def _hold(self, code: int, info: bytes) -> None:
        self._holds.add(code)
        self._outputs_to_error_value()
        self.digital.to_error_value(self._clock.now_us)
        self._admit()
        self.emergency.begin(code, info)

    def _release(self, code: int) -> None:
        self._holds.discard(code)
        self._drive.start()
        if self.state is NmtState.OPERATIONAL:
            self._drive.demand_zero()
        self._admit()
        self.emergency.end(code)

    def _controller_lost(self, now_us: int) -> None:
        self._hold(ErrorCode.HEARTBEAT_LOST, b"")
        behaviour = self.od[0x1029, 1]  # 0: pre-operational if operational, 1: no change, 2: stopped
        if behaviour == 0 and self.state is NmtState.OPERATIONAL:
            self._enter(NmtState.PRE_OPERATIONAL)
        elif behaviour == 2:
            self._enter(NmtState.STOPPED)

    # -- service data and frames -------------------------------------------------------------------------------------

    def _on_sdo(self, data: bytes, t_us: int) -> None:
        reply = self._sdo.serve(data)
        if reply is not None:
            self._transmit(0x580 + self.node_id, reply)

    def _refresh(self, index: int) -> None:
        """Bring the process image to the dictionary, which does not see every cycle."""
        if index == 0x6401 and self.state is not NmtState.OPERATIONAL:
            self._sense.counts = self._plant.exchange(self._clock.now_us, None, sample=True)
        if index == 0x2020:
            self.od[SIGNATURE] = signature(self.od)
        if index in (0x6401, 0x2001):
            self._sense.publish()
        elif index == 0x6411:
            for subindex in (1, 2, 3):
                self.od[0x6411, subindex] = self.outputs[subindex - 1]
        elif index == 0x2000:
            self.od[0x2000, 1], self.od[0x2000, 2] = self._drive.counter or 0, self._drive.crc

    def _configure(self, index: int) -> None:
        """Object ``index`` was written: let it take effect."""
        od = self.od
        match index:
            case 0x1003:
                self.emergency.clear_history()
            case 0x1005 | 0x1019:
                last = od[0x1019, 0]
                self._sync_following = (
                    {bytes((n,)): bytes((n % last + 1,)) for n in range(1, last + 1)} if last else {b"": b""}
                )
                self._sync_expected = None
                self._sense.configure()
            case 0x1016:
                for subindex, consumer in enumerate(self._consumers, start=1):
                    consumer.configure(od[0x1016, subindex])
            case 0x2011 | 0x2012:
                self._step_max, self._drive_timeout_us = od[0x2011, 0], 1000 * od[0x2012, 0]
            case 0x1017:
                self._heartbeat.configure(1000 * od[0x1017, 0], beat_now=True)
            case self._drive_pdo.communication | self._drive_pdo.mapping:
                self._drive.configure()
            case self._sense_pdo.communication | self._sense_pdo.mapping:
                self._sense.configure()
            case 0x6200 if self.state is NmtState.OPERATIONAL:
                self.digital.put_out(od[0x6200, 1], self._clock.now_us)
            case 0x6411 if self.state is NmtState.OPERATIONAL:
                self._set_outputs((od[0x6411, 1], od[0x6411, 2], od[0x6411, 3]), self._clock.now_us)
        self._admit()

    def _send_heartbeat(self) -> None:
        self._transmit(0x700 + self.node_id, bytes((self.state,)))

    def _transmit(self, cob_id: int, data: bytes) -> None:
        self._send(_new_tuple(Frame, (cob_id, data, self._flags)))
