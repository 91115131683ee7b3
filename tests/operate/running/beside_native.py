"""A stage in operation by the native loop, and its session beside it: two processes, a plant, and whoever gives
commands through the memory, as a server does.
"""

import contextlib
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from operated_rig import MIDDLE_M
from two_processes import started

from hil.operate.commands import FINAL, PATH_ROWS, TICK, Activity, State, Verb
from hil.server.link import Answer, Link
from pkxyz_ctrl.client import place
from pkxyz_ctrl.safety.modes import Mode

NAME = "beside"
WORDS = ("operate", "--bus", "slow.toml", "--controller", "patient.toml", "--name", NAME, "--silence-s", "0.3")
WAITS_S = 60.0
_UNDER_WAY_ROWS = 20.0


class Operator:
    """Gives commands, sees what comes of them; ``rows`` are those of all ticks so far."""

    def __init__(self, run: Any) -> None:
        self.run, self.link = run, Link(NAME)
        self._until(self.link.join)
        self.session = int(self.link.description["pid"])
        self._reader = self.link.memory.reader("ticks", from_start=True)
        self._rows: list[np.ndarray] = []
        self.answers: dict[int, tuple[State, str]] = {}
        self.is_silent = self._is_over = False
        self._thread = threading.Thread(target=self._look_after, daemon=True)
        self._thread.start()

    @property
    def loop(self) -> int:
        """The process of the loop in C."""
        (pid,) = Path(f"/proc/{self.session}/task/{self.session}/children").read_text(encoding="ascii").split()
        return int(pid)

    @property
    def state(self) -> np.void:
        newest = self.link.newest()
        assert newest is not None
        return newest["session"]

    @property
    def rows(self) -> np.ndarray:
        """Of ``ROW``; those before what was asked for ask for nothing."""
        return np.concatenate([block["row"] for block in list(self._rows)])

    def give(self, verb: Verb, **fields: Any) -> int:
        command_id = self.link.next_id()
        self.link.command(verb, command_id, **fields)
        return command_id

    def ended(self, command_id: int) -> tuple[State, str]:
        self._until(lambda: self.answers.get(command_id, (None, ""))[0] in FINAL)
        return self.answers[command_id]

    def do(self, verb: Verb, **fields: Any) -> str:
        """Give a command that has to be done; its words."""
        state, words = self.ended(self.give(verb, **fields))
        assert state is State.DONE, words
        return words

    def switched_on(self) -> None:
        """In the middle of the workspace; a machine that stands still may put it in fault before."""
        self.until(Activity.OFF, Activity.FAULT)
        if self.state["activity"] == Activity.FAULT:
            self.do(Verb.CLEAR)
        self.do(Verb.HOME)
        self.do(Verb.ENABLE)
        self.do(Verb.MOVE, target_m=MIDDLE_M)

    def follow(self, number: int, rows: np.ndarray, start: np.ndarray) -> int:
        """Set out on a path (n, 9); all of it lies in the memory before."""
        for first in range(0, len(rows), PATH_ROWS):
            block = rows[first : first + PATH_ROWS]
            self.link.rows(number, first, block, np.zeros(len(block), np.int64))
        command = self.give(Verb.PATH, path=number, rows=len(rows), start_m=start, target_m=rows[-1, 0:3])
        self.until(Activity.SCANNING)
        self._until(lambda: float(self.state["path_row"]) > _UNDER_WAY_ROWS)  # so the loop has taken it, too
        return command

    def until(self, *activities: Activity) -> None:
        self._until(lambda: self.link.newest() is not None and self.state["activity"] in activities)

    def close(self) -> None:
        self._is_over = True
        self._thread.join()

    def _until(self, is_so: Any) -> None:
        end_s = time.monotonic() + WAITS_S
        while not is_so():
            assert self.run.poll() is None, self.run.communicate()
            assert time.monotonic() < end_s, (self.answers, self.link.newest())
            time.sleep(0.002)

    def _look_after(self) -> None:
        def note(answer: Answer) -> None:
            self.answers[answer.id] = answer.state, answer.words

        while not self._is_over:
            if not self.is_silent:
                self.link.sign_of_life()
            self.link.answers(note)
            if len(block := self._reader.read_block(2000)):
                self._rows.append(block.astype(TICK))
            time.sleep(0.005)


@contextlib.contextmanager
def operating(folder: Path, *words: str) -> Iterator[Operator]:
    """By the native loop; whatever becomes of the test, nothing is left."""
    before = os.environ.get("XDG_RUNTIME_DIR")
    os.environ["XDG_RUNTIME_DIR"] = str(folder)
    run = started(folder, *WORDS, *(words or ("--native",)))
    operator = None
    try:
        operator = Operator(run)
        yield operator
    finally:
        if operator is not None:
            operator.close()
        if run.poll() is None:
            run.terminate()
        run.communicate(timeout=60)
        place.forget(NAME, "loop")
        os.environ.pop("XDG_RUNTIME_DIR")
        if before is not None:
            os.environ["XDG_RUNTIME_DIR"] = before


def require_no_jump(rows: np.ndarray, speed_max_m_per_s: float) -> None:
    """While it is tracked, from tick to tick, the set-point goes as far as it may in a period and no farther."""
    tracked = (rows["mode"][1:] == Mode.TRACKING) & (rows["mode"][:-1] == Mode.TRACKING) & (np.diff(rows["tick"]) == 1)
    steps = np.abs(np.diff(rows["reference_m"], axis=0))[tracked]
    assert steps.max() <= speed_max_m_per_s * 1e-3 * 1.05
    assert (np.diff(rows["reference_tick"])[tracked] == 1).all()
