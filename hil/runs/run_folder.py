"""The folder that a run leaves: recording, frame log, configuration, summary and picture."""

import errno
import fcntl
import glob
import itertools
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hil.lanes.lane import Lane
from hil.recording.recording import Recording, RecordingError
from hil.runs.scenario import LEARNT_FROM, Scenario, resolve, tables
from hil.runs.seal import sealed
from hil.runs.versions import versions
from pkxyz_ctrl.config.files import ConfigError, digest, read_toml, write_toml
from pkxyz_ctrl.config.refused import reason

RECORDING, FRAMES, CONFIG, SUMMARY, PICTURE = (
    "recording.parquet",
    "frames.log",
    "config.toml",
    "summary.json",
    "report.png",
)
LEARNT, LEARNING_PICTURE = "learnt.json", "learning.png"
ADAPTED = "adapted.json"
_UNFINISHED = CONFIG + ".part"
_OURS = {
    RECORDING, FRAMES, CONFIG, SUMMARY, PICTURE, RECORDING + ".journal", RECORDING + ".part", LEARNT, LEARNT_FROM,
    LEARNING_PICTURE, ADAPTED, _UNFINISHED,
}  # fmt: skip
_SEALED = {RECORDING, FRAMES, CONFIG, LEARNT, LEARNT_FROM, ADAPTED}
_TABLE = re.compile(r"reference\.\d+\.csv")
_EARLIER = ".earlier"
"""Folder inside, where an earlier run waits until the new one has recorded something."""


