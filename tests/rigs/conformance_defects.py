"""Amplifiers with one defect each, and the one line of the conformance run that has to say so."""

from typing import Any

from hil.node.amplifier import AmplifierNode, NmtState
from hil.node.object_dictionary import Abort, SdoAbortError
from pkxyz_ctrl.can.codec import ProcessCodec
from pkxyz_ctrl.can.frame import EXTENDED, Frame

SENSE = ProcessCodec(0x28A, True)
DRIVE = ProcessCodec(0x30A, True)
SENSE_FOREIGN = ProcessCodec(0x30A, True)


class WrongProduct(AmplifierNode):
    """identity: identity"""

    def power_on(self) -> None:
        self.od.install(0x1018, 2, 0x99)
        super().power_on()


class NoBootUp(AmplifierNode):
    """boot-up and NMT: boot-up"""

    def _transmit(self, cob_id: int, data: bytes) -> None:
        if (cob_id, data) != (0x70A, b"\0"):
            super()._transmit(cob_id, data)


class LongBootUp(AmplifierNode):
    """boot-up and NMT: boot-up"""

    def _transmit(self, cob_id: int, data: bytes) -> None:
        super()._transmit(cob_id, b"\0\0" if (cob_id, data) == (0x70A, b"\0") else data)


class MissingObject(AmplifierNode):
    """object dictionary: objects exist"""

    def power_on(self) -> None:
        self.od._entries.pop((0x100A, 0), None)
        super().power_on()


class WrongLength(AmplifierNode):
    """object dictionary: object lengths"""

    def power_on(self) -> None:
        self.od._entries[0x1001, 0].data_type = 0x06
        super().power_on()


class WrongDefault(AmplifierNode):
    """object dictionary: default values"""

    def power_on(self) -> None:
        self.od.install(0x2010, 0, 6)
        super().power_on()


class WritableIdentity(AmplifierNode):
    """object dictionary: read-only objects"""

    def power_on(self) -> None:
        self.od._entries[0x1018, 4].access = "rw"
        super().power_on()


class _OtherObjects(AmplifierNode):
    """Stands between SDO server and objects."""

    def power_on(self) -> None:
        if self._sdo._objects is not self:
            self._inner = self._sdo._objects
            self._sdo._objects = self
        super().power_on()

    def read(self, index: int, subindex: int) -> bytes:
        return self._inner.read(index, subindex)

    def check_download(self, index: int, subindex: int, length: int | None) -> None:
        self._inner.check_download(index, subindex, length)

    def write(self, index: int, subindex: int, data: bytes) -> None:
        self._inner.write(index, subindex, data)

    def unsized_length(self, index: int, subindex: int) -> int:
        return self._inner.unsized_length(index, subindex)


class LockedHistory(_OtherObjects):
    """object dictionary: writable objects"""

    def write(self, index: int, subindex: int, data: bytes) -> None:
        if index == 0x1003:
            raise SdoAbortError(Abort.LOCAL_CONTROL)
        super().write(index, subindex, data)


class ForgetfulReadBack(_OtherObjects):
    """object dictionary: configuration"""

    def read(self, index: int, subindex: int) -> bytes:
        return bytes(4) if (index, subindex) == (0x1016, 1) else super().read(index, subindex)


class MappingAtAnyTime(_OtherObjects):
    """object dictionary: mapping in use"""

    def write(self, index: int, subindex: int, data: bytes) -> None:
        if (index, subindex) != (0x1A01, 0) or self.state is not NmtState.OPERATIONAL:
            super().write(index, subindex, data)


class DrivesBySdo(_OtherObjects):
    """outputs, with voltage: drive by SDO"""

    def write(self, index: int, subindex: int, data: bytes) -> None:
        count = int.from_bytes(data, "little", signed=True)
        if index != 0x6411 or len(data) != 2 or count < 0 or self.state is not NmtState.OPERATIONAL:
            super().write(index, subindex, data)
            return
        a, b, c = (count if place == subindex else kept for place, kept in enumerate(self.outputs, 1))
        self._set_outputs((a, b, c), self._clock.now_us)


