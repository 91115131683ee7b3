"""A controller whose calls are made elsewhere: it holds the memory that they left, and has the words for it."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.export.calls import Call
from pkxyz_ctrl.export.stored import stored_in_exchange
from pkxyz_ctrl.loop.controller import Controller
from pkxyz_ctrl.loop.reference import standing_still
from pkxyz_ctrl.safety.gate import GateConfig

Records = NDArray[np.void]

HEAD: Final = np.dtype(
    [("t_us", "i8"), ("told", "i8"), ("call", "i4"), ("overrun", "i4"), ("cycle_counts", "u4"), ("period_counts", "u4")]
)
"""Of a note, as ``note_head`` of the firmware has it; behind it stands the memory."""


class ToldController(Controller):
    """Frames go out where the calls are made, so this one sends none.

    ``handed``: the frame that was handed over last; ``is_up``: periods may begin; ``finished``: periods so far;
    ``asked``: what ``clearing`` is to be, None while nobody has asked. ``sending``: for a controller that sends.
    """

    def __init__(self, law: Records, bus: BusConfig, gate: GateConfig, *sending: Any) -> None:
        super().__init__(law, bus, gate, lambda frame: None)
        self.handed: Frame | None = None
        self.is_up, self.finished = False, 0
        self.asked: bool | None = None
        self.held = stored_in_exchange(self.law).memory
        self._held = self.exchange.view(np.uint8)[: self.held]
        self._told = dict.fromkeys(Call, 0)
        self._start = self._answer(Call.START)
        self._wait = self._answer(Call.WAIT)
        self._come_up = self._answer(Call.COME_UP)
        self._begin = self._answer(Call.BEGIN)
        self._on_frame = self._answer(Call.FRAME)
        self._period = self._answer(Call.PERIOD)
        self._finish, self._prepare = self._answer(Call.FINISH), self._answer(Call.PREPARE)

    def _answer(self, call: Call) -> Any:
        return lambda *_: self._told[call]

    def clear(self) -> None:
        super().clear()
        self.asked = bool(self.exchange["clearing"][0])

    def take(self, head: np.void, memory: NDArray[np.uint8]) -> None:
        """A call was made: what it told, and the bytes that it left. Raises ``StartUpError`` where that failed."""
        call, t_us = Call(int(head["call"])), int(head["t_us"])
        self._told[call] = int(head["told"])
        self._held[:] = memory[: len(self._held)]  # a planner's own stands behind
        match call:
            case Call.START:
                self.start(t_us)
            case Call.COME_UP:  # behind what was told of a frame, or of none
                self.is_up = self.dialogue(self._heard, t_us)
            case Call.WAIT:
                self._heard = None
            case Call.FRAME if self.is_up:
                assert self.handed is not None
                self.receive(self.handed, t_us)
            case Call.FRAME:
                self._heard = self.handed
            case Call.BEGIN:
                self.begin(t_us)
            case Call.PERIOD:
                self.compute(standing_still(), int(head["overrun"]))
            case Call.FINISH:
                self.finish(t_us, t_us)
                self.finished += 1

    _heard: Frame | None = None
