"""Run a scenario and get its rows as arrays whose names carry their units."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hil.lanes.lane import Lane
from hil.recording.recording import COLUMNS, Recording
from hil.runs.run import require_bus, run_in_memory, run_into
from hil.runs.run_folder import RECORDING, SUMMARY, RunFolder
from hil.runs.scenario import Scenario, load_scenario
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.loop.row import ROW, columns

if TYPE_CHECKING:
    import pandas
    import polars
    import pyarrow

    from hil.runs.summary import Summary

_FIELD_OF = {column: field for field in ROW.names or () for column in columns(field)}


@dataclass(frozen=True)
class Run:
    """Rows and figures of one run."""

    summary: dict[str, Any]
    """plain data as in ``summary.json``: who ran, figures by name with their units, verdicts on the checks, ``ok``"""
    folder: Path | None
    """where recording, frame log and picture are; None for a run in memory"""
    figures: "Summary | None" = None
    """the summary with its types; None for a run that was opened from its folder"""
    _in_memory: NDArray[np.void] | None = field(default=None, repr=False)

    @cached_property
    def rows(self) -> NDArray[np.void]:
        """(n,) one record a tick; fields as in the reference of recording columns. Read when they are first asked for.

        Raises ``RecordingError`` for a recording that can't be read, ``OSError`` without one.
        """
        if self._in_memory is not None:
            return self._in_memory
        assert self.folder is not None, "rows are in memory or in a folder"
        blocks = list(Recording.open(self.folder / RECORDING).rows(ROW.names or ()))
        return np.concatenate(blocks) if blocks else np.zeros(0, ROW)

    @property
    def ok(self) -> bool:
        """Whether the run came to its end and keeps the scenario's checks."""
        return bool(self.summary["ok"])

    def __getitem__(self, name: str) -> NDArray[Any]:
        """A column (n,), such as "position_x_m", or a field (n, 3), such as "position_m".

        Raises ``KeyError`` with the columns that there are.
        """
        if name in (ROW.names or ()):
            return self.rows[name]
        if name not in _FIELD_OF:
            raise KeyError(f"no column {name!r}; there are: {', '.join(COLUMNS)}")
        field = _FIELD_OF[name]
        return self.rows[field][:, columns(field).index(name)]

    def __iter__(self) -> Iterator[str]:
        """Names of all columns, in order."""
        return iter(COLUMNS)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All columns (n,) by name, each contiguous."""
        return {name: np.ascontiguousarray(self[name]) for name in COLUMNS}

    def to_arrow(self) -> "pyarrow.Table":
        """All columns as a ``pyarrow.Table``."""
        import pyarrow

        return pyarrow.table(self.arrays())

    def to_pandas(self) -> "pandas.DataFrame":
        """All columns as a ``pandas.DataFrame``. Needs pandas: ``pip install pkxyz-ctrl[frames]``."""
        return self.to_arrow().to_pandas()

    def to_polars(self) -> "polars.DataFrame":
        """All columns as a ``polars.DataFrame``. Needs polars: ``pip install pkxyz-ctrl[frames]``."""
        import polars

        frame = polars.from_arrow(self.to_arrow())
        assert isinstance(frame, polars.DataFrame), "a table becomes a frame"
        return frame


def run(
    scenario: Scenario | str | Path,
    *,
    lane: Lane | str = Lane.FAST,
    out: str | Path | None = None,
    replace: bool = False,
    draw: "Callable[[RunFolder, Summary], None] | None" = None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Run:
    """Close the loop on a scenario (by itself, or by the name or file of one).

    ``lane``: "fast", composed in one compiled loop, or "lockstep", over the simulated bus; both give the same bits.
    ``out``: a folder for recording, frame log, configuration, summary and picture, ``replace``: also that of an earlier
    run; without it nothing is written. ``draw``: who draws the picture, this process by default. ``on_progress`` is
    told the ticks done and in all. Ctrl-C ends a run into a folder, which keeps what was recorded and says so in its
    summary. Raises ``ConfigError`` for what can't be run, and it or ``RecordingError`` when the disk fails.
    """
    loaded = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    chosen = _in_process(lane)
    require_bus(loaded, chosen)
    if out is None:
        summary, rows = run_in_memory(loaded, chosen, on_progress)
        return Run(summary.as_json(), None, summary, rows)
    folder = RunFolder(Path(out), replace=replace)
    summary = run_into(folder, loaded, chosen, on_progress)
    (draw or _drawn_here)(folder, summary)
    return Run(_summary_of(folder.path), folder.path, summary)


def _drawn_here(folder: RunFolder, summary: "Summary") -> None:
    from hil.pictures.run import draw  # whoever draws elsewhere does without matplotlib here

    draw(folder, summary)


def _in_process(lane: Lane | str) -> Lane:
    chosen = Lane.named(lane)
    if chosen not in (Lane.FAST, Lane.LOCKSTEP):
        other = {Lane.WALL: "pkxyz run", Lane.EMULATED: "pkxyz emulate"}[chosen]
        raise ConfigError(f"the {chosen} lane takes processes of its own: `{other}`, then hil.open_run")
    return chosen


def open_run(folder: str | Path) -> Run:
    """A run from its folder. Raises ``RecordingError`` for a recording that can't be read, ``OSError`` without one."""
    path = Path(folder)
    Recording.open(path / RECORDING)  # what is no recording is said here
    return Run(_summary_of(path), path)


def _summary_of(path: Path) -> dict[str, Any]:
    summary: dict[str, Any] = json.loads((path / SUMMARY).read_text(encoding="utf-8"))
    return summary
