"""What a controller was called with, call by call: the script of an exchange, to be gone through again elsewhere."""

from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.can.driver import word_of
from pkxyz_ctrl.can.frame import Frame
from pkxyz_ctrl.loop.controller import Controller
from pkxyz_ctrl.safety.modes import Event

Records = NDArray[np.void]

CALL = np.dtype(
    [
        ("t_us", "i8"),
        (
            "data",
            "i8",
        ),  # of a frame; when a heartbeat is too late, us; periods that were skipped; what is asked for
        ("can_id", "i4"),
        ("flags", "i4"),
        ("length", "i4"),
        ("kind", "i2"),  # a ``Call``
        ("mode", "i2"),  # for JUDGE: of the controller
    ],
    align=True,
)


class Call(IntEnum):
    """Which of the entries; or what is written to ``event`` and to ``clearing``."""

    START = 0
    WAIT = 1
    COME_UP = 2
    BEGIN = 3
    FRAME = 4
    PERIOD = 5
    FINISH = 6
    STOP = 7
    JUDGE = 8
    REQUEST = 9
    CLEAR = 10
    PREPARE = 11


class RecordedController(Controller):
    """A controller that notes its calls; it does nothing otherwise."""

    def __init__(self, *words: Any, **options: Any) -> None:
        super().__init__(*words, **options)
        self._noted: list[tuple[int, ...]] = []

    @property
    def calls(self) -> Records:
        """(n,) of ``CALL``, in their order."""
        return np.array(self._noted, CALL)

    def start(self, t_us: int) -> None:
        self._note(Call.START, t_us)
        super().start(t_us)

    def dialogue(self, frame: Frame | None, t_us: int) -> bool:
        if frame is None:
            self._note(Call.WAIT, t_us)
        else:
            self._note_frame(frame, t_us)
        self._note(Call.COME_UP, t_us)
        self._is_noted = True
        try:
            return super().dialogue(frame, t_us)
        finally:
            self._is_noted = False

    _is_noted = False

    def receive(self, frame: Frame, t_us: int) -> bool:
        if not self._is_noted:
            self._note_frame(frame, t_us)
        return super().receive(frame, t_us)

    def begin(self, t_us: int) -> None:
        self._note(Call.BEGIN, t_us)
        super().begin(t_us)

    def compute(self, reference: Records, overrun: int) -> None:
        self._note(Call.PERIOD, 0, overrun)
        super().compute(reference, overrun)

    def finish(self, t_us: int, heartbeat_until_us: int) -> None:
        self._note(Call.FINISH, t_us, heartbeat_until_us)
        super().finish(t_us, heartbeat_until_us)
        self._note(Call.PREPARE, t_us)

    def stop(self, t_us: int) -> None:
        self._note(Call.STOP, t_us)
        super().stop(t_us)

    def request(self, event: Event) -> None:
        self._note(Call.REQUEST, 0, event)
        super().request(event)

    def clear(self) -> None:
        super().clear()
        self._note(Call.CLEAR, 0, int(self.exchange["clearing"][0]))

    def _note(self, call: Call, t_us: int, data: int = 0) -> None:
        self._noted.append((t_us, data, 0, 0, 0, call, 0))

    def _note_frame(self, frame: Frame, t_us: int) -> None:
        self._noted.append((t_us, word_of(frame.data), frame.can_id, frame.flags, len(frame.data), Call.FRAME, 0))
