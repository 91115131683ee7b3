"""One scenario run at the machine's clock into one folder."""

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.lanes.ending import Ended, Ending
from hil.lanes.lane import Lane
from hil.lanes.setup import Setup
from hil.lanes.wall import COMPANY_S, AmplifierGoneError, WallRig, require_real_bus
from hil.native.mapped import Mapped
from hil.native.native_rig import NativeRig
from hil.native.ring_recorder import RingRecorder
from hil.recording.recording import Recording
from hil.recording.wall_recorder import WallRecorder
from hil.recording.writer_process import Watch
from hil.runs.metrics import Metrics, RowFigures
from hil.runs.run import Begun
from hil.runs.run_folder import RunFolder
from hil.runs.scenario import Scenario
from hil.runs.summary import LoopFigures, Summary
from pkxyz_ctrl.config.bus import CanConfig
from pkxyz_ctrl.io.clocks import percentile_us
from pkxyz_ctrl.learning import Learner

_Files = tuple[Path, Path, dict[str, Any], str, Watch]
_COME_BACK = {
    False: "start `pkxyz plant` again, then this",
    True: "check its power and the cable, then start this again",
}
_SHARES = {"p50": 0.5, "p99_9": 0.999, "max": 1.0}


@dataclass(frozen=True)
class RanAtRate:
    """What a run at rate leaves besides its folder."""

    summary: Summary
    ended_by: int
    """signal that ended it, 0 if it ran to its end"""
    lateness_us: list[int]
    """wake-ups by whole microseconds of lateness"""
    answer_us: list[int]
    """answers to a sense frame by whole microseconds"""


@dataclass
class _Watched:
    """What is known of the loop when it has ended, however it did."""

    ended_by: int = 0
    elapsed_s: float = 0.0
    faults: tuple[str, ...] = ()
    protections_lacking: tuple[str, ...] = ()
    lateness_us: list[int] = dataclasses.field(default_factory=list)
    answer_us: list[int] = dataclasses.field(default_factory=list)
    missed_ticks: int = 0
    refused_frames: int = 0
    dropped_frames: int | None = None
    blocked_frames: int = 0
    stood_us: int = 0
    learner: Learner | None = None
    adaptation: NDArray[np.void] | None = None


def run_into(
    folder: RunFolder,
    scenario: Scenario,
    say: Callable[[str], object],
    watch: Watch = lambda row: None,
    company_s: float = COMPANY_S,
    program: Path | None = None,
) -> RanAtRate:
    """Run ``scenario`` at rate and leave everything in ``folder`` but the picture; by Python's loop, or by the native
    one that is compiled in ``program``.

    ``say`` is called with what a person should know, ``watch`` with each row, in the writer's process; an empty bus is
    given ``company_s`` until somebody else is on it. Raises ``ConfigError``, ``StartUpError``, ``RecordingError``.
    """
    can_config = require_real_bus(scenario.bus)
    with folder.taken():
        return _run_into(folder, scenario, can_config, say, watch, company_s, program)


def _run_into(
    folder: RunFolder,
    scenario: Scenario,
    can_config: CanConfig,
    say: Callable[[str], object],
    watch: Watch,
    company_s: float,
    program: Path | None,
) -> RanAtRate:
    begun = Begun.begin(folder, scenario, Lane.WALL)
    setup = scenario.setup()
    watched = _Watched()
    with Ending() as ending:
        files = folder.recording, folder.frames, begun.metadata, can_config.channel, watch
        recorder, rig_of = _loop_of(program, setup, can_config, ending, files)
        try:
            _run(rig_of(), watched, say, company_s)
        except Ended as end:
            watched.ended_by = end.signal_number
        finally:
            recorder.close()
    recording = Recording.open(folder.recording)
    if begun.learning is not None:
        begun.learning.errors.look_at(recording)
    rows = _figures(recording, begun.metrics)
    late, answers, period_s = watched.lateness_us, watched.answer_us, scenario.bus.period_s
    loop = LoopFigures(
        missed_ticks=watched.missed_ticks,
        faults=watched.faults,
        protections_lacking=watched.protections_lacking,
        realtime_factor=recording.ticks * period_s / watched.elapsed_s if watched.elapsed_s else None,
        errors_are_of="estimate",
        refused_frames=watched.refused_frames,
        dropped_frames=watched.dropped_frames,
        blocked_frames=watched.blocked_frames,
        lost_rows=recorder.lost_rows,
        stood_still_s=watched.stood_us * 1e-6,
        lateness_us={name: percentile_us(late, share) for name, share in _SHARES.items()},
        answer_us={name: percentile_us(answers, share) for name, share in _SHARES.items()},
    )
    summary = begun.end(rows, loop, watched.learner, watched.adaptation, interrupted=bool(watched.ended_by))
    return RanAtRate(summary, watched.ended_by, late, answers)


def _loop_of(
    program: Path | None, setup: Setup, can_config: CanConfig, ending: Ending, files: _Files
) -> tuple[WallRecorder | RingRecorder, Callable[[], WallRig | NativeRig]]:
    """A recorder, which has to be there first, and how its loop is made."""
    if program is None:
        recorder = WallRecorder(*files)
        return recorder, lambda: WallRig(setup, recorder, ending)
    mapped = Mapped()
    ring = RingRecorder(mapped, *files)
    return ring, lambda: NativeRig(program, setup, can_config, mapped, ring, ending)


def _run(rig: WallRig | NativeRig, watched: _Watched, say: Callable[[str], object], company_s: float) -> None:
    begin_s = time.monotonic()
    try:
        rig.wait_for_others(say, company_s)
        say(rig.go_real_time())
        begin_s = time.monotonic()
        rig.start(say)
        rig.run()
    except AmplifierGoneError:
        hint = rig.complaint or f": {_COME_BACK[not rig.is_amplifier_a_process]}"
        say(f"the amplifier has fallen silent, so the run ends{hint}")
    finally:
        try:
            rig.close()
        finally:
            watched.elapsed_s = time.monotonic() - begin_s
            watched.faults = tuple(rig.controller.faults)
            watched.protections_lacking = rig.controller.driver.lost
            watched.lateness_us = rig.lateness_us
            watched.answer_us = rig.answer_us
            watched.missed_ticks = rig.controller.missed_ticks
            watched.refused_frames = rig.refused_frames
            watched.dropped_frames = rig.dropped_frames
            watched.blocked_frames = rig.controller.gate.blocked_frames
            watched.stood_us = rig.stood_us
            watched.adaptation = rig.controller.memory["tick"]["adaptation"].copy()
            watched.learner = rig.learner


def _figures(recording: Recording, metrics: Metrics) -> RowFigures:
    """Figures of the recorded rows. Nobody here knows the truth, so errors are those of the estimate."""
    fields = ("mode", "reference_tick", "saturated", "reference_m", "estimate_m")
    for rows in recording.rows(fields):
        rows["position_m"] = rows["estimate_m"]
        metrics.update(rows)
    return dataclasses.replace(metrics.figures(), estimate_error_nm=None)
