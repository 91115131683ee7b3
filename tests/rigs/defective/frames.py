"""Amplifiers with one defect each, in NMT, heartbeat, PDO or outputs; the docstring is the line that has to say so."""

from typing import Any

from hil.node.amplifier import AmplifierNode, NmtState
from pkxyz_ctrl.can.codec import ProcessCodec
from pkxyz_ctrl.can.frame import EXTENDED, Frame

SENSE = ProcessCodec(0x28A, True)
DRIVE = ProcessCodec(0x30A, True)
SENSE_FOREIGN = ProcessCodec(0x30A, True)


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
