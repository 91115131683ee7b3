"""The errors of SCPI-99, volume 2, chapter 21, as far as this instrument makes them, and their queue."""

from collections import deque
from typing import Final

MEANING: Final[dict[int, str]] = {
    0: "No error",
    -102: "Syntax error",
    -104: "Data type error",
    -108: "Parameter not allowed",
    -109: "Missing parameter",
    -113: "Undefined header",
    -200: "Execution error",
    -221: "Settings conflict",
    -222: "Data out of range",
    -223: "Too much data",
    -240: "Hardware error",
    -350: "Queue overflow",
}
_KEPT = 32
_WORDS_MOST = 255


class ScpiError(Exception):
    """Goes into the queue; ``about`` stands behind the standard's own words."""

    def __init__(self, number: int, about: str = "") -> None:
        super().__init__(number, about)
        self.number, self.about = number, about


class ErrorQueue:
    """Oldest first; when it is full, its last entry says that there were more."""

    def __init__(self) -> None:
        self._errors: deque[str] = deque()

    def put(self, error: ScpiError) -> None:
        """One more."""
        if len(self._errors) >= _KEPT:
            self._errors[-1] = _entry(-350, "")
            return
        self._errors.append(_entry(error.number, error.about))

    def take(self) -> str:
        """The oldest, which is gone then; number 0 if there is none."""
        return self._errors.popleft() if self._errors else _entry(0, "")

    def clear(self) -> None:
        """None of them."""
        self._errors.clear()

    def __len__(self) -> int:
        return len(self._errors)


def _entry(number: int, about: str) -> str:
    words = MEANING[number] + (f";{about}" if about else "")
    return f'{number},"{words[:_WORDS_MOST].replace(chr(34), chr(39)).replace(chr(10), " ")}"'
