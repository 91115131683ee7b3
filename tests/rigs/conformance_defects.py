"""All amplifiers with one defect each, and some that only look so."""

from defective import frames, objects
from defective.objects import _OtherObjects

from hil.node.amplifier import AmplifierNode, NmtState
from hil.node.object_dictionary import Abort, SdoAbortError

DEFECTS: tuple[type[AmplifierNode], ...] = tuple(
    found
    for module in (objects, frames)
    for found in vars(module).values()
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
