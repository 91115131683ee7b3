"""PDO parameters of the amplifier node: what may be mapped and configured, and the layout that follows from it.

CiA 301, 7.5.2.33 to 7.5.2.38. A new mapping takes the procedure of CiA 301: PDO out of use (bit 31 of its COB-ID), sub
0 to zero, the entries, sub 0 to their number, PDO into use.
"""

import struct
from dataclasses import dataclass
from typing import Literal

from hil.node.object_dictionary import Abort, ObjectDictionary, SdoAbortError

COMMUNICATION_BASE = {"receive": 0x1400, "transmit": 0x1800}
MAPPING_OFFSET = 0x200
_INVALID = 1 << 31
_NO_RTR = 1 << 30

# CiA 301, 7.3.5 "restricted CAN-IDs": no PDO, SYNC or EMCY may use these
_RESTRICTED = (
    (0x000, 0x07F),
    (0x101, 0x180),
    (0x581, 0x5FF),
    (0x601, 0x67F),
    (0x6E0, 0x6FF),
    (0x701, 0x7FF),
)


def check_can_id(cob_id: int) -> None:
    """Abort unless the low 30 bits of ``cob_id`` are a base-frame identifier that may be configured."""
    can_id = cob_id & 0x3FFFFFFF
    if can_id > 0x7FF or any(first <= can_id <= last for first, last in _RESTRICTED):
        raise SdoAbortError(Abort.VALUE_RANGE)


@dataclass(frozen=True)
class Layout:
    """Fields of a PDO in wire order. ``fields`` are dictionary keys; counter and CRC are positions in it, or None."""

    fields: tuple[tuple[int, int], ...]
    codec: struct.Struct
    counter: int | None
    crc: int | None


class PdoParameters:
    """One PDO: communication parameter and mapping parameter in the dictionary, checked as a whole.

    ``values`` is the object whose ``channels`` subs are the process values, ``protection`` the one that holds the alive
    counter (sub 1) and the CRC (sub 2). With ``protected`` a mapping without both is refused.
    """

    def __init__(
        self,
        od: ObjectDictionary,
        direction: Literal["receive", "transmit"],
        number: int,
        *,
        values: int,
        protection: int,
        protected: bool,
        channels: int = 3,
    ) -> None:
        self._od = od
        self.direction = direction
        self.communication = COMMUNICATION_BASE[direction] + number - 1
        self.mapping = self.communication + MAPPING_OFFSET
        self._protection = protection
        self._protected = protected
        plain = tuple((values, 1 + n) for n in range(channels))
        self.protected_fields = (*plain, (protection, 1), (protection, 2))
        if not protected:
            od.install(self.mapping, 0, channels)
            for behind in (1, 2):
                od.install(self.mapping, channels + behind, 0)

    @classmethod
    def plain(
        cls, od: ObjectDictionary, direction: Literal["receive", "transmit"], number: int, value: int
    ) -> "PdoParameters":
        """Of one value, sub 1 of ``value``, without alive counter and CRC."""
        return cls(od, direction, number, values=value, protection=0x2000, protected=False, channels=1)

    @property
    def in_use(self) -> bool:
        return not self._od[self.communication, 1] & _INVALID

    @property
    def cob_id(self) -> int:
        return self._od[self.communication, 1] & 0x7FF

    @property
    def transmission_type(self) -> int:
        return self._od[self.communication, 2]

    def layout(self) -> Layout:
        """The layout of the mapping that is in force."""
        return self._layout(self._od[self.mapping, 0])

    def check(self, index: int, subindex: int, value: int) -> None:
        """Abort if ``value`` may not be written now."""
        if index == self.communication:
            self._check_communication(subindex, value)
        else:
            self._check_mapping(subindex, value)

    def _check_communication(self, subindex: int, value: int) -> None:
        if subindex == 1:
            check_can_id(value)
            if self.direction == "transmit" and not value & _NO_RTR:
                raise SdoAbortError(Abort.VALUE_RANGE)  # CAN FD has no remote frames
            if self.in_use and not value & _INVALID and value & 0x7FF != self.cob_id:
                raise SdoAbortError(Abort.VALUE_RANGE)  # bits 0 to 29 are fixed while the PDO is in use
            if not value & _INVALID and self._od[self.mapping, 0] == 0:
                raise SdoAbortError(Abort.INCOMPATIBLE)
        elif subindex == 2:
            if 241 <= value <= 253:  # reserved, and the two types that are polled by remote frames
                raise SdoAbortError(Abort.VALUE_RANGE)
        elif subindex in (3, 6) and self.in_use:  # inhibit time, SYNC start value
            raise SdoAbortError(Abort.DEVICE_STATE)

    def _check_mapping(self, subindex: int, value: int) -> None:
        if self.in_use:
            raise SdoAbortError(Abort.DEVICE_STATE)
        if subindex == 0:
            if value:
                self._layout(value)
        elif self._od[self.mapping, 0] != 0:
            raise SdoAbortError(Abort.DEVICE_STATE)
        elif value:
            self._field(value)

    def _field(self, entry: int) -> tuple[int, int]:
        index, subindex, bits = entry >> 16, entry >> 8 & 0xFF, entry & 0xFF
        if (index, subindex) not in self._od:
            raise SdoAbortError(Abort.NOT_MAPPABLE)
        found = self._od.entry(index, subindex)
        wrong_way = found.access in (("ro", "const", "rwr") if self.direction == "receive" else ("wo", "rww"))
        if not found.mappable or wrong_way or found.length is None or 8 * found.length != bits:
            raise SdoAbortError(Abort.NOT_MAPPABLE)
        return index, subindex

    def _layout(self, count: int) -> Layout:
        fields = tuple(self._field(self._od[self.mapping, 1 + i]) for i in range(count))
        entries = [self._od.entry(*field) for field in fields]
        codec = struct.Struct("<" + "".join({1: "B", 2: "h", 4: "i"}[entry.length or 0] for entry in entries))
        if codec.size > 8:
            raise SdoAbortError(Abort.PDO_LENGTH)
        counters, crcs = ([i for i, field in enumerate(fields) if field == (self._protection, sub)] for sub in (1, 2))
        if len(set(fields)) != len(fields) or (crcs and crcs[0] != count - 1):
            raise SdoAbortError(Abort.INCOMPATIBLE)  # the CRC covers what stands before it: it comes last
        if self._protected and count and not (counters and crcs):
            raise SdoAbortError(Abort.INCOMPATIBLE)
        return Layout(fields, codec, counters[0] if counters else None, crcs[0] if crcs else None)
