"""The server's end of the memory that it shares with the loop: commands out, answers and telemetry in."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.operate.commands import ANSWER, COMMAND, PATH_BLOCK, PATH_ROWS, State, Verb, new_command
from hil.operate.memory import StageMemory
from pkxyz_ctrl.client import place
from pkxyz_ctrl.safety.modes import LOOP_CLOSED

Array = NDArray[np.float64]

_WAITING_MOST = 64
_VERBS = {int(verb): verb.name.lower() for verb in Verb}
_GONE_S = 1.0


class BusyError(Exception):
    """The loop has not taken what was said before."""


class Answer:
    """What the loop said about a command, or of itself."""

    def __init__(self, record: np.void) -> None:
        self.id = int(record["id"])
        number = int(record["verb"])
        self.verb = _VERBS.get(number, "")
        self.state = State(int(record["state"]))
        self.t_us = int(record["t_us"])
        self.words = record["words"].decode(errors="replace")

    @property
    def is_fault(self) -> bool:
        """Whether nobody asked."""
        return self.id == 0 and not self.verb


class Link:
    """Joined to the loop of ``name``, as soon as there is one; None of its methods waits."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.description: dict[str, Any] = {}
        self._memory: StageMemory | None = None
        self._last_id = time.time_ns() // 1000  # above those of a server before this one
        self._newest: np.void | None = None
        self._newest_number, self._seen_s = 0, 0.0

    # -- joining -------------------------------------------------------------------------------------------------------

    def join(self) -> bool:
        """Whether there is a loop; looks for one if there was none."""
        if self._memory is not None:
            return True
        found = place.read(self.name, "loop")
        if found is None:
            return False
        self.description = found
        memory = StageMemory(Path(found["memory"]))
        self._commands, self._path = memory.writer("commands"), memory.writer("path")
        self._laws = memory.writer("laws")
        self._answers, self.ticks = memory.reader("answers"), memory.reader("ticks")
        self._memory = memory
        return True

    @property
    def memory(self) -> StageMemory:
        """Shared with the loop that was joined."""
        assert self._memory is not None, "joined"
        return self._memory

    @property
    def is_joined(self) -> bool:
        """Whether there is a loop to talk to."""
        return self._memory is not None

    @property
    def is_alive(self) -> bool:
        """Whether the loop has ticked within the last second."""
        self.newest()
        return time.monotonic() - self._seen_s < _GONE_S

    # -- out -----------------------------------------------------------------------------------------------------------

    def sign_of_life(self) -> None:
        """Tell the loop that the server is there."""
        if self._memory is not None:
            self._memory.sign_of_life()

    def next_id(self) -> int:
        """The number of the next command."""
        self._last_id += 1
        return self._last_id

    def command(self, verb: Verb, command_id: int, **fields: Any) -> None:
        """Give a command. Raises ``BusyError`` where too many wait, or there is no loop."""
        if self._memory is None:
            raise BusyError("the loop is not there yet")
        newest = self.newest()
        taken = int(newest["session"]["commands"]) if newest is not None else 0
        if (waiting := self._commands.written - taken) > _WAITING_MOST:
            raise BusyError(f"{waiting} commands still wait for the loop")
        command = new_command(verb, command_id)
        for name, value in fields.items():
            command[name] = value
        self._commands.write(command.view(np.uint8).data[: COMMAND.itemsize])

    def stop(self, command_id: int) -> None:
        """Stop, past all that waits."""
        if self._memory is not None:
            self._memory.stop(command_id)

    def offer(self, offered: bytes) -> None:
        """A law, as bytes of ``OFFER``. Raises ``BusyError``."""
        if self._memory is None:
            raise BusyError("the loop is not there yet")
        self._laws.write(offered)

    def rows(self, path: int, first: int, motion: Array, outputs: NDArray[np.int64]) -> None:
        """Rows (n, 9) of a path and their trigger bits (n,), n at most ``PATH_ROWS``."""
        block = np.zeros(1, PATH_BLOCK)
        block["path"], block["first"], block["count"] = path, first, len(motion)
        block["motion"][0, : len(motion)], block["output"][0, : len(motion)] = motion, outputs
        assert len(motion) <= PATH_ROWS
        self._path.write(block.view(np.uint8).data)

    # -- in ------------------------------------------------------------------------------------------------------------

    def answers(self, take: Callable[[Answer], object]) -> None:
        """Hand on what the loop has said since."""
        if self._memory is None:
            return
        while (data := self._answers.read()) is not None:
            take(Answer(np.frombuffer(data, ANSWER)[0]))

    @property
    def stands_m(self) -> Array:
        """(3,) in its own coordinates, where the stage stands or will; at rest, as long as the loop is open."""
        newest = self.newest()
        if newest is None or not LOOP_CLOSED[newest["row"]["mode"]]:
            return np.zeros(3)
        return np.array(newest["session"]["target_m"])

    def newest(self) -> np.void | None:
        """The newest tick, a record of ``TICK``; None before the first."""
        if self._memory is None:
            return None
        number = self.ticks.newest
        if number != self._newest_number:
            found = self.ticks.latest()
            if found is not None:
                self._newest, self._newest_number, self._seen_s = found[0], number, time.monotonic()
        return self._newest
