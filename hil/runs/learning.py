"""What a run that learns leaves: how its error fell from period to period, and the correction that came of it."""

from pathlib import Path

from hil.runs.correction import belongs
from hil.runs.period_errors import PeriodErrors
from hil.runs.scenario import Scenario
from hil.runs.summary import Learnt
from hil.runs.versions import versions
from pkxyz_ctrl.learning import Learner
from pkxyz_ctrl.learning.store import Stored, save


class Learning:
    """What a run with learning leaves besides its recording: errors by period, and ``learnt.json``."""

    def __init__(self, scenario: Scenario) -> None:
        assert scenario.config.learning is not None
        self._scenario = scenario
        self._config = scenario.config.learning
        self.errors = PeriodErrors(scenario.trajectory, scenario.bus.period_us, self._config)

    def close(self, file: Path | None, learner: Learner | None, digest: str) -> Learnt:
        """Store what was learnt in ``file``, if anything was. ``learner``:
        None if the run did not get so far. Raises ``LearningError``.
        """
        found = self.errors.figures()
        steps = tuple(vars(step) for step in learner.steps) if learner is not None else ()
        taught = any(step["share"] is not None for step in steps)
        if learner is not None and taught and file is not None:
            s = self._scenario
            provenance = {
                "scenario": s.config.name, "digest": digest, "stage": s.stage.name, "plant": s.plant.name,
                "controller": s.controller.name, "bus": s.bus.name, "seed": s.config.seed,
                "windows": sum(step["share"] is not None for step in steps), "cutoff_hz": self._config.cutoff_hz,
                "sensed_nm": found.periods["sensed_nm"], "versions": versions(),
            }  # fmt: skip
            here = belongs(s.trajectory, s.stage, s.controller, s.bus)
            save(Stored(here, learner.correction, provenance), file)
        stored = file.name if taught and file is not None else None
        return Learnt(found, self._config.mode, self.errors.table.period, self._config.cutoff_hz, steps, stored)
