"""Stops that were asked for: each has a number, and its end is told to whoever waits for it."""

from collections.abc import Callable

from hil.operate.commands import FINAL, State
from hil.server.link import Answer, Link


class Stopping:
    """``tell`` is told verb, number, state and words."""

    def __init__(self, link: Link, tell: Callable[[str, int, State, str], object]) -> None:
        self._link, self._tell = link, tell
        self._waiting: list[int] = []

    def ask(self, command_id: int) -> None:
        """Stop whatever moves, past all that waits."""
        self._link.stop(command_id)
        self._waiting.append(command_id)
        self._tell("stop", command_id, State.ACCEPTED, "")
        if not self._link.is_alive:
            self._end(command_id, State.ABORTED, "the loop does not tick: no set-point moves")

    def heard(self, answer: Answer) -> None:
        """What the loop says of one. It takes those that come within a tick for the last of them."""
        self._end(answer.id, answer.state, answer.words)

    def _end(self, command_id: int, state: State, words: str) -> None:
        for each in [asked for asked in self._waiting if asked <= command_id]:
            self._tell("stop", each, state, words)
        if state in FINAL:
            self._waiting = [asked for asked in self._waiting if asked > command_id]
