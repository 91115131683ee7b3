"""What a master reads and writes by SDO: the dictionary's access rules, and those that depend on the node's state."""

from collections.abc import Callable

from hil.node.object_dictionary import Abort, Entry, ObjectDictionary, SdoAbortError
from hil.node.pdo import PdoParameters, check_can_id

_FIXED_WHILE_OPERATIONAL = frozenset(
    (0x1005, 0x1014, 0x1015, 0x1016, 0x1019, 0x1029, 0x2010, 0x2011, 0x2012, 0x6443, 0x6444)
)
"""What keeps the combs safe and the controller informed; with them the parameters of both PDOs."""
LOOKED_UP = frozenset((0x1003, 0x2000, 0x2001, 0x2020, 0x6401, 0x6411))
"""What is not simply there when it is asked for; whoever answers in the node's place leaves these to it."""


class NodeObjects:
    """Stands between the SDO server and the dictionary.

    ``refresh(index)`` is called before a value of ``LOOKED_UP`` is touched, ``changed(index)`` after one was written;
    ``may_drive()`` tells whether a drive count other than 0 may be set by SDO, ``is_operational()`` whether what the
    combs' safety rests on is fixed: then nobody, whoever it is on the bus, changes it.
    """

    def __init__(
        self,
        od: ObjectDictionary,
        pdos: tuple[PdoParameters, ...],
        *,
        refresh: Callable[[int], None],
        changed: Callable[[int], None],
        may_drive: Callable[[], bool],
        is_operational: Callable[[], bool],
    ) -> None:
        self._od = od
        self._pdos = {index: pdo for pdo in pdos for index in (pdo.communication, pdo.mapping)}
        self._refresh = refresh
        self._changed = changed
        self._may_drive = may_drive
        self._is_operational = is_operational

    def read(self, index: int, subindex: int) -> bytes:
        entry = self._od.entry(index, subindex)
        entry.check_readable()
        self._look_up(index)
        if index == 0x1003 and subindex > self._count(index):
            raise SdoAbortError(Abort.NO_DATA)  # CiA 301, 7.5.2, object 1003h: there is no such error
        return entry.encode()

    def _count(self, index: int) -> int:
        count = self._od.entry(index, 0).value
        return count if isinstance(count, int) else 0

    def check_download(self, index: int, subindex: int, length: int | None) -> None:
        """What can be refused before the data are there. ``length`` in bytes, None if the client does not say."""
        entry = self._od.entry(index, subindex)
        entry.check_writable()
        if length is not None:
            entry.check_length(length)

    def unsized_length(self, index: int, subindex: int) -> int:
        """Bytes that count in an expedited download that does not say how many do."""
        return self._od.entry(index, subindex).length or 4

    def write(self, index: int, subindex: int, data: bytes) -> None:
        entry = self._od.entry(index, subindex)
        entry.check_writable()
        value = entry.decode(data)
        if isinstance(value, int):
            self._check(entry, value)
        self._look_up(index)  # of an array only one element is written
        entry.value = value
        self._changed(index)

    def _look_up(self, index: int) -> None:
        if index in LOOKED_UP:
            self._refresh(index)

    def _check(self, entry: Entry, value: int) -> None:
        index, subindex = entry.index, entry.subindex
        if (index in _FIXED_WHILE_OPERATIONAL or index in self._pdos) and self._is_operational():
            raise SdoAbortError(Abort.DEVICE_STATE)
        if index in self._pdos:
            self._pdos[index].check(index, subindex, value)
        elif index == 0x1003 and value != 0:
            raise SdoAbortError(Abort.VALUE_RANGE)  # zero clears the history; nothing else can be written
        elif index == 0x1005:
            if value & 1 << 30:
                raise SdoAbortError(Abort.VALUE_RANGE)  # the node does not produce SYNC
            check_can_id(value)
        elif index == 0x1014:
            check_can_id(value)
            old = self._od[0x1014, 0]
            if not (old | value) & 1 << 31 and (old ^ value) & 0x7FF:
                raise SdoAbortError(Abort.VALUE_RANGE)  # in use: the identifier cannot change
        elif index == 0x1016:
            self._check_heartbeat_consumer(subindex, value)
        elif index == 0x1019 and value == 1:
            raise SdoAbortError(Abort.VALUE_RANGE)  # reserved (CiA 301, 7.5.2.22)
        elif index == 0x6411 and value != 0 and not self._may_drive():
            raise SdoAbortError(Abort.LOCAL_CONTROL)
        elif index == 0x6444 and not 0 <= value <= (self._od.entry(0x6411, subindex).high or 0):
            raise SdoAbortError(Abort.VALUE_RANGE)

    def _check_heartbeat_consumer(self, subindex: int, value: int) -> None:
        node_id, time_ms = value >> 16, value & 0xFFFF
        if node_id > 127:
            raise SdoAbortError(Abort.VALUE_RANGE)
        for other in range(1, self._od[0x1016, 0] + 1):
            entry = self._od[0x1016, other]
            if other != subindex and time_ms and entry & 0xFFFF and entry >> 16 == node_id:
                raise SdoAbortError(Abort.INCOMPATIBLE)  # one node cannot have two times
