"""Reception of the drive PDO: no count reaches the amplifier that has not passed here."""

import struct
from collections.abc import Callable

from hil.node.crc import WORDS, crc8h2f, last_byte_table
from hil.node.emergency import ErrorCode, FrameErrors
from hil.node.object_dictionary import ObjectDictionary
from hil.node.pdo import Layout, PdoParameters

Outputs = tuple[int, int, int]
"""Counts of the three combs, as object 0x6411 holds them."""


_unpack_protected = struct.Struct("<3HBB").unpack
_OUTPUT = 0x6411


class DriveReceiver:
    """Checks length, CRC, alive counter and range of each drive PDO; ``pending`` holds the last one that passed.

    A count is valid from 0 to the high limit that the EDS gives to object 0x6411. The alive counter must be one more
    than that of the last frame with a correct CRC, whether that one passed or not: after a lost frame one more is
    refused, and the sequence goes on. The first frame after `start` may carry any.

    A frame that is the very next one, although a SYNC has found none to apply (`miss`), is late: it was meant for that
    SYNC. It is refused, unless it is 0 V; the frames behind it are taken, since the controller hears of it at once.

    Once the node has released the combs by itself (`demand_zero`), only 0 V passes first: what was queued somewhere on
    the way while the bus was blocked comes late, and must not energise them again.
    """

    def __init__(
        self, od: ObjectDictionary, parameters: PdoParameters, errors: FrameErrors, outputs: Callable[[], Outputs]
    ) -> None:
        self._parameters = parameters
        self._errors = errors
        self._w0, self._w1, self._w2 = WORDS
        self._outputs = outputs
        self._od = od
        self.pending: Outputs | None = None
        self.counter: int | None = None  # of the last frame with a correct CRC
        self.crc = 0
        self._is_zero_due = False
        self._is_owed = False  # a SYNC has passed for which no frame came
        self._was_refused = False  # a frame with a correct CRC, since the last SYNC
        self.configure()

    def configure(self) -> None:
        """Take over COB-ID and mapping from the dictionary."""
        self._limit = self._od.entry(_OUTPUT, 1).high or 0
        self._cob_bytes = self._parameters.cob_id.to_bytes(2, "little")
        self._layout: Layout = self._parameters.layout()
        self.receive = self._receive_mapped
        if self._layout.fields == self._parameters.protected_fields:
            self._w3 = last_byte_table(self._parameters.cob_id)
            self.receive = self._receive_protected

    @property
    def is_usual(self) -> bool:
        """Whether it takes the shipped frame, and holds nothing against the next one that is well."""
        usual = self._layout.fields == self._parameters.protected_fields and self._parameters.transmission_type <= 240
        return usual and self.counter is not None and not (self._is_owed or self._is_zero_due)

    def start(self) -> None:
        """Forget what came before: nothing pending, and any alive counter may come next."""
        self.pending = None
        self.counter = None
        self._is_owed = self._was_refused = False

    def reset(self) -> None:
        """As after power-up."""
        self.start()
        self.configure()
        self.crc = 0
        self._is_zero_due = False

    def demand_zero(self) -> None:
        """Let nothing pass until a frame with 0 V has."""
        self._is_zero_due = True

    def miss(self) -> None:
        """A SYNC found nothing pending."""
        self._is_owed = self.counter is not None and not self._was_refused
        self._was_refused = False

    def _receive_protected(self, data: bytes, t_us: int) -> None:
        try:
            a, b, c, counter, crc = _unpack_protected(data)
        except struct.error:
            self._wrong_length(data, t_us)
            return
        if self._w0[a] ^ self._w1[b] ^ self._w2[c] ^ self._w3[counter] != crc:
            self._errors.bad(ErrorCode.DRIVE_CRC, t_us, data[3:8])
            return
        last, self.counter, self.crc = self.counter, counter, crc
        if last is not None and (last + 1) & 0xFF != counter:
            self._refuse(ErrorCode.DRIVE_COUNTER, t_us, bytes((last, counter)))
            return
        limit = self._limit  # the words are unsigned here, so a negative count is above any limit
        if a > limit or b > limit or c > limit:
            self._refuse(ErrorCode.DRIVE_VALUE, t_us, _channels_over((a, b, c), limit))
            return
        if self._is_owed and self._is_late((a, b, c), t_us):
            return
        if self._is_zero_due and not self._zeroed((a, b, c)):
            return
        self.pending = (a, b, c)
        if self._errors.present:
            self._errors.good(t_us)

    def _refuse(self, code: int, t_us: int, info: bytes) -> None:
        self._is_owed, self._was_refused = False, True
        self._errors.bad(code, t_us, info)

    def _is_late(self, counts: Outputs, t_us: int) -> bool:
        self._refuse(ErrorCode.DRIVE_LATE, t_us, bytes((self.counter or 0,)))
        return any(counts)

    def _zeroed(self, counts: Outputs) -> bool:
        self._is_zero_due = any(counts)
        self._was_refused = self._is_zero_due
        return not self._is_zero_due

    def _receive_mapped(self, data: bytes, t_us: int) -> None:
        """The same for any mapping; a channel that is not mapped keeps its value."""
        layout = self._layout
        if len(data) != layout.codec.size:
            self._wrong_length(data, t_us)
            return
        values = layout.codec.unpack(data)
        if layout.crc is not None:
            if crc8h2f(self._cob_bytes + data[:-1]) != data[-1]:
                self._errors.bad(ErrorCode.DRIVE_CRC, t_us, data[-5:])
                return
            self.crc = data[-1]
        if layout.counter is not None:
            last, self.counter = self.counter, values[layout.counter]
            if last is not None and (last + 1) & 0xFF != self.counter:
                self._refuse(ErrorCode.DRIVE_COUNTER, t_us, bytes((last, values[layout.counter])))
                return
        words = list(self.pending or self._outputs())
        for (index, subindex), value in zip(layout.fields, values, strict=True):
            if index == _OUTPUT:
                words[subindex - 1] = value & 0xFFFF
        if max(words) > self._limit:
            self._refuse(ErrorCode.DRIVE_VALUE, t_us, _channels_over(words, self._limit))
            return
        if layout.counter is not None and self._is_owed and self._is_late((words[0], words[1], words[2]), t_us):
            return
        if self._is_zero_due and not self._zeroed((words[0], words[1], words[2])):
            return
        self.pending = (words[0], words[1], words[2])
        if self._errors.present:
            self._errors.good(t_us)

    def _wrong_length(self, data: bytes, t_us: int) -> None:
        """CiA 301 would use the front of a frame that is too long; with 200 V behind it, it is refused as well."""
        expected = self._layout.codec.size
        code = ErrorCode.DRIVE_SHORT if len(data) < expected else ErrorCode.DRIVE_LONG
        self._errors.bad(code, t_us, bytes((len(data), expected)))


def _channels_over(words: list[int] | Outputs, limit: int) -> bytes:
    return bytes((sum(1 << channel for channel, word in enumerate(words) if word > limit),))