class WrongAbort(AmplifierNode):
    """SDO: unknown sub-index"""

    def _transmit(self, cob_id: int, data: bytes) -> None:
        wrong = cob_id == 0x58A and data[0] == 0x80 and data[4:] == Abort.NO_SUBINDEX.to_bytes(4, "little")
        super()._transmit(cob_id, data[:4] + Abort.NO_OBJECT.to_bytes(4, "little") if wrong else data)


class TakesAnyLength(AmplifierNode):
    """SDO: too short"""

    def _on_sdo(self, data: bytes, t_us: int) -> None:
        if data[:4] == bytes.fromhex("2f 17 10 00"):  # one byte to 0x1017: filled up
            data = bytes.fromhex("2b 17 10 00") + data[4:5] + bytes(3)
        super()._on_sdo(data, t_us)


class NoLimits(AmplifierNode):
    """SDO: out of range"""

    def power_on(self) -> None:
        self.od._entries[0x6443, 2].high = None
        super().power_on()


class NoToggle(AmplifierNode):
    """SDO: toggle bit"""

    def _on_sdo(self, data: bytes, t_us: int) -> None:
        if data[:1] == b"\x70" and not self._sdo._toggle:
            data = b"\x60" + data[1:]
        super()._on_sdo(data, t_us)


class SdoInStopped(AmplifierNode):
    """boot-up and NMT: SDO by state"""

    def _admit(self) -> None:
        super()._admit()
        if self.state is NmtState.STOPPED:
            self._receivers[0x60A] = self._on_sdo


class PdoInPreOperational(AmplifierNode):
    """boot-up and NMT: PDO by state"""

    def _check_sync(self, data: bytes, t_us: int) -> None:
        super()._check_sync(data, t_us)
        self._transmit(0x28A, SENSE.encode((0, 0, 0), 0))


class ObeysOthers(AmplifierNode):
    """boot-up and NMT: addressing"""

    def _on_nmt(self, data: bytes, t_us: int) -> None:
        super()._on_nmt(data[:1] + b"\0", t_us)


class NeverStops(AmplifierNode):
    """boot-up and NMT: communication reset"""

    def _restart(self, first: int, last: int) -> None:
        super()._restart(first, 0xFFFF)


class SlowHeartbeat(AmplifierNode):
    """heartbeat: heartbeat period"""

    def _configure(self, index: int) -> None:
        super()._configure(index)
        if index == 0x1017:
            self._heartbeat.configure(2000 * self.od[0x1017, 0], beat_now=False)


class ClassicAnswers(AmplifierNode):
    """frames: formats"""

    def _transmit(self, cob_id: int, data: bytes) -> None:
        if cob_id == 0x58A:
            self._send(Frame(cob_id, data))
        else:
            super()._transmit(cob_id, data)


class ObeysExtended(AmplifierNode):
    """frames: 29-bit identifiers"""

    def on_frame(self, frame: Frame, t_us: int) -> None:
        super().on_frame(frame._replace(flags=frame.flags & ~EXTENDED), t_us)


class SkipsSyncs(AmplifierNode):
    """sense PDO: one per SYNC"""

    def _on_sync(self, data: bytes, t_us: int) -> None:
        if data == b"\x40":
            self._sync_expected = self._sync_following[data]
        else:
            super()._on_sync(data, t_us)


class SlowConverter(AmplifierNode):
    """sense PDO: latency"""

    def __init__(self, *arguments: Any, turnaround_us: int, **keywords: Any) -> None:
        super().__init__(*arguments, turnaround_us=90, **keywords)


class FrozenCounter(AmplifierNode):
    """sense PDO: alive counter"""

    def _transmit(self, cob_id: int, data: bytes) -> None:
        if cob_id == 0x28A:
            a, b, c, _, _ = SENSE.decode(data)
            data = SENSE.encode((a, b, c), 7)
        super()._transmit(cob_id, data)


class CrcOfAnother(AmplifierNode):
    """sense PDO: CRC"""

    def _transmit(self, cob_id: int, data: bytes) -> None:
        if cob_id == 0x28A:
            a, b, c, counter, _ = SENSE.decode(data)
            data = SENSE_FOREIGN.encode((a, b, c), counter)
        super()._transmit(cob_id, data)