class RunFolder:
    """A folder of one run. Anything but a run is left alone and refused; so is an earlier run, unless it may be
    replaced, and then it is there until the new one has recorded a tick.

    Tables of the reference are copied into it (``reference.3.csv``): they are inputs that a replay needs.
    """

    def __init__(self, path: Path, *, replace: bool = False) -> None:
        """Only looks. Raises ``ConfigError`` if the folder can't be had, or holds what is not to be replaced."""
        self.path = path
        self.recording = path / RECORDING
        self.frames = path / FRAMES
        self.config = path / CONFIG
        self.summary = path / SUMMARY
        self.picture = path / PICTURE
        self.learnt = path / LEARNT
        self.adapted = path / ADAPTED
        self.learning_picture = path / LEARNING_PICTURE
        self._earlier = path / _EARLIER
        self._replace = replace
        try:
            path.mkdir(parents=True, exist_ok=True)
            self._look()
        except OSError as error:
            raise ConfigError(f"--out: {path}: {reason(error)}; give a folder that can be written") from None
        if not os.access(path, os.W_OK):
            raise ConfigError(f"--out: {path}: permission denied; give a folder that can be written")

    @contextmanager
    def taken(self) -> Iterator[None]:
        """Hold the folder for one run: no other process may write to it meanwhile, nor one that this one leaves behind.

        An earlier run comes back if this one ends before it has recorded a tick. Raises ``ConfigError``.
        """
        held = self._lock()
        try:
            with self.in_one_line():
                self._settle()  # what a process that was killed has left undone
                self._look()
                self._set_aside()
            try:
                yield
            finally:
                self._settle()
        finally:
            os.close(held)

    def write_config(self, scenario: Scenario) -> dict[str, Any]:
        """Write everything that decides about the run, and return it."""
        resolved = resolve(scenario)
        try:
            for name, table in tables(scenario).items():
                shutil.copyfile(self._where_it_is(table), self.path / name)
            write_toml(resolved, self.path / _UNFINISHED)
            (self.path / _UNFINISHED).replace(self.config)
        except OSError as error:
            raise ConfigError(f"{self.config}: {reason(error)}; give another --out") from None
        return resolved

    def write_summary(self, summary: dict[str, Any]) -> None:
        """Write ``Summary.as_json()`` with the digests of what is here now. Raises ``ConfigError``."""
        with self.in_one_line():
            names = {name for name in self._present() if name in _SEALED or _TABLE.fullmatch(name)}
            self.summary.write_text(sealed(summary, self.path, names), encoding="utf-8")

    @contextmanager
    def in_one_line(self) -> Iterator[None]:
        """Raise ``ConfigError`` for what the disk refuses inside, which says what is left."""
        try:
            yield
        except OSError as error:
            where = self.path / Path(error.filename).name if isinstance(error.filename, str) else self.path
            raise ConfigError(
                f"{where}: cannot be written: {reason(error)}; what was recorded before is kept there and opens as "
                "ever; make room, or give another --out"
            ) from None

    def _look(self) -> None:
        """Raise ``ConfigError`` for what is not a run, and for a run that may not be replaced."""
        present = self._present()
        foreign = sorted(name for name in present if name not in _OURS and not _TABLE.fullmatch(name))
        if foreign or (CONFIG in present and not _is_of_a_run(self.config)):
            name = foreign[0] if foreign else CONFIG
            raise ConfigError(
                f"--out: {self.path}: holds files that are not a run's ({name}); give an empty or a new folder"
            )
        if present - {_UNFINISHED} and CONFIG not in present and not self._earlier.is_dir():
            raise ConfigError(f"--out: {self.path}: holds parts of a run without its {CONFIG}; give a new folder")
        holds = self._earlier.is_dir() or (CONFIG in present and not self._is_empty(present))
        if holds and not self._replace:
            raise ConfigError(
                f"--out: {self.path}: holds an earlier run; give another folder, or --replace to have it replaced"
            )

    def _present(self) -> set[str]:
        return {item.name for item in self.path.iterdir()} - {_EARLIER}

    def _lock(self) -> int:
        """Of the folder itself, so that nothing has to be tidied up: it goes with the last process that holds it."""
        try:
            held = os.open(self.path, os.O_RDONLY)
        except OSError as error:
            raise ConfigError(f"--out: {self.path}: {reason(error)}") from None
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
                os.close(held)
                raise ConfigError(
                    f"--out: {self.path}: another run is being written there; give another folder, or wait for it"
                ) from None
        return held  # a file system without locks has none

    def _set_aside(self) -> None:
        if present := self._present():
            self._earlier.mkdir()
            for name in sorted(present, key=lambda name: name == CONFIG):  # last: until then it is a run that is here
                (self.path / name).rename(self._earlier / name)

    def _settle(self) -> None:
        """The new run stays if it has recorded anything; else the earlier one comes back.

        The configuration is what tells how far a process that was killed had come: it is the last to be set aside, the
        first to come back and the last to go.
        """
        if not self._earlier.is_dir():
            return
        waiting = sorted((item.name for item in self._earlier.iterdir()), key=lambda name: name != CONFIG)
        if CONFIG in waiting and self._has_recorded():
            for name in reversed(waiting):
                (self._earlier / name).unlink()
            waiting = []
        elif CONFIG in waiting:
            for name in self._present():
                (self.path / name).unlink()
        for name in waiting:
            (self._earlier / name).rename(self.path / name)
        self._earlier.rmdir()

    def _has_recorded(self) -> bool:
        try:
            return Recording.open(self.recording).ticks > 0
        except RecordingError:
            return False

    def _is_empty(self, present: set[str]) -> bool:
        """Whether the run here never recorded a tick; one that can't be read may have."""
        try:
            return Recording.open(self.recording).ticks == 0
        except RecordingError:
            return not present & {RECORDING, RECORDING + ".journal"}

    def _where_it_is(self, table: Path) -> Path:
        """A table of the run that is being replaced by its own configuration has been set aside with it."""
        aside = self._earlier / table.name
        return aside if table.parent.resolve() == self.path.resolve() and aside.is_file() else table


def _is_of_a_run(path: Path) -> bool:
    """Whether a configuration carries its own digest, as every one that was written here does."""
    try:
        data = read_toml(path)
    except ConfigError:
        return False
    told = data.pop("digest", None)
    return told is not None and told == digest(data)


def next_free(runs: Path, scenario: str, lane: Lane) -> Path:
    """``runs/<scenario>-<lane>-<n>``, made here, with the lowest n above those that exist."""
    stem = f"{scenario}-{lane}-"
    taken = [int(p.name[len(stem) :]) for p in runs.glob(f"{glob.escape(stem)}*") if p.name[len(stem) :].isdigit()]
    for n in itertools.count(max(taken, default=0) + 1):
        try:
            (runs / f"{stem}{n}").mkdir(parents=True)
        except FileExistsError:  # another process was quicker
            continue
        except OSError as error:
            raise ConfigError(f"--out: {runs}: {reason(error)}; give a folder") from None
        return runs / f"{stem}{n}"
    raise AssertionError("numbers have no end")


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
