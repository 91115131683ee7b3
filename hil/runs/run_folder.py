"""The folder that a run leaves: recording, frame log, configuration, summary and picture."""

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hil.lanes.lane import Lane
from hil.runs.scenario import LEARNT_FROM, Scenario, resolve, tables
from hil.runs.versions import versions
from pkxyz_ctrl.config.files import ConfigError, write_toml

RECORDING, FRAMES, CONFIG, SUMMARY, PICTURE = (
    "recording.parquet",
    "frames.log",
    "config.toml",
    "summary.json",
    "report.png",
)
LEARNT, LEARNING_PICTURE = "learnt.json", "learning.png"
_OURS = {
    RECORDING, FRAMES, CONFIG, SUMMARY, PICTURE, RECORDING + ".journal", RECORDING + ".part", LEARNT, LEARNT_FROM,
    LEARNING_PICTURE,
}  # fmt: skip
_TABLE = re.compile(r"reference\.\d+\.csv")


class RunFolder:
    """A folder of one run, made anew: an earlier run in it is replaced, anything else is left alone and refused.

    Tables of the reference are copied into it (``reference.3.csv``): they are inputs that a replay needs.
    """

    def __init__(self, path: Path) -> None:
        """Raises ``ConfigError`` if the folder can't be had or holds what is not a run."""
        self.path = path
        try:
            path.mkdir(parents=True, exist_ok=True)
            present = {item.name for item in path.iterdir()}
        except OSError as error:
            raise ConfigError(
                f"--out: {path}: {(error.strerror or str(error)).lower()}; give a folder that can be written"
            ) from None
        if {name for name in present - _OURS if not _TABLE.fullmatch(name)} or (present and CONFIG not in present):
            raise ConfigError(f"--out: {path}: holds files that are not a run's; give an empty or a new folder")
        try:
            for name in present:
                (path / name).unlink()
        except OSError as error:
            raise ConfigError(f"--out: {path}: {(error.strerror or str(error)).lower()}; give another folder") from None
        self.recording = path / RECORDING
        self.frames = path / FRAMES
        self.config = path / CONFIG
        self.summary = path / SUMMARY
        self.picture = path / PICTURE
        self.learnt = path / LEARNT
        self.learning_picture = path / LEARNING_PICTURE

    def write_config(self, scenario: Scenario) -> dict[str, Any]:
        """Write everything that decides about the run, and return it."""
        resolved = resolve(scenario)
        try:
            for name, table in tables(scenario).items():
                shutil.copyfile(table, self.path / name)
            write_toml(resolved, self.config)
        except OSError as error:
            raise ConfigError(f"{self.config}: {(error.strerror or str(error)).lower()}; give another --out") from None
        return resolved

    def write_summary(self, text: str) -> None:
        """Write ``Summary.as_text()``. Raises ``ConfigError``."""
        with self.in_one_line():
            self.summary.write_text(text, encoding="utf-8")

    @contextmanager
    def in_one_line(self) -> Iterator[None]:
        """Raise ``ConfigError`` for what the disk refuses inside, which says what is left."""
        try:
            yield
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            where = self.path / Path(error.filename).name if isinstance(error.filename, str) else self.path
            raise ConfigError(
                f"{where}: cannot be written: {reason}; what was recorded before is kept there and opens as ever; make "
                "room, or give another --out"
            ) from None


def next_free(runs: Path, scenario: str, lane: Lane) -> Path:
    """``runs/<scenario>-<lane>-<n>`` with the lowest n above those that exist."""
    stem = f"{scenario}-{lane}-"
    taken = [int(p.name[len(stem) :]) for p in runs.glob(f"{stem}*") if p.name[len(stem) :].isdigit()]
    return runs / f"{stem}{max(taken, default=0) + 1}"


def metadata_of(scenario: Scenario, lane: Lane, resolved: dict[str, Any]) -> dict[str, Any]:
    """What a recording carries with its rows."""
    return {
        "scenario": scenario.config.name,
        "lane": lane.value,
        "seed": scenario.config.seed,
        "digest": resolved["digest"],
        "period_us": scenario.bus.period_us,
        "segments": [
            {
                "kind": s.kind,
                "t_start_us": s.t_start_us,
                "t_end_us": s.t_end_us,
                "scan_us": s.scan_us,
                "still_us": s.still_us,
            }
            for s in scenario.trajectory.segments
        ],
        "versions": versions(),
        "config": resolved,
    }
