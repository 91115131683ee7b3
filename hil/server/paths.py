"""Paths for the loop: planned and checked away from it, and streamed to it while it follows them."""

import math
import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter

from hil.operate.commands import PATH_ROWS
from hil.operate.reach import Reach
from hil.operate.sample_axes import Turn
from hil.runs.scenario import load_scenario
from hil.server.link import Link
from pkxyz_ctrl.config.bus import BusConfig
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import ConfigError, FrozenModel, load, parse
from pkxyz_ctrl.config.stage import StageConfig
from pkxyz_ctrl.stage import Stage
from pkxyz_ctrl.trajectory import Move, Segment, Trajectory, TrajectoryError
from pkxyz_ctrl.trajectory.check import DriveLimits, check_against
from pkxyz_ctrl.trajectory.table import Table, in_folder

Array = NDArray[np.float64]

_AHEAD_ROWS = 5000
_BLOCKS_AT_ONCE = 16
_LEADING = ("hold", "move")
_MIDDLE_M = (0.0, 0.0, 18e-6)


class _Segments(FrozenModel):
    reference: Annotated[tuple[Segment, ...], Field(min_length=1, max_length=1000)]


class _OfSample(Trajectory):
    """A trajectory in the sample's coordinates, sampled in the stage's."""

    def __init__(self, segments: Sequence[Segment], turn: Turn, pixels: int, start_m: Array) -> None:
        super().__init__(segments, pixels, start_m)
        self.turn = turn

    def sample(self, first_tick: int, count: int, period_us: int) -> Array:
        rows = super().sample(first_tick, count, period_us)
        if self.turn.is_plain:
            return rows
        turned = [self.turn.to_stage(rows[:, 0:3]), *(self.turn.way_to_stage(rows[:, n : n + 3]) for n in (3, 6))]
        return np.concatenate(turned, axis=1)


@dataclass(frozen=True)
class StagePath:
    """A path that the stage can follow."""

    trajectory: _OfSample
    period_us: int
    rows: int
    name: str

    @property
    def start_m(self) -> Array:
        """(3,) of the stage, where it begins at rest."""
        return self.sample(0, 1)[0, 0:3]

    @property
    def end_m(self) -> Array:
        """(3,) of the stage, where it comes to rest."""
        return self.sample(self.rows - 1, 1)[0, 0:3]

    @property
    def duration_s(self) -> float:
        """At its own speed."""
        return self.rows * self.period_us * 1e-6

    def sample(self, first: int, count: int) -> Array:
        """Rows (count, 9)."""
        return self.trajectory.sample(first, count, self.period_us)

    def outputs(self, first: int, count: int) -> NDArray[np.int64]:
        """Trigger bits (count,) of rows."""
        return self.trajectory.outputs(first, count, self.period_us)

    @property
    def lines(self) -> list[tuple[int, int, int]]:
        """Of each line of a raster its first and last row, and the number of its frame."""
        rows = self.trajectory.line_rows(self.period_us)
        return [(int(first), int(last), int(frame)) for first, last, frame in rows]

    @property
    def backward(self) -> list[bool]:
        """Of each line, whether it goes the other way than the first."""
        ways = [(self.sample(last, 1) - self.sample(first, 1))[0, 0:3] for first, last, _ in self.lines]
        return [bool(way @ ways[0] < 0.0) for way in ways]


