"""The sense PDO of the present tick: values that age, and what was wrong with them."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.can.codec import ProcessCodec
from pkxyz_ctrl.can.process_pdo import PDO, PROTECTED_LENGTH, count_of, counter_of, is_right
from pkxyz_ctrl.compiled.direct_call import direct
from pkxyz_ctrl.compiled.kernel import kernel

Records = NDArray[np.void]

SENSE_MISSING = 1  # no valid sense PDO since the last SYNC: the values are old
SENSE_COUNTER = 2  # the alive counter is not one more than the last, or it does not match the SYNCs sent
SENSE_CRC = 4  # a sense PDO with a wrong CRC came, and was not used
SENSE_LENGTH = 8  # a sense PDO of a wrong length came, and was not used
SENSE_DUPLICATE = 16  # more than one valid sense PDO since the last SYNC

SYNCS_UNCOUNTABLE: Final = 255  # from here on an 8-bit counter says nothing about what was lost

SENSE = np.dtype([("pdo", PDO, (1,)), ("syncs_uncountable", "i4")], align=True)

SENSE_MEMORY = np.dtype(
    [
        ("count", "i4", (3,)),  # that were believed last
        ("counter", "i4"),  # of the last PDO that was; -1: none
        ("syncs", "i4"),  # since then
        ("flags", "i4"),  # what went wrong since it was looked at
        ("fresh", "i4"),  # 1: this SYNC's sample is here
    ],
    align=True,
)


@kernel
def reset(memory_array: Records) -> None:
    """Forget everything: the node starts anew, with whatever counter."""
    memory = memory_array[0]
    for i in range(3):
        memory["count"][i] = 0
    memory["counter"] = -1
    memory["syncs"] = memory["flags"] = memory["fresh"] = 0


@kernel
def on_sync(config_array: Records, memory_array: Records) -> None:
    """A SYNC goes out: what has been received is old from now on."""
    memory = memory_array[0]
    memory["fresh"] = 0
    if memory["syncs"] < config_array[0]["syncs_uncountable"]:
        memory["syncs"] += 1


@kernel
def receive(config_array: Records, memory_array: Records, length: int, word: int) -> None:
    """A sense PDO's payload: its length, and its first eight bytes as an integer, the first one lowest."""
    config, memory = config_array[0], memory_array[0]
    pdo = config["pdo"]
    if length != pdo[0]["length"]:
        memory["flags"] |= SENSE_LENGTH
        return
    if not is_right(pdo, word):
        memory["flags"] |= SENSE_CRC
        return
    if memory["fresh"] != 0:
        memory["flags"] |= SENSE_DUPLICATE
    if length == PROTECTED_LENGTH and not _believe(config, memory, counter_of(word)):
        return
    for i in range(3):
        memory["count"][i] = count_of(word, i)
    memory["fresh"] = 1


@kernel
def _believe(config: np.void, memory: np.void, counter: int) -> bool:
    ahead = counter - memory["counter"] & 0xFF
    if memory["fresh"] != 0:
        return False  # this SYNC's sample is here: what else comes is repeated, or not yet due
    if (ahead != 1 or memory["syncs"] != 1) and memory["counter"] >= 0:
        memory["flags"] |= SENSE_COUNTER
        if memory["syncs"] < config["syncs_uncountable"]:
            if not 1 <= ahead <= memory["syncs"]:
                return False
            if ahead < memory["syncs"]:  # the sample of an earlier SYNC
                memory["counter"] = counter
                memory["syncs"] -= ahead
                return False
    memory["counter"] = counter
    memory["syncs"] = 0
    return True


@kernel
def take(memory_array: Records) -> int:
    """What is wrong with this tick's counts, and what was with others since the last call; 0 is a good frame."""
    memory = memory_array[0]
    status = memory["flags"] if memory["fresh"] != 0 else memory["flags"] | SENSE_MISSING
    memory["flags"] = 0
    return status


class SenseInput:
    """Takes sense PDOs, offers the newest counts once a tick.

    The node sends one PDO a SYNC and counts them, so an alive counter is believed only if it is 1 to n more than the
    last, n being the number of SYNCs since. Only the n-th is the sample of the present SYNC. Those before it are late:
    they are counted, and no more, so that a frame that came after its tick gave up does not shift the later ones. An
    old frame that is played again is never used, and after a loss the next good frame is. After ``syncs_uncountable``
    SYNCs of silence any counter is taken. Counter and CRC are not looked at in plain PDOs.

    The rules are compiled: ``record`` (1,) of ``SENSE`` is what they go by, ``memory`` (1,) of ``SENSE_MEMORY`` all
    that is remembered.
    """

    def __init__(
        self,
        codec: ProcessCodec,
        syncs_uncountable: int = SYNCS_UNCOUNTABLE,
        record: Records | None = None,
        memory: Records | None = None,
    ) -> None:
        """``record`` and ``memory``: where they are to stand."""
        self.record = np.zeros(1, SENSE) if record is None else record
        self.record["pdo"][0] = codec.record
        self.record["syncs_uncountable"] = syncs_uncountable
        self.memory = np.zeros(1, SENSE_MEMORY) if memory is None else memory
        self._fresh = self.memory["fresh"].data  # 40 ns for a look
        self._count = self.memory["count"][0].data
        self._on_sync = direct(on_sync, self.record, self.memory)
        self._receive = direct(receive, self.record, self.memory, 0, 0)
        self._take = direct(take, self.memory)
        self.reset()

    @property
    def fresh(self) -> bool:
        """Whether this SYNC's sample is here."""
        return self._fresh[0] != 0

    def reset(self) -> None:
        """Forget everything: the node starts anew, with whatever counter."""
        reset(self.memory)

    def on_sync(self) -> None:
        """A SYNC goes out: what has been received is old from now on."""
        self._on_sync(self.record, self.memory)

    def receive(self, data: bytes) -> None:
        """A sense PDO's payload, of any length and content."""
        word = int.from_bytes(data[:PROTECTED_LENGTH], "little", signed=True)
        self._receive(self.record, self.memory, len(data), word)

    def take(self) -> tuple[int, int, int, int]:
        """``(counts 1, counts 2, counts 3, status)``, once a tick; with SENSE_MISSING, the last valid counts.

        The status says what happened since the last call, so that a frame that comes
        too late is reported with the next tick.
        """
        status: int = self._take(self.memory)
        first, second, third = self._count
        return first, second, third, status
