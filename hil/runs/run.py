"""One scenario run into one folder, whatever the lane: configuration, rows, figures, verdict."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.lanes import in_process as lanes
from hil.lanes.lane import Lane
from hil.recording.recording import RecordingWriter
from hil.runs.adapted import save
from hil.runs.learning import Learning
from hil.runs.metrics import Metrics, RowFigures
from hil.runs.run_folder import RunFolder, metadata_of
from hil.runs.scenario import Scenario, resolve
from hil.runs.summary import LoopFigures, Summary, summarise
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.learning import Learner


@dataclass(frozen=True)
class Begun:
    """A run whose configuration is written and whose rows can come: what every lane begins and ends with."""

    folder: RunFolder | None
    """None: nothing is written"""
    scenario: Scenario
    lane: Lane
    resolved: dict[str, Any]
    metrics: Metrics
    learning: Learning | None

    @classmethod
    def begin(cls, folder: RunFolder | None, scenario: Scenario, lane: Lane) -> "Begun":
        """Write the configuration. Raises ``ConfigError``."""
        resolved = folder.write_config(scenario) if folder is not None else resolve(scenario)
        learning = Learning(scenario) if scenario.config.learning is not None else None
        metrics = Metrics(scenario.trajectory, scenario.bus.period_us)
        return cls(folder, scenario, lane, resolved, metrics, learning)

    @property
    def metadata(self) -> dict[str, Any]:
        """What the recording carries with its rows."""
        return metadata_of(self.scenario, self.lane, self.resolved)

    def end(
        self, rows: RowFigures, loop: LoopFigures, learner: Learner | None = None,
        adaptation: NDArray[np.void] | None = None, *, interrupted: bool,
    ) -> Summary:  # fmt: skip
        """Store what was learnt and write the summary. Raises ``ConfigError`` and ``LearningError``."""
        if adaptation is not None and self.folder is not None:
            s = self.scenario
            origin = {"scenario": s.config.name, "digest": self.resolved["digest"], "plant": s.plant.name}
            save(self.folder.adapted, adaptation, s.stage, s.controller, origin | {"seed": s.config.seed})
        digest = self.resolved["digest"]
        file = self.folder.learnt if self.folder is not None else None
        learnt = self.learning.close(file, learner, digest) if self.learning is not None else None
        summary = summarise(self.scenario, self.lane, digest, rows, loop, learnt, interrupted=interrupted)
        if self.folder is not None:
            self.folder.write_summary(summary.as_json())
        return summary

    def take(self, block: NDArray[np.void]) -> None:
        """Take in rows (n,) of ``ROW``."""
        self.metrics.update(block)
        if self.learning is not None:
            self.learning.errors.update(block)


def run_into(
    folder: RunFolder,
    scenario: Scenario,
    lane: Lane,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
    run: Callable[..., lanes.LaneResult] = lanes.run,
) -> Summary:
    """Run ``scenario`` in lockstep or in the fast lane, or in another one by its own ``run``, and leave everything in
    ``folder`` but the picture.

    Interrupted by the keyboard, it keeps what was recorded and says so in the summary. Raises ``ConfigError`` for a
    bus that the lane can't use, and it or ``RecordingError`` when the disk fails.
    """
    require_bus(scenario, lane)
    with folder.taken():
        return _run_into(folder, scenario, lane, on_progress, run)


def _run_into(
    folder: RunFolder, scenario: Scenario, lane: Lane, on_progress: Callable[[int, int], None],
    run: Callable[..., lanes.LaneResult],
) -> Summary:  # fmt: skip
    begun = Begun.begin(folder, scenario, lane)
    result: lanes.LaneResult | None = None
    with RecordingWriter(folder.recording, begun.metadata) as recording:

        def on_block(block: NDArray[np.void]) -> None:
            recording.write(block)
            begun.take(block)

        try:
            setup = scenario.setup()
            with folder.in_one_line():
                result = run(setup, lane, on_block=on_block, on_progress=on_progress, frame_log=folder.frames)
        except KeyboardInterrupt:
            pass
    rows = begun.metrics.figures()
    if result is None:
        return begun.end(rows, LoopFigures(), interrupted=True)
    return begun.end(rows, _figures_of(result), result.learner, result.adaptation, interrupted=False)


def run_in_memory(
    scenario: Scenario, lane: Lane, on_progress: Callable[[int, int], None] = lambda done, total: None
) -> tuple[Summary, NDArray[np.void]]:
    """Run ``scenario`` in lockstep or in the fast lane; returns its summary and all rows (n,) of ``ROW``, and writes
    nothing. Raises ``ConfigError`` for a bus that the lane can't use.
    """
    require_bus(scenario, lane)
    begun = Begun.begin(None, scenario, lane)
    blocks: list[NDArray[np.void]] = []

    def on_block(block: NDArray[np.void]) -> None:
        blocks.append(block.copy())
        begun.take(block)

    result = lanes.run(scenario.setup(), lane, on_block=on_block, on_progress=on_progress)
    summary = begun.end(begun.metrics.figures(), _figures_of(result), result.learner, interrupted=False)
    return summary, np.concatenate(blocks)


def _figures_of(result: lanes.LaneResult) -> LoopFigures:
    lost = result.protections_lacking
    return LoopFigures(result.missed_ticks, result.faults, lost, result.bus_load, result.realtime_factor)


def require_bus(scenario: Scenario, lane: Lane) -> None:
    """Raise ``ConfigError`` if the lane needs frames and the bus config has none."""
    has_frames = lane in (Lane.LOCKSTEP, Lane.EMULATED)
    if has_frames and scenario.bus.can is None:
        instead = "use --lane fast or another --bus" if lane == Lane.LOCKSTEP else "use another --bus"
        raise ConfigError(
            f"bus {scenario.bus.name!r} has no [can] and carries no frames, which the {lane} lane needs; {instead}"
        )
    if not has_frames and (scenario.config.faults or scenario.config.clear_s is not None):
        raise ConfigError(f"the {lane} lane has no frames and nobody in whom something could fail; use --lane lockstep")
