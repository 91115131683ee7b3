"""Amplifiers with one defect each, in identity, objects or SDO; the docstring is the line that has to say so."""

from hil.node.amplifier import AmplifierNode, NmtState
from hil.node.object_dictionary import Abort, SdoAbortError


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


class FixedErrorMode(_OtherObjects):
    """outputs: error mode and value"""

    def read(self, index: int, subindex: int) -> bytes:
        return b"\1" if (index, subindex) == (0x6443, 3) else super().read(index, subindex)


class Silent(AmplifierNode):
    """identity: answers"""

    def _on_sdo(self, data: bytes, t_us: int) -> None:
        pass


class SignsSomethingElse(_OtherObjects):
    """signature: of what is read"""

    def read(self, index: int, subindex: int) -> bytes:
        told = super().read(index, subindex)
        return bytes((told[0] ^ 1, told[1])) if (index, subindex) == (0x2020, 1) else told


class OutputsAreDeaf(AmplifierNode):
    """digital outputs: RPDO 1"""

    def power_on(self) -> None:
        self.digital.receive = lambda data, t_us: None
        super().power_on()