class Planner:
    """For one stage, controller and bus, by name or file. Raises ``ConfigError``."""

    def __init__(self, stage: str, controller: str, bus: str) -> None:
        self.files = {"stage": stage, "bus": bus}
        config = load("stages", stage, StageConfig)
        law = load("controllers", controller, ControllerConfig)
        on_bus = load("buses", bus, BusConfig)
        self.period_us = on_bus.period_us
        self.stage = Stage(config)
        self._drive = DriveLimits.of(law, on_bus)
        self.parameters = {
            name: model.model_dump(mode="json")
            for name, model in (("controller", law), ("stage", config), ("bus", on_bus))
        }
        """what the files say, for people"""
        self._reach = Reach(self.stage, self._drive)
        self._ranges: tuple[list[float], list[list[float | None]]] = ([], [])

    @property
    def turn(self) -> Turn:
        """The sample's coordinates, in which all that is asked here is meant."""
        return self._reach.turn

    @turn.setter
    def turn(self, turn: Turn) -> None:
        self._reach.turn, self._ranges = turn, ([], [])

    def body(self, position_m: Array) -> dict[str, Any]:
        """What the combs hold: outlines in the sample's three planes through a position of the stage, or through the
        middle above rest, and the whole as points (rings, around, 3) of its surface.
        """
        reach, turn = self._reach, self.turn
        inside = position_m if reach.holds(position_m) and position_m[2] > 0 else np.array(_MIDDLE_M)
        outlines: dict[str, Any] = {
            f"{'xyz'[a]}{'xyz'[b]}": turn.to_sample(reach.outline(inside, a, b))[:, [a, b]].tolist()
            for a, b in ((0, 1), (0, 2), (1, 2))
        }
        return outlines | {"surface_m": np.round(turn.to_sample(reach.surface(np.array(_MIDDLE_M))), 10).tolist()}

    def ranges(self, target_m: Array) -> list[list[float | None]]:
        """Least and greatest target of each axis that the combs can hold with the others at theirs, in m of the sample;
        ``target_m`` (3,) is of the stage. Looked for when the target is another.
        """
        if self._ranges[0] != target_m.tolist():
            found = [self._reach.range_along(target_m.copy(), axis) for axis in range(3)]
            ranges: list[list[float | None]] = [
                [None, None] if low_high is None else list(low_high) for low_high in found
            ]
            self._ranges = (target_m.tolist(), ranges)
        return self._ranges[1]

    def of_scenario(self, name: str, pixels: int = 0) -> StagePath:
        """The reference of a shipped scenario, with so many pixels on each line: names only, as a client can't be let
        into our files. If no move leads to it, it begins at the origin.
        """
        if "/" in name or "\\" in name or "." in name:
            raise ConfigError(f"{name!r}: the name of a shipped scenario is wanted; a file of yours is sent as a table")
        scenario = load_scenario(name)
        return self._path(in_folder(scenario.config.reference, scenario.source.parent), name, pixels)

    def of_segments(self, segments: Any, pixels: int = 0, stands_m: Array | None = None) -> StagePath:
        """Segments as in the ``[[reference]]`` of a scenario file. If no move leads to it, the path begins at
        ``stands_m`` (3,) of the stage, at the sample's origin if not given.
        """
        parsed = parse({"reference": segments}, _Segments, "the path")
        if any(isinstance(segment, Table) for segment in parsed.reference):
            raise ConfigError("the path: a table is sent by itself, not by the name of a file")
        return self._path(parsed.reference, "scan", pixels, stands_m)

    def of_table(self, text: str, limits: dict[str, float], stands_m: Array | None = None) -> StagePath:
        """A table of positions at instants, as the text of a CSV file. The path begins as one of segments does."""
        with tempfile.TemporaryDirectory(prefix="pkxyz-") as folder:
            file = Path(folder) / "table.csv"
            file.write_text(text, encoding="utf-8")
            table = TypeAdapter(Table).validate_python({"kind": "csv", "file": str(file)} | limits)
            try:
                return self._path([table], "table", stands_m=stands_m)
            except ConfigError as error:
                raise ConfigError(str(error).replace(str(file), "the table")) from None

    def _path(
        self, segments: Sequence[Segment], name: str, pixels: int = 0, stands_m: Array | None = None
    ) -> StagePath:
        turn = self.turn
        led, start_m = _led(segments, np.zeros(3) if stands_m is None else turn.to_sample(stands_m))
        whose = ""
        try:
            trajectory = _OfSample(segments[led:], turn, pixels, start_m)
            whose = "" if turn.is_plain else "; places are in the stage's coordinates, not in the sample's"
            check_against(self.stage, trajectory, self._drive)
        except TrajectoryError as error:
            raise TrajectoryError(_as_sent(str(error), led) + whose) from None
        if any(segment.jumps_us for segment in trajectory.segments):
            raise ConfigError(
                f"{name}: jumps on purpose, which a stage in operation does not; use `pkxyz run` for that"
            )
        rows = math.ceil(trajectory.duration_us / self.period_us) + 1
        return StagePath(trajectory, self.period_us, rows, name)


def _led(segments: Sequence[Segment], start_m: Array) -> tuple[int, Array]:
    """How many segments only lead to a path, as the stage goes there by itself, and where (3,) they lead."""
    led = next((n for n, segment in enumerate(segments) if segment.kind not in _LEADING), 0)
    moves = [segment for segment in segments[:led] if isinstance(segment, Move)]
    return led, np.array(moves[-1].to_m) if moves else start_m


def _as_sent(words: str, led: int) -> str:
    """A refusal, with the number of the segment as it was sent."""
    return re.sub(r"^reference\.(\d+)", lambda found: f"reference.{int(found[1]) + led}", words)


class Feeding:
    """A path on its way to the loop."""

    def __init__(self, link: Link, number: int, path: StagePath) -> None:
        self.number, self.path = number, path
        self._link, self._sent = link, 0

    def go_on(self) -> bool:
        """Send some of what the loop may want next; whether there is more to send."""
        newest = self._link.newest()
        at = float(newest["session"]["path_row"]) if newest is not None else 0.0
        at = 0.0 if math.isnan(at) else at
        for _ in range(_BLOCKS_AT_ONCE):
            if self._sent >= self.path.rows or self._sent > at + _AHEAD_ROWS:
                break
            count = min(PATH_ROWS, self.path.rows - self._sent)
            path, first = self.path, self._sent
            self._link.rows(self.number, first, path.sample(first, count), path.outputs(first, count))
            self._sent += count
        return self._sent < self.path.rows
