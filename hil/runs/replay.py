"""A recording once more through the tick: the same inputs, and every output compared bit for bit.

What a tick is handed is all in its row: sense counts and status, what was seen of the node, ticks skipped, events asked
for and trips from outside. The law is designed anew from the recorded configuration, the reference planned anew. So a
replay that agrees says that the recording is whole and that this program is still the one that made it; one that does
not says where the two part.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil.lanes.blocks import Handout
from hil.recording.recording import Recording, RecordingError
from hil.runs.run_folder import CONFIG, SUMMARY
from hil.runs.scenario import Scenario, resolve, restore
from hil.runs.seal import changed
from hil.runs.versions import versions
from pkxyz_ctrl.config.controller import ControllerConfig
from pkxyz_ctrl.config.files import read_toml
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.outputs import decide
from pkxyz_ctrl.loop.period import period_of
from pkxyz_ctrl.loop.reference import standing_still
from pkxyz_ctrl.loop.row import CONTROLLER_FIELDS, ROW, columns
from pkxyz_ctrl.safety.modes import Mode
from pkxyz_ctrl.safety.monitors import SenseStatus

Rows = NDArray[np.void]

_INPUTS = {  # of the cycle, by the row's name for them
    "request": "event", "sense_status": "sense_status", "node_events": "node_events", "overrun": "overrun",
    "sense_count": "sense_count", "outside_trips": "trips", "quiet": "quiet", "output_acting": "output_acting",
}  # fmt: skip
_FOUND_OUT = int(SenseStatus.IMPLAUSIBLE)
"""Bits of the sense status that the tick itself adds."""
_FIELDS = tuple(str(entry[0]) for entry in CONTROLLER_FIELDS)
_FLOW = (
    "t_us", "tick", "sense_f", "measurement_m", "sense_status", "innovation_m", "estimate_m", "estimate_m_per_s",
    "disturbance_n", "reference_tick", "reference_m", "demand_n", "force_n", "slack_n", "active_set_steps", "saturated",
    "drive_count", "voltage_v",
)  # fmt: skip
_COMPARED = (*_FLOW, *(name for name in _FIELDS if name not in _FLOW and name not in _INPUTS))
"""Fields in the order in which a tick computes them, so that a cause is named before its consequences."""


@dataclass
class Difference:
    """One signal that did not come out as recorded."""

    signal: str
    """name of the column"""
    tick: int
    """the first one"""
    t_us: int
    recorded: float
    """there"""
    replayed: float
    ticks: int
    """in how many ticks it differs"""


@dataclass
class Replay:
    """What came of it."""

    ticks: int = 0
    differences: list[Difference] = field(default_factory=list)
    """the first one first; signals that differ from the same tick on in the order of computation"""
    notes: list[str] = field(default_factory=list)
    """what a difference may come from"""
    kept: list[str] = field(default_factory=list)
    """files of the folder that are, by the digests in its summary, as the run left them"""
    damages: list[str] = field(default_factory=list)
    """a line for each file that is not, and for a recording that was cut off"""

    @property
    def identical(self) -> bool:
        """Whether every bit came out as recorded."""
        return not self.differences

    @property
    def sound(self) -> bool:
        """Whether, besides, nothing is missing and all files are as the run left them."""
        return self.identical and not self.damages


def replay(
    path: Path,
    controller: ControllerConfig | None = None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Replay:
    """Replay the recording at ``path``; with a ``ControllerConfig``, as if that had been in command.

    Raises ``RecordingError`` for one that can't be read, lacks rows or has none, and ``ConfigError`` for a
    configuration that this program doesn't know.
    """
    recording = Recording.open(path)
    if recording.ticks == 0:
        raise RecordingError(f"{path}: holds no tick: its run never began, and there is nothing to replay")
    scenario = _scenario(recording, path.parent)
    if controller is not None:
        scenario = replace(scenario, controller=controller)
    found: dict[str, Difference] = {}
    result = Replay(notes=_notes(recording, scenario))
    _look_at_files(recording, result)
    player = _Player(scenario)
    for recorded in _blocks(recording):
        replayed = player.play(recorded)
        for name in _COMPARED:
            _compare(name, recorded, replayed, found)
        result.ticks += len(recorded)
        on_progress(result.ticks, recording.ticks)
    order = {column: n for n, column in enumerate(c for name in _COMPARED for c in columns(name))}
    result.differences = sorted(found.values(), key=lambda d: (d.tick, order[d.signal]))
    return result


class _Player:
    """A cycle in the state in which the first tick of every run finds it: the node operational, nothing known."""

    def __init__(self, scenario: Scenario) -> None:
        setup = scenario.setup()
        self._law = setup.law
        self._memory = cycling.new_memory(Mode.IDLE)
        self._handout = Handout(scenario.trajectory, scenario.bus.period_us, learner=setup.new_learner())
        self._cycle = period_of(self._law, standing_still())
        self._outputs = setup.new_outputs()

    def play(self, recorded: Rows) -> Rows:
        """The rows (n,) that the inputs of these rows (n,), which follow those of the last call, lead to."""
        law, memory, cycle = self._law, self._memory, self._cycle
        replayed = np.zeros(len(recorded), ROW)
        inputs = np.zeros(len(recorded), cycling.INPUT)
        for row_name, name in _INPUTS.items():
            inputs[name] = recorded[row_name]
        inputs["sense_status"] &= ~_FOUND_OUT
        seen, row = memory["input"], memory["row"]
        begin = 0
        while begin < len(recorded):
            count = self._handout.ticks(memory, len(recorded) - begin)
            reference = self._handout.rows(memory, count)
            for n in range(begin, begin + count):
                seen[0] = inputs[n]
                cycle(law, memory, reference)
                decide(law, memory, self._outputs, reference)
                replayed[n] = row[0]
            self._handout.see(replayed[begin : begin + count])
            begin += count
        return replayed


def _scenario(recording: Recording, folder: Path) -> Scenario:
    try:
        return restore(recording.metadata["config"], folder)
    except KeyError as error:
        raise RecordingError(f"{recording.path}: its metadata lack {error}: not a recording of a run") from None


def _blocks(recording: Recording) -> Iterator[Rows]:
    """Rows with what the controller recorded. Raises ``RecordingError`` where ticks are missing."""
    expected = 0
    for rows in recording.rows(ROW.names or ()):  # the truth, too: what is read is checked
        missing = np.flatnonzero(rows["tick"] != expected + np.arange(len(rows)))
        if len(missing):
            at = int(missing[0])
            raise RecordingError(
                f"{recording.path}: row {expected + at} is of tick {rows['tick'][at]}: rows are missing, and what came "
                "after them cannot be replayed"
            )
        expected += len(rows)
        yield rows


def _look_at_files(recording: Recording, result: Replay) -> None:
    folder = recording.path.parent
    if not recording.whole:
        result.damages.append(f"the recording was cut off: nobody closed it after its {recording.ticks} ticks")
    try:
        result.kept, lines = changed(folder / SUMMARY)
        result.damages += lines
    except FileNotFoundError:
        result.notes.append(f"there is no {SUMMARY}, and so no digests to check the files of the folder against")
    written = folder / CONFIG
    if CONFIG not in result.kept and written.is_file() and read_toml(written) != recording.metadata["config"]:
        result.damages.append(f"{CONFIG} is not the configuration in the recording")


def _compare(name: str, recorded: Rows, replayed: Rows, found: dict[str, Difference]) -> None:
    """Note in ``found`` which columns of a field differ in a bit."""
    left, right = (np.ascontiguousarray(rows[name]).reshape(len(rows), -1) for rows in (recorded, replayed))
    bits = np.dtype(f"u{left.dtype.itemsize}")
    for n, column in enumerate(columns(name)):
        at = np.flatnonzero(left[:, n].view(bits) != right[:, n].view(bits))
        if column in found:
            found[column].ticks += len(at)
        elif len(at):
            k = int(at[0])
            first = replayed[k]
            found[column] = Difference(
                column, int(first["tick"]), int(first["t_us"]), left[k, n].item(), right[k, n].item(), len(at)
            )


def _notes(recording: Recording, scenario: Scenario) -> list[str]:
    """In what the program of then was another one."""
    notes = []
    if resolve(scenario)["digest"] != recording.metadata.get("digest"):
        notes.append("the configuration is not the recorded one")
    now = versions()
    for package, version in recording.metadata.get("versions", {}).items():
        if now.get(package) != version:
            notes.append(f"{package} was {version}, is {now.get(package, 'not installed')}")
    return notes
