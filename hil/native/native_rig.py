"""One run of a native loop: its process, what it is given ahead, what becomes of it. As ``WallRig`` for Python's."""

import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import numpy as np

from hil.lanes.ending import Ended, Ending
from hil.lanes.setup import Setup
from hil.lanes.wall import AmplifierGoneError, alone
from hil.native.mapped import Mapped, text_of
from hil.native.path_feeder import PathFeeder
from hil.native.ring_recorder import RingRecorder
from hil.native.settings import fill
from hil.native.teller import Teller
from pkxyz_ctrl.config.bus import CanConfig
from pkxyz_ctrl.export.shared import LoopEnd, Phase
from pkxyz_ctrl.io.can_port import refused_bus
from pkxyz_ctrl.learning import Learner
from pkxyz_ctrl.loop.controller import StartUpError

_LOOK_S = 0.01
_END_S = 10.0  # for a loop that is to end: on its way down at a slow rate, or behind a full ring


class NativeRig:
    """The loop's process. ``close`` ends it, and then everything is known of it."""

    learner: Learner | None = None
    """What it learns stands in its law."""

    def __init__(
        self, program: Path, setup: Setup, can: CanConfig, mapped: Mapped, recorder: RingRecorder, ending: Ending
    ) -> None:
        self._program, self._setup, self._can = program, setup, can
        self._mapped, self._recorder, self._ending = mapped, recorder, ending
        self.controller = Teller(setup)
        self._feeder = PathFeeder(setup, mapped.blocks)
        self._shared = mapped.shared[0]
        self.controller.outputs[0] = setup.new_outputs()[0]
        self._shared["config"], self._shared["memory"] = self.controller.record, self.controller.exchange
        self._state = self._shared["state"][0]
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def refused_frames(self) -> int:
        return int(self._state["port"]["refused"][0])

    @property
    def dropped_frames(self) -> int | None:
        return int(self._state["port"]["dropped"][0]) if self._is_among_processes else None

    @property
    def lateness_us(self) -> list[int]:
        return self._state["lateness"].tolist()

    @property
    def complaint(self) -> str:
        return self.controller.complaint

    @property
    def is_amplifier_a_process(self) -> bool:
        return self._is_among_processes

    def wait_for_others(self, say: Callable[[str], object], company_s: float) -> None:
        """Begin the loop, and wait until it has a bus and company. Raises ``Ended`` and ``ConfigError``."""
        fill(self._shared["settings"], self._setup, self._can, company_s)
        words = [str(self._program), self._mapped.path, str(self._recorder.pipe)]
        inherited = (self._mapped.descriptor, self._recorder.pipe)
        self._process = subprocess.Popen(words, pass_fds=inherited, stdin=subprocess.DEVNULL)
        self._recorder.handed_over()
        self._mapped.close()
        if self._until(Phase.ALONE) == Phase.ALONE:
            say(alone(company_s))
        self._until(Phase.STARTING)
        if self._state["phase"] == Phase.ENDED:
            self._raise_outcome()

    def go_real_time(self) -> str:
        """What the system gave the loop, in a line."""
        return text_of(self._state["real_time"])

    def start(self, say: Callable[[str], object]) -> None:
        """Until the amplifier is started; ``say`` is told which protections are lacking. Raises ``StartUpError``."""
        self._until(Phase.RUNNING)
        if self._state["phase"] == Phase.ENDED and self._state["outcome"] == LoopEnd.NOT_STARTED:
            self._raise_outcome()
        self._remember()
        for lacking in self.controller.driver.lost:
            say(f"this amplifier lacks a protection: {lacking}")

    def run(self) -> None:
        """Until the loop has ended. Raises ``AmplifierGoneError`` and ``Ended``."""
        self._until(Phase.ENDED)
        self._raise_outcome()

    def close(self) -> None:
        """Let the loop end, by force if it doesn't; the node then takes the combs to 0 V by itself."""
        if self._process is None:
            return
        if self._process.poll() is None:
            if self._state["phase"] != Phase.ENDED:
                self._process.send_signal(signal.SIGTERM)
            try:
                self._process.wait(_END_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._remember()

    @property
    def _is_among_processes(self) -> bool:
        return self._can.interface == "pkxyz-unix"

    def _until(self, phase: Phase) -> int:
        """Look after the loop until it has come so far, or is gone. Returns how far it has come."""
        assert self._process is not None
        asked = 0
        while self._state["phase"] < phase:
            if self._process.poll() is not None:
                if self._state["phase"] != Phase.ENDED:
                    self._killed(self._process.returncode)
                break
            number = self._ending.signal_number
            if number and number != asked:
                asked = number
                self._process.send_signal(number)
            self._feeder.feed(int(self._state["reference_tick"]))
            self.controller.take(self._shared["events"][0])
            time.sleep(_LOOK_S)
        return int(self._state["phase"])

    def _remember(self) -> None:
        self.controller.take(self._shared["events"][0])
        self.controller.remember(np.atleast_1d(self._shared["memory"]), self._state["port"][0])

    def _killed(self, code: int) -> NoReturn:
        self._remember()
        self.controller.faults.append(
            f"the native loop {f'was killed by signal {-code}' if code < 0 else f'ended with {code}'}; the node takes "
            "the combs to 0 V by itself once our heartbeat is missing"
        )
        raise Ended(-code if code < 0 else signal.SIGABRT)

    def _raise_outcome(self) -> None:
        self._remember()
        port, outcome = self._state["port"][0], LoopEnd(int(self._state["outcome"]))
        if outcome == LoopEnd.SIGNAL:
            raise Ended(int(self._state["signal"]))
        if outcome == LoopEnd.REFUSED:
            raise refused_bus(self._can, self._setup.bus.name, text_of(self._state["refusal"]))
        if outcome == LoopEnd.NOT_STARTED:
            raise StartUpError(self._why_not_started(int(port["sent"]), int(port["refused"])))
        if outcome == LoopEnd.AMPLIFIER_GONE:
            raise AmplifierGoneError
        if outcome == LoopEnd.PATH_LATE:
            self.controller.faults.append(
                "the path was not sampled in time, so the stage was led down; free the machine"
            )
        if outcome == LoopEnd.KERNEL:
            self.controller.faults.append(f"the controller's own code failed with {self._state['status']}: 0 V")

    def _why_not_started(self, sent: int, refused: int) -> str:
        told = self.controller
        if refused and not sent:
            return told.complaint.removeprefix("; ")
        if told.exchange["blocked"][0]:
            return told.faults[-1]
        return told.failure
