"""What is known of a run when it is over: who ran, figures, verdicts on its checks."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from hil.lanes.lane import Lane
from hil.runs.metrics import RowFigures, Verdict, evaluate
from hil.runs.versions import versions

if TYPE_CHECKING:  # who draws a run loads none of it
    from hil.runs.period_errors import PeriodFigures
    from hil.runs.scenario import Scenario

_AT_RATE = (
    "refused_frames",
    "dropped_frames",
    "blocked_frames",
    "lost_rows",
    "stood_still_s",
    "lateness_us",
    "answer_us",
)


@dataclass(frozen=True)
class LoopFigures:
    """What the lane knows of a run besides its rows. ``None``: unknown in this lane, or the run did not get so far."""

    missed_ticks: int | None = None
    """skipped, without a sense frame, or with a drive frame that was late on the wire"""
    faults: tuple[str, ...] = ()
    """a sentence for each fault decision"""
    protections_lacking: tuple[str, ...] = ()
    """that this amplifier does not give, and what replaces each"""
    bus_load: float | None = None
    """0..1 over the ticks"""
    realtime_factor: float | None = None
    """stage time over the machine's time"""
    errors_are_of: str = "true position"
    """or of the "estimate", where nobody knows the truth"""
    refused_frames: int | None = None
    """frames that the adapter did not take; wall lane"""
    dropped_frames: int | None = None
    """frames that a bus among processes lost because a receiver stood still; wall lane"""
    blocked_frames: int | None = None
    """frames that our own gate held back; wall lane"""
    lost_rows: int | None = None
    """rows that the recording's writer was too slow for; wall lane"""
    stood_still_s: float | None = None
    """for how long time waited for the computer, as it does for a stage that is only simulated; wall lane"""
    lateness_us: Mapping[str, int] | None = None
    """of the wake-ups: p50, p99_9, max; wall lane"""
    answer_us: Mapping[str, int] | None = None
    """from a sense frame read to the drive frame handed over: p50, p99_9, max; wall lane"""


@dataclass(frozen=True)
class Learnt:
    """What learning has to say of a run."""

    figures: "PeriodFigures"
    mode: str
    period_ticks: int
    cutoff_hz: float
    steps: tuple[Mapping[str, Any], ...]
    """what was decided after each window"""
    stored: str | None
    """name of the file in the run's folder; None if nothing was taught"""


@dataclass(frozen=True)
class Summary:
    """One run. ``ok`` is false for a run that was interrupted or does not keep its checks.

    Without a check of its own, a fault that nobody asked for and a row that was lost are checks that fail.
    """

    scenario: str
    lane: Lane
    seed: int
    digest: str
    stage: str
    plant: str
    controller: str
    bus: str
    period_us: int
    duration_s: float
    interrupted: bool
    rows: RowFigures
    loop: LoopFigures
    learnt: Learnt | None
    checks: tuple[Verdict, ...]
    ok: bool
    versions: Mapping[str, str] = field(repr=False)

    @property
    def has_learnt(self) -> bool:
        """Whether there is more than one period to compare."""
        return self.learnt is not None and self.learnt.figures.learning_factor is not None

    def as_json(self) -> dict[str, Any]:
        """Plain data, the figures by name of ``METRICS`` at the top."""
        plain = dataclasses.asdict(self)
        rows, loop, learnt = plain.pop("rows"), plain.pop("loop"), plain.pop("learnt")
        wall = {key: loop.pop(key) for key in _AT_RATE}
        if self.lane is Lane.WALL:
            loop |= wall
        if learnt is not None:
            figures = learnt.pop("figures")
            periods = figures.pop("periods")
            plain |= figures | {"learning": learnt | {"periods": periods, "steps": list(learnt["steps"])}}
        loop |= {"faults": list(self.loop.faults), "protections_lacking": list(self.loop.protections_lacking)}
        return plain | rows | loop | {"checks": [verdict.as_json() for verdict in self.checks]}


def summarise(
    scenario: "Scenario", lane: Lane, digest: str, rows: RowFigures, loop: LoopFigures, learnt: Learnt | None = None,
    *, interrupted: bool,
) -> Summary:  # fmt: skip
    """Figures and the verdicts on the scenario's checks."""
    measured = dataclasses.asdict(rows) | dataclasses.asdict(loop)
    if learnt is not None:
        measured |= dataclasses.asdict(learnt.figures)
    checks = evaluate(scenario.config.checks, measured) + _untold(scenario, loop)
    return Summary(
        scenario.config.name, lane, scenario.config.seed, digest, scenario.stage.name, scenario.plant.name,
        scenario.controller.name, scenario.bus.name, scenario.bus.period_us, scenario.config.duration_s, interrupted,
        rows, loop, learnt, checks, not interrupted and all(check.ok is not False for check in checks), versions(),
    )  # fmt: skip


def _untold(scenario: "Scenario", loop: LoopFigures) -> tuple[Verdict, ...]:
    """What fails a run though the scenario says nothing of it."""
    config = scenario.config
    found: dict[str, int | None] = {"lost_rows": loop.lost_rows}
    if not config.faults and config.clear_s is None:
        found["faults"] = len(loop.faults)
    return tuple(
        Verdict(name, value, None, 0.0, False) for name, value in found.items() if value and name not in config.checks
    )
