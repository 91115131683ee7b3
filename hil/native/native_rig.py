"""One run of a native loop: what it is given ahead, and what becomes of it. As ``WallRig`` for Python's."""

from collections.abc import Callable
from pathlib import Path

from hil.lanes.ending import Ending
from hil.lanes.setup import Setup
from hil.native.loop_process import LoopProcess
from hil.native.mapped import Mapped, text_of
from hil.native.path_feeder import PathFeeder
from hil.native.ring_recorder import RingRecorder
from hil.native.teller import Teller
from pkxyz_ctrl.config.bus import CanConfig
from pkxyz_ctrl.export.shared import Phase
from pkxyz_ctrl.learning import Learner


class NativeRig:
    """``close`` ends it, and then everything is known of it."""

    learner: Learner | None = None
    """What it learns stands in its law."""

    def __init__(
        self, program: Path, setup: Setup, can: CanConfig, mapped: Mapped, recorder: RingRecorder, ending: Ending
    ) -> None:
        self.controller = Teller(setup)
        self._feeder = PathFeeder(setup, mapped.blocks)
        self._process = LoopProcess(program, setup, can, mapped, self.controller, recorder.held, ending)
        self._state, self._is_among_processes = self._process.state, can.interface == "pkxyz-unix"

    @property
    def refused_frames(self) -> int:
        return int(self._state["port"]["refused"][0])

    @property
    def dropped_frames(self) -> int | None:
        return int(self._state["port"]["dropped"][0]) if self._is_among_processes else None

    @property
    def lateness_us(self) -> list[int]:
        lateness: list[int] = self._state["lateness"].tolist()
        return lateness

    @property
    def answer_us(self) -> list[int]:
        answers: list[int] = self._state["answers"].tolist()
        return answers

    @property
    def stood_us(self) -> int:
        return int(self._state["stood_us"])

    @property
    def complaint(self) -> str:
        return self.controller.complaint

    @property
    def is_amplifier_a_process(self) -> bool:
        return self._is_among_processes

    def wait_for_others(self, say: Callable[[str], object], company_s: float) -> None:
        """Begin the loop, and wait until it has a bus and company. Raises ``Ended`` and ``ConfigError``."""
        self._process.begin(say, company_s, self._feed)

    def go_real_time(self) -> str:
        """What the system gave the loop, in a line."""
        return text_of(self._state["real_time"])

    def start(self, say: Callable[[str], object]) -> None:
        """Until the amplifier is started; ``say`` is told which protections are lacking. Raises ``StartUpError``."""
        self._process.start(say, self._feed)

    def run(self) -> None:
        """Until the loop has ended. Raises ``AmplifierGoneError`` and ``Ended``."""
        self._process.until(Phase.ENDED, self._feed)
        self._process.raise_outcome()

    def close(self) -> None:
        """Let the loop end, by force if it doesn't; the node then takes the combs to 0 V by itself."""
        self._process.close()

    def _feed(self) -> None:
        self._feeder.feed(int(self._state["reference_tick"]))
