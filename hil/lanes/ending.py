"""Ctrl-C and SIGTERM, taken note of where they may end something and not in the middle of it."""

import signal
from types import FrameType


class Ended(Exception):  # noqa: N818
    """Not an error: somebody asked for the end; ``signal_number`` says how."""

    def __init__(self, signal_number: int) -> None:
        super().__init__(signal.Signals(signal_number).name)
        self.signal_number = signal_number


class Ending:
    """While in force (``with``), SIGINT, SIGTERM and SIGHUP only set ``signal_number``; ``check`` raises ``Ended``."""

    _SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

    def __init__(self) -> None:
        self.signal_number = 0
        self._before: list[tuple[signal.Signals, object]] = []

    def check(self) -> None:
        """Raise ``Ended`` if somebody asked for the end."""
        if self.signal_number:
            raise Ended(self.signal_number)

    def __enter__(self) -> "Ending":
        self._before = [(number, signal.signal(number, self._note)) for number in self._SIGNALS]
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before:
            signal.signal(number, handler)  # type: ignore[arg-type]

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.signal_number = self.signal_number or number