class AnySync(AmplifierNode):
    """SYNC: SYNC length"""

    def _on_sync(self, data: bytes, t_us: int) -> None:
        super()._on_sync(data if len(data) == 1 else self._sync_expected or b"\1", t_us)


class AnySyncCounter(AmplifierNode):
    """SYNC: SYNC counter"""

    def _on_sync(self, data: bytes, t_us: int) -> None:
        super()._on_sync(b"\1" if len(data) == 1 and not 1 <= data[0] <= 240 else data, t_us)


class _OtherDrive(AmplifierNode):
    """Sees each drive PDO before the node does."""

    def on_frame(self, frame: Frame, t_us: int) -> None:
        if frame.can_id == 0x30A and not frame.is_extended:
            frame = frame._replace(data=self.drive_data(frame.data))
        super().on_frame(frame, t_us)

    def drive_data(self, data: bytes) -> bytes:
        """What the node sees in place of ``data``."""
        return data


class IgnoresCrc(_OtherDrive):
    """drive PDO: wrong CRC"""

    def drive_data(self, data: bytes) -> bytes:
        if len(data) != 8:
            return data
        a, b, c, counter, _ = DRIVE.decode(data)
        return DRIVE.encode((a, b, c), counter)


class IgnoresCounter(_OtherDrive):
    """drive PDO: wrong alive counter"""

    def drive_data(self, data: bytes) -> bytes:
        self._drive.counter = None
        return data


class TakesLateFrames(_OtherDrive):
    """drive PDO: late"""

    def drive_data(self, data: bytes) -> bytes:
        self._drive._is_owed = False
        return data


class PadsShortFrames(_OtherDrive):
    """drive PDO: too short"""

    def drive_data(self, data: bytes) -> bytes:
        return data.ljust(8, b"\0")


class CutsLongFrames(_OtherDrive):
    """drive PDO: too long"""

    def drive_data(self, data: bytes) -> bytes:
        return data[:8]


class TakesNegative(_OtherDrive):
    """drive PDO: negative count"""

    def drive_data(self, data: bytes) -> bytes:
        if len(data) != 8:
            return data
        a, b, c, counter, right = DRIVE.decode(data)
        return DRIVE.encode((abs(a), abs(b), abs(c)), counter) if right else data


class NeverOverdue(AmplifierNode):
    """outputs, with voltage: drive time-out"""

    def _drive_overdue(self, now_us: int) -> None:
        pass


class AnyStep(AmplifierNode):
    """outputs, with voltage: own step limit"""

    def _configure(self, index: int) -> None:
        super()._configure(index)
        self._step_max = 32767


class NeverTellsTheEnd(AmplifierNode):
    """EMCY: register and end"""

    def _transmit(self, cob_id: int, data: bytes) -> None:
        if cob_id != 0x8A or data[:2] != b"\0\0":
            super()._transmit(cob_id, data)


class NoHeartbeatConsumer(AmplifierNode):
    """outputs: heartbeat consumer"""

    def _controller_lost(self, now_us: int) -> None:
        pass


class FixedErrorMode(_OtherObjects):
    """outputs: error mode and value"""

    def read(self, index: int, subindex: int) -> bytes:
        return b"\1" if (index, subindex) == (0x6443, 3) else super().read(index, subindex)


class _KeepsOutputs(AmplifierNode):
    """Does not take the error value while ``kept``."""

    kept = False

    def _outputs_to_error_value(self) -> None:
        if not self.kept:
            super()._outputs_to_error_value()


class KeepsVoltageWithoutMaster(_KeepsOutputs):
    """outputs, with voltage: heartbeat lost"""

    def _controller_lost(self, now_us: int) -> None:
        self.kept = True
        super()._controller_lost(now_us)
        self.kept = False


class KeepsVoltageInStopped(_KeepsOutputs):
    """outputs, with voltage: leaving operational"""

    def _enter(self, state: NmtState) -> None:
        self.kept = state is NmtState.STOPPED
        super()._enter(state)
        self.kept = False


