"""What the node's combs rest on, signed: every so many SYNCs, behind the sense PDO, in a transmit PDO of its own."""

import struct
from binascii import crc_hqx
from collections.abc import Callable

from hil.node.object_dictionary import ObjectDictionary
from hil.node.pdo import PdoParameters

SIGNATURE = (0x2020, 1)
_INITIAL = 0xFFFF
_PDOS = (0x1401, 0x1801)  # of the drive and the sense counts
_MAPPING_OFFSET = 0x200
_OTHERS = (
    (0x1005, 0), (0x1016, 1), (0x1017, 0), (0x1019, 0), (0x1029, 1), (0x2010, 0), (0x2011, 0), (0x2012, 0),
    *((index, comb) for index in (0x6443, 0x6444) for comb in (1, 2, 3)),
)  # fmt: skip

SIGNED = frozenset({index for index, _ in _OTHERS} | {index + add for index in _PDOS for add in (0, _MAPPING_OFFSET)})
"""Indices of the objects that are signed, or parts of them."""


def signature(od: ObjectDictionary) -> int:
    """CRC-16-CCITT from 0xFFFF over index, sub-index and value of each object, little endian, in their order: of a
    mapping as many entries as it has.
    """
    keys = list(_OTHERS)
    for index in _PDOS:
        mapping = index + _MAPPING_OFFSET
        keys += [(index, 1), (index, 2), *((mapping, place) for place in range(1 + od[mapping, 0]))]
    signed = b"".join(struct.pack("<HB", *key) + od.entry(*key).encode() for key in sorted(keys))
    return crc_hqx(signed, _INITIAL)


class SignatureTransmitter:
    """Sends the signature at every n-th SYNC since the node became operational, as its PDO's transmission type says; a
    tick later where a heartbeat went along with the sense PDO: there is no room for both.
    """

    def __init__(self, od: ObjectDictionary, parameters: PdoParameters, send: Callable[[int, bytes], None]) -> None:
        self._od, self._parameters, self._send = od, parameters, send
        self.is_waiting = False
        """whether it is due, and has not gone yet"""
        self.every = 0
        self.left = 0
        """SYNCs until the one at which it is due; 0: it is not sent"""

    @property
    def cob_id(self) -> int:
        """Of the frame that carries it."""
        return self._parameters.cob_id

    def start(self) -> None:
        """The node has become operational."""
        parameters = self._parameters
        is_usual = parameters.in_use and parameters.layout().fields == (SIGNATURE,)
        self.every = parameters.transmission_type if is_usual and 1 <= parameters.transmission_type <= 240 else 0
        self.left, self.is_waiting = self.every, False

    def on_sync(self) -> None:
        """One of the SYNCs that are counted."""
        if self.every:
            self.left -= 1
            if self.left == 0:
                self.left, self.is_waiting = self.every, True

    def ride(self, has_heartbeat: bool) -> None:
        """A sense PDO has just been queued, with a heartbeat behind it or without."""
        if self.is_waiting and not has_heartbeat:
            self.is_waiting = False
            self._send(self._parameters.cob_id, struct.pack("<H", signature(self._od)))
