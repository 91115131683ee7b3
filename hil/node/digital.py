"""The node's digital outputs: eight bits of CiA 401's 0x6200, in a receive PDO of their own, put out at the SYNC."""

from collections.abc import Callable

from hil.node.object_dictionary import ObjectDictionary
from hil.node.pdo import PdoParameters

Switch = Callable[[int, int], object]
"""Told the eight bits at the terminals and since when, in us."""

_OUTPUT, _ERROR_MODE, _ERROR_VALUE = 0x6200, 0x6206, 0x6207


class DigitalOutputs:
    """``bits`` at the terminals; ``pending`` those of the last frame, which wait for the SYNC."""

    def __init__(self, od: ObjectDictionary, parameters: PdoParameters, switch: Switch) -> None:
        self._od, self._switch = od, switch
        self.parameters = parameters
        self.bits = 0
        self.pending: int | None = None

    @property
    def is_usual(self) -> bool:
        """Whether its PDO is the shipped one."""
        parameters = self.parameters
        usual = parameters.transmission_type <= 240 and parameters.layout().fields == ((_OUTPUT, 1),)
        return not parameters.in_use or usual

    @property
    def receivers(self) -> dict[int, Callable[[bytes, int], None]]:
        """What takes its PDO while operational, by COB-ID; none if it is not in use."""
        return {self.parameters.cob_id: self.receive} if self.parameters.in_use else {}

    def receive(self, data: bytes, t_us: int) -> None:
        """A frame of its PDO. One that is too short is not applied, and of a longer one the front is (CiA 301)."""
        if len(data) < self.parameters.layout().codec.size or not data:
            return
        self.pending = data[0]
        if self.parameters.transmission_type > 240:
            self.on_sync(t_us)

    def on_sync(self, t_us: int) -> None:
        """What waits is put out."""
        if self.pending is not None:
            self.put_out(self.pending, t_us)
            self.pending = None

    def put_out(self, bits: int, t_us: int) -> None:
        """At the terminals, from ``t_us`` on."""
        self.bits = self._od[_OUTPUT, 1] = bits
        self._switch(bits, t_us)

    def to_error_value(self, t_us: int) -> None:
        """Error mode bits of 1 take the error value, the others keep what they have (CiA 401)."""
        self.pending = None
        mode = self._od[_ERROR_MODE, 1]
        self.put_out(self.bits & ~mode | self._od[_ERROR_VALUE, 1] & mode, t_us)
