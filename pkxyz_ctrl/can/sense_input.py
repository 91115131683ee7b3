"""The sense PDO of the present tick: values that age, and what was wrong with them."""

from .codec import ProcessCodec

SENSE_MISSING = 1  # no valid sense PDO since the last SYNC: the values are old
SENSE_COUNTER = 2  # the alive counter is not one more than the last, or it does not match the SYNCs sent
SENSE_CRC = 4  # a sense PDO with a wrong CRC came, and was not used
SENSE_LENGTH = 8  # a sense PDO of a wrong length came, and was not used
SENSE_DUPLICATE = 16  # more than one valid sense PDO since the last SYNC

_SYNCS_UNCOUNTABLE = 255  # from here on an 8-bit counter says nothing about what was lost


class SenseInput:
    """Takes sense PDOs, offers the newest counts once a tick.

    The node sends one PDO a SYNC and counts them, so an alive counter is believed only if it is 1 to n more than the
    last, n being the number of SYNCs since. Only the n-th is the sample of the present SYNC. Those before it are late:
    they are counted, and no more, so that a frame that came after its tick gave up does not shift the later ones. An
    old frame that is played again is never used, and after a loss the next good frame is. After 255 SYNCs of silence
    any counter is taken. Counter and CRC are not looked at in plain PDOs.
    """

    __slots__ = (
        "_count_1",
        "_count_2",
        "_count_3",
        "_counter",
        "_decode",
        "_flags",
        "_length",
        "_protected",
        "_syncs",
        "fresh",
    )

    def __init__(self, codec: ProcessCodec) -> None:
        self._decode = codec.decode
        self._length = codec.length
        self._protected = codec.protected
        self.reset()

    def reset(self) -> None:
        """Forget everything: the node starts anew, with whatever counter."""
        self._count_1 = self._count_2 = self._count_3 = 0
        self._counter = -1
        self._syncs = 0
        self._flags = 0
        self.fresh = False

    def on_sync(self) -> None:
        """A SYNC goes out: what has been received is old from now on."""
        self.fresh = False
        if self._syncs < _SYNCS_UNCOUNTABLE:
            self._syncs += 1

    def receive(self, data: bytes) -> None:
        """A sense PDO's payload, of any length and content."""
        if len(data) != self._length:
            self._flags |= SENSE_LENGTH
            return
        count_1, count_2, count_3, counter, crc_right = self._decode(data)
        if not crc_right:
            self._flags |= SENSE_CRC
            return
        if self.fresh:
            self._flags |= SENSE_DUPLICATE
        if self._protected and not self._believe(counter):
            return
        self._count_1 = count_1
        self._count_2 = count_2
        self._count_3 = count_3
        self.fresh = True

    def _believe(self, counter: int) -> bool:
        ahead = (counter - self._counter) & 0xFF
        if self.fresh:
            return False  # this SYNC's sample is here: what else comes is repeated, or not yet due
        if (ahead != 1 or self._syncs != 1) and self._counter >= 0:
            self._flags |= SENSE_COUNTER
            if self._syncs < _SYNCS_UNCOUNTABLE:
                if not 1 <= ahead <= self._syncs:
                    return False
                if ahead < self._syncs:  # the sample of an earlier SYNC
                    self._counter = counter
                    self._syncs -= ahead
                    return False
        self._counter = counter
        self._syncs = 0
        return True

    def take(self) -> tuple[int, int, int, int]:
        """``(counts 1, counts 2, counts 3, status)``, once a tick; with SENSE_MISSING, the last valid counts.

        The status says what happened since the last call, so that a frame that comes
        too late is reported with the next tick.
        """
        status = self._flags if self.fresh else self._flags | SENSE_MISSING
        self._flags = 0
        return self._count_1, self._count_2, self._count_3, status
