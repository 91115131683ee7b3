"""One scenario run into one folder: lane, recording, figures, verdict, picture."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.lanes import either as lanes
from hil.recording.recording import RecordingWriter
from hil.runs.learning import Learning
from hil.runs.metrics import Metrics
from hil.runs.run_folder import RunFolder, metadata_of, summarise
from hil.runs.scenario import Scenario
from pkxyz_ctrl.config.files import ConfigError


def run_into(
    folder: RunFolder, scenario: Scenario, lane: str, on_progress: Callable[[int, int], None]
) -> dict[str, Any]:
    """Run ``scenario`` in ``lane`` and leave everything in ``folder``; returns the summary.

    Interrupted by the keyboard, it keeps what was recorded and says so in the summary. Raises ``ConfigError`` for a
    bus that the lane can't use, and it or ``RecordingError`` when the disk fails.
    """
    require_bus(scenario, lane)
    resolved = folder.write_config(scenario)
    metrics = Metrics(scenario.trajectory, scenario.bus.period_us)
    learning = Learning(scenario) if scenario.config.learning is not None else None
    result: lanes.LaneResult | None = None
    interrupted = False
    with RecordingWriter(folder.recording, metadata_of(scenario, lane, resolved)) as recording:

        def on_block(block: NDArray[np.void]) -> None:
            recording.write(block)
            metrics.update(block)
            if learning is not None:
                learning.errors.update(block)

        try:
            setup = scenario.setup()
            with folder.in_one_line():
                result = lanes.run(setup, lane, on_block=on_block, on_progress=on_progress, frame_log=folder.frames)
        except KeyboardInterrupt:
            interrupted = True
    figures = metrics.figures()
    if result is not None:
        figures |= {
            "missed_ticks": result.missed_ticks,
            "faults": list(result.faults),
            "bus_load": result.bus_load,
            "realtime_factor": result.realtime_factor,
        }
    if learning is not None:
        figures |= learning.close(folder, result.learner if result is not None else None, resolved["digest"])
    summary = summarise(scenario, lane, resolved["digest"], figures, interrupted=interrupted)
    folder.write_summary(summary)
    return summary


def require_bus(scenario: Scenario, lane: str) -> None:
    """Raise ``ConfigError`` if the lane needs frames and the bus config has none."""
    if lane == "lockstep" and scenario.bus.can is None:
        raise ConfigError(
            f"bus {scenario.bus.name!r} has no [can] and carries no frames, which the lockstep lane needs; "
            "use --lane fast or another --bus"
        )
    if lane != "lockstep" and (scenario.config.faults or scenario.config.clear_s is not None):
        raise ConfigError(f"the {lane} lane has no frames and nobody in whom something could fail; use --lane lockstep")


def draw(folder: RunFolder, summary: dict[str, Any]) -> None:
    """Draw the picture of a run that is already recorded; there is none of a run that never began."""
    if summary["ticks"] == 0:
        return
    from hil.pictures.report import draw_report  # matplotlib takes as long to import as a run takes

    with folder.in_one_line():
        draw_report(folder.recording, folder.frames, summary, folder.picture)
        if summary.get("learning_factor") is not None:
            from hil.pictures.learning import draw_learning

            draw_learning(folder.recording, summary, folder.learning_picture)
