"""The process of a native loop, from its beginning until all is known of it."""

import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from hil.lanes.ending import Ended, Ending
from hil.lanes.setup import Setup
from hil.lanes.wall import AmplifierGoneError, alone
from hil.native.held_pipe import HeldPipe
from hil.native.mapped import Mapped, text_of
from hil.native.settings import fill
from hil.native.teller import Teller
from pkxyz_ctrl.config.bus import CanConfig
from pkxyz_ctrl.export.shared import LoopEnd, Phase
from pkxyz_ctrl.io.can_port import refused_bus
from pkxyz_ctrl.loop.controller import StartUpError

LOOK_S = 0.01
_END_S = 10.0  # for a loop that is to end: on its way down at a slow rate, or behind a full ring
_LED_DOWN = {
    LoopEnd.SESSION_GONE: "nobody looked after the stage, so it was led down; free the machine",
    LoopEnd.PATH_LATE: "the path was not sampled in time, so the stage was led down; free the machine",
    LoopEnd.SET_POINTS_LATE: "the set-points were not made in time, so the stage was led down; free the machine",
}


class LoopProcess:
    """``close`` ends it, and then everything is known of it. ``told``: its words, and what it begins with."""

    def __init__(
        self, program: Path, setup: Setup, can: CanConfig, mapped: Mapped, told: Teller, held: HeldPipe, ending: Ending
    ) -> None:
        self._program, self._setup, self._can = program, setup, can
        self._mapped, self._told, self._held, self._ending = mapped, told, held, ending
        self.shared = mapped.shared[0]
        told.outputs[0] = setup.new_outputs()[0]
        told.lay_out(self.shared)
        self.state: Any = self.shared["state"][0]
        self._process: subprocess.Popen[bytes] | None = None
        self._asked = 0

    def begin(
        self, say: Callable[[str], object], company_s: float, meanwhile: Callable[[], object] = lambda: None,
        wake: int | None = None,
    ) -> None:  # fmt: skip
        """Begin it, and wait until it has a bus and company; ``wake``: an eventfd by which it tells of each tick, for
        a stage that is operated. Raises ``Ended`` and ``ConfigError``.
        """
        fill(self.shared["settings"], self._setup, self._can, company_s, is_operated=wake is not None)
        inherited = [self._held.pipe, *((wake,) if wake is not None else ())]
        words = [str(self._program), self._mapped.path, *map(str, inherited)]
        self._process = subprocess.Popen(
            words, pass_fds=(self._mapped.descriptor, *inherited), stdin=subprocess.DEVNULL
        )
        self._held.handed_over()
        self._mapped.close()
        if self.until(Phase.ALONE, meanwhile) == Phase.ALONE:
            say(alone(company_s))
        self.until(Phase.STARTING, meanwhile)
        if self.state["phase"] == Phase.ENDED:
            self.raise_outcome()

    def start(self, say: Callable[[str], object], meanwhile: Callable[[], object] = lambda: None) -> None:
        """Until the amplifier is started; ``say`` is told which protections are lacking. Raises ``StartUpError``."""
        self.until(Phase.RUNNING, meanwhile)
        if self.state["phase"] == Phase.ENDED and self.state["outcome"] == LoopEnd.NOT_STARTED:
            self.raise_outcome()
        self._remember()
        for lacking in self._told.driver.lost:
            say(f"this amplifier lacks a protection: {lacking}")

    def until(self, phase: Phase, meanwhile: Callable[[], object]) -> int:
        """Look after the loop until it has come so far, or is gone. Returns how far it has come."""
        while self.state["phase"] < phase and self.look():
            meanwhile()
            self._told.take(self.shared["events"][0])
            time.sleep(LOOK_S)
        return int(self.state["phase"])

    def look(self) -> bool:
        """Whether it is there; hands on the wish that it ends. Raises ``Ended`` where somebody killed it."""
        assert self._process is not None
        if self._process.poll() is not None:
            if self.state["phase"] != Phase.ENDED:
                self._killed(self._process.returncode)
            return False
        number = self._ending.signal_number
        if number and number != self._asked:
            self._asked = number
            self._process.send_signal(number)
        return True

    def close(self) -> None:
        """Let the loop end, by force if it doesn't; the node then takes the combs to 0 V by itself."""
        if self._process is None:
            return
        if self._process.poll() is None:
            if self.state["phase"] != Phase.ENDED:
                self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(_END_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._remember()

    def _remember(self) -> None:
        self._told.take(self.shared["events"][0])
        self._told.remember(self.shared["memory"]["own"][0], self.state["port"][0])

    def _killed(self, code: int) -> NoReturn:
        self._remember()
        self._told.faults.append(
            f"the native loop {f'was killed by signal {-code}' if code < 0 else f'ended with {code}'}; the node takes "
            "the combs to 0 V by itself once our heartbeat is missing"
        )
        raise Ended(-code if code < 0 else signal.SIGABRT)

    def raise_outcome(self) -> None:
        """Put into words how it ended. Raises what ``Ended``, ``ConfigError``, ``StartUpError`` or
        ``AmplifierGoneError`` are for.
        """
        self._remember()
        port, outcome = self.state["port"][0], LoopEnd(int(self.state["outcome"]))
        if outcome == LoopEnd.SIGNAL:
            raise Ended(int(self.state["signal"]))
        if outcome == LoopEnd.REFUSED:
            raise refused_bus(self._can, self._setup.bus.name, text_of(self.state["refusal"]))
        if outcome == LoopEnd.NOT_STARTED:
            raise StartUpError(self._why_not_started(int(port["sent"]), int(port["refused"])))
        if outcome == LoopEnd.AMPLIFIER_GONE:
            raise AmplifierGoneError
        if outcome in _LED_DOWN:
            self._told.faults.append(_LED_DOWN[outcome])
        if outcome == LoopEnd.KERNEL:
            self._told.faults.append(f"the controller's own code failed with {self.state['status']}: 0 V")

    def _why_not_started(self, sent: int, refused: int) -> str:
        told = self._told
        if refused and not sent:
            return told.complaint.removeprefix("; ")
        if told.exchange["blocked"][0]:
            return told.faults[-1]
        return told.failure