class KeepsVoltageWithoutDrive(AmplifierNode):
    """outputs, with voltage: drive PDO missing"""

    def _count_silence(self, t_us: int) -> None:
        pass


class KeepsVoltageOverReset(_KeepsOutputs):
    """outputs: after reset"""

    def _restart(self, first: int, last: int) -> None:
        self.kept = last == 0x1FFF
        super()._restart(first, last)
        self.kept = False


class AlwaysErrorValue(AmplifierNode):
    """outputs, with voltage: error value"""

    def _outputs_to_error_value(self) -> None:
        a, b, c = (self.od[0x6444, comb] for comb in (1, 2, 3))
        self._set_outputs((a, b, c), self._clock.now_us)


class AppliesAtOnce(_OtherDrive):
    """outputs, with voltage: applied at SYNC"""

    def drive_data(self, data: bytes) -> bytes:
        return data

    def on_frame(self, frame: Frame, t_us: int) -> None:
        super().on_frame(frame, t_us)
        if frame.can_id == 0x30A and (pending := self._drive.pending) is not None:
            outputs, self._drive.pending = self._apply(pending, t_us), pending
            if outputs is not None:
                self._plant.exchange(t_us, outputs, sample=False)


class Saturates(AmplifierNode):
    """outputs, with voltage: scaling"""

    def _apply(self, counts: tuple[int, int, int], t_us: int) -> tuple[int, int, int] | None:
        a, b, c = (min(count, 600) for count in counts)
        return super()._apply((a, b, c), t_us)


class Silent(AmplifierNode):
    """identity: answers"""

    def _on_sdo(self, data: bytes, t_us: int) -> None:
        pass


DEFECTS: tuple[type[AmplifierNode], ...] = tuple(
    found
    for found in list(globals().values())
    if isinstance(found, type) and issubclass(found, AmplifierNode) and found is not AmplifierNode
    if not found.__name__.startswith("_")
)


class SelfStarting(AmplifierNode):
    """No defect: operational after boot-up without being asked (CiA 302-2, object 1F80h)."""

    def _boot(self, now_us: int) -> None:
        super()._boot(now_us)
        self._enter(NmtState.OPERATIONAL)


class WithoutConsumer(_OtherObjects):
    """No defect, but no 0x1016: what it has is its own time without an applied drive PDO (0x2012)."""

    def check_download(self, index: int, subindex: int, length: int | None) -> None:
        self._look(index)
        super().check_download(index, subindex, length)

    def read(self, index: int, subindex: int) -> bytes:
        self._look(index)
        return super().read(index, subindex)

    def write(self, index: int, subindex: int, data: bytes) -> None:
        self._look(index)
        super().write(index, subindex, data)

    def _look(self, index: int) -> None:
        if index == 0x1016:
            raise SdoAbortError(Abort.NO_OBJECT)


class EverySenseLate(AmplifierNode):
    """sense PDO: latency"""

    def _transmit(self, cob_id: int, data: bytes) -> None:
        if cob_id == 0x28A:
            self._clock.call_at(self._clock.now_us + 7000, lambda: super(EverySenseLate, self)._transmit(cob_id, data))
        else:
            super()._transmit(cob_id, data)


class WaitsOnce(AmplifierNode):
    """object dictionary: objects exist"""

    def _transmit(self, cob_id: int, data: bytes) -> None:
        if cob_id == 0x58A and data[1:4] == bytes.fromhex("0a 10 00"):
            self._clock.call_at(self._clock.now_us + 70_000, lambda: super(WaitsOnce, self)._transmit(cob_id, data))
        else:
            super()._transmit(cob_id, data)


class StillPlant:
    """Takes what it is given; its samples differ from one to the next."""

    def __init__(self) -> None:
        self.t_us = 0

    def exchange(self, t_us: int, counts: tuple[int, int, int] | None, *, sample: bool) -> tuple[int, int, int]:
        if counts is not None:
            self.drive(counts)
        if sample:
            self.t_us = t_us
        return self.t_us % 32768, -(self.t_us % 32769), 5

    def drive(self, counts: tuple[int, int, int]) -> None:
        assert min(counts) >= 0
