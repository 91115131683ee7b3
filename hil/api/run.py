"""Run a scenario and get its rows as arrays whose names carry their units."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from hil.lanes.lane import Lane
from hil.pictures.run import draw
from hil.recording.recording import COLUMNS, Recording
from hil.runs.run import run_in_memory, run_into
from hil.runs.run_folder import RECORDING, SUMMARY, RunFolder
from hil.runs.scenario import Scenario, load_scenario
from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.loop.row import ROW, columns

if TYPE_CHECKING:
    import pandas
    import polars

_FIELD_OF = {column: field for field in ROW.names or () for column in columns(field)}


@dataclass(frozen=True)
class Run:
    """Rows and figures of one run."""

    summary: dict[str, Any]
    """plain data as in ``summary.json``: who ran, figures by name with their units, verdicts on the checks, ``ok``"""
    rows: NDArray[np.void]
    """(n,) one record a tick; fields as in the reference of recording columns"""
    folder: Path | None
    """where recording, frame log and picture are; None for a run in memory"""

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

    def to_arrow(self) -> pa.Table:
        """All columns as a ``pyarrow.Table``."""
        return pa.table(self.arrays())

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
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Run:
    """Close the loop on a scenario (by itself, or by the name or file of one).

    ``lane``: "fast", composed in one compiled loop, or "lockstep", over the simulated bus; both give the same bits.
    ``out``: a folder for recording, frame log, configuration, summary and picture; without it nothing is written.
    ``on_progress`` is told the ticks done and in all. Raises ``ConfigError`` for what can't be run.
    """
    loaded = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    chosen = _in_process(lane)
    if out is None:
        summary, rows = run_in_memory(loaded, chosen, on_progress)
        return Run(summary.as_json(), rows, None)
    folder = RunFolder(Path(out))
    draw(folder, run_into(folder, loaded, chosen, on_progress))
    return open_run(folder.path)


def _in_process(lane: Lane | str) -> Lane:
    chosen = Lane.named(lane)
    if chosen not in (Lane.FAST, Lane.LOCKSTEP):
        other = {Lane.WALL: "pkxyz run", Lane.EMULATED: "pkxyz emulate"}[chosen]
        raise ConfigError(f"the {chosen} lane takes processes of its own: `{other}`, then hil.open_run")
    return chosen


def open_run(folder: str | Path) -> Run:
    """A run from its folder. Raises ``RecordingError`` for a recording that can't be read, ``OSError`` without one."""
    path = Path(folder)
    summary = json.loads((path / SUMMARY).read_text(encoding="utf-8"))
    return Run(summary, _rows_of(path / RECORDING), path)


def _rows_of(path: Path) -> NDArray[np.void]:
    blocks = list(Recording.open(path).rows(ROW.names or ()))
    return np.concatenate(blocks) if blocks else np.zeros(0, ROW)
