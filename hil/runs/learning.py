"""Learning in a run: the stored correction that it begins with, and the one that it leaves."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.runs.period_errors import PeriodErrors
from hil.runs.versions import versions
from pkxyz_ctrl.config import files as config
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.learning import Learner, LearningConfig, timetable
from pkxyz_ctrl.learning.store import Belongs, Stored, belonging, load, require_same, save
from pkxyz_ctrl.trajectory import Trajectory

if TYPE_CHECKING:
    from hil.runs.run_folder import RunFolder
    from hil.runs.scenario import Scenario


def belongs(trajectory: Trajectory, stage: StageConfig, controller: ControllerConfig, bus: BusConfig) -> Belongs:
    """What is learnt in a run belongs to. Raises ``LearningError`` for a trajectory that does not repeat."""
    parts = {"stage": stage, "controller": controller, "bus": bus}
    digests = {name: config.digest(config.plain(part)) for name, part in parts.items()}
    return belonging(trajectory, timetable(trajectory, bus.period_us), bus.period_us, digests)


def stored_for(learning: LearningConfig, file: Path | None, here: Belongs) -> Stored | None:
    """The correction that a run begins with. Raises ``LearningError`` for one that belongs to another run."""
    if learning.mode == "learn" or file is None:
        return None
    stored = load(file)
    require_same(stored, here, str(file))
    return stored


class Learning:
    """What a run with learning leaves besides its recording: errors by period, and ``learnt.json``."""

    def __init__(self, scenario: "Scenario") -> None:
        assert scenario.config.learning is not None
        self._scenario = scenario
        self._config = scenario.config.learning
        self.errors = PeriodErrors(scenario.trajectory, scenario.bus.period_us, self._config)

    def close(self, folder: "RunFolder", learner: Learner | None, digest: str) -> dict[str, Any]:
        """Store what was learnt, if anything was; returns figures for the summary. Raises ``LearningError``."""
        found = self.errors.figures()
        periods, steps = found.pop("periods"), [vars(step) for step in learner.steps] if learner is not None else []
        taught = learner is not None and any(step["share"] is not None for step in steps)
        said = {
            "mode": self._config.mode, "period_ticks": self.errors.table.period, "cutoff_hz": self._config.cutoff_hz,
            "periods": periods, "steps": steps, "stored": folder.learnt.name if taught else None,
        }  # fmt: skip
        if learner is not None and taught:
            s = self._scenario
            provenance = {
                "scenario": s.config.name, "digest": digest, "stage": s.stage.name, "plant": s.plant.name,
                "controller": s.controller.name, "bus": s.bus.name, "seed": s.config.seed,
                "windows": sum(step["share"] is not None for step in steps), "cutoff_hz": self._config.cutoff_hz,
                "sensed_nm": periods["sensed_nm"], "versions": versions(),
            }  # fmt: skip
            here = belongs(s.trajectory, s.stage, s.controller, s.bus)
            save(Stored(here, learner.correction, provenance), folder.learnt)
        return found | {"learning": said}
