"""The learnt correction that a run begins with, and to which runs it belongs."""

from pathlib import Path

from pkxyz_ctrl.config import files as config
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.learning import LearningConfig, timetable
from pkxyz_ctrl.learning.store import Belongs, Stored, belonging, load, require_same
from pkxyz_ctrl.trajectory import Trajectory


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
