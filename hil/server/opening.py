"""What else the page shows: recordings that were kept, and all that there is to know of a stage, by name and unit."""

from pathlib import Path
from typing import Any

import numpy as np

from hil.recording.recording import Recording, RecordingError
from hil.runs.run_folder import RECORDING
from hil.server.messages import AskedWrongError
from pkxyz_ctrl.client.protocol import Block
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import NODE_EXPECTED, Mode
from pkxyz_ctrl.safety.trips import explain

ROWS_MOST = 30_000
"""Of a recording, the last ones: what the page keeps of telemetry, too."""
_LISTED_MOST, _EVENTS_MOST = 100, 200
_BURST_S = 0.1
"""Missed ticks that are no farther apart than this belong together."""


def listed(saves: Path) -> list[str]:
    """Folders of runs in a folder, newest first."""
    try:
        found = [(p.stat().st_mtime, p.name) for p in saves.iterdir() if (p / RECORDING).is_file()]
    except OSError:
        return []
    return [name for _, name in sorted(found, reverse=True)[:_LISTED_MOST]]


def opened(saves: Path, name: Any, fields: tuple[str, ...]) -> tuple[dict[str, Any], Block]:
    """A recording of the list: what it is, with its events by tick, and the rows of some fields. Raises
    ``AskedWrongError``.
    """
    if name not in listed(saves):
        raise AskedWrongError(f"no recording is called {name!r} in {saves}")
    try:
        recording = Recording.open(saves / str(name) / RECORDING)
        first = max(0, recording.ticks - ROWS_MOST)
        values = {field: recording.vector(field)[first:] for field in fields if field in (ROW.names or ())}
        tick, t_us = recording["tick"][first:], recording["t_us"][first:]
        period_us = int(np.median(np.diff(t_us) // np.maximum(np.diff(tick), 1))) if len(tick) > 1 else 0
        burst_ticks = round(1e6 * _BURST_S / period_us) if period_us else 0
        mode, trips, overrun = (recording[column][first:] for column in ("mode", "trips", "overrun"))
        events = _events(mode, trips, overrun, tick, burst_ticks)
    except RecordingError as error:
        raise AskedWrongError(str(error)) from None
    about = {
        "name": name, "ticks": len(tick), "period_us": period_us, "events": events, "left_out": first,
        "modes": sorted({Mode(int(m)).name for m in np.unique(recording["mode"])}),
    }  # fmt: skip
    return about, Block(int(tick[0]) if len(tick) else 0, values)


def _events(
    mode: np.ndarray, trips: np.ndarray, overrun: np.ndarray, tick: np.ndarray, burst_ticks: int
) -> list[dict[str, Any]]:
    """Changes of mode, trips and missed ticks, in order; of bursts of missed ticks one event each."""
    changes = np.flatnonzero(np.diff(mode, prepend=mode[:1]))
    found = [(int(tick[n]), "mode", Mode(int(mode[n])).name) for n in changes]
    begun = np.flatnonzero(np.diff(trips, prepend=0) & trips)
    found += [(int(tick[n]), "fault", explain(int(trips[n]))) for n in begun]
    waited_for = NODE_EXPECTED[np.concatenate([mode[:1], mode[:-1]])] != 0  # in FAULT, say, nobody waits for a tick
    late = np.flatnonzero((overrun != 0) & waited_for)
    for burst in np.split(late, np.flatnonzero(np.diff(tick[late]) > burst_ticks) + 1) if len(late) else ():
        count, begin, end = int(overrun[burst].sum()), int(tick[burst[0]]), int(tick[burst[-1]])
        words = f"{count} missed" + (f", tick {begin} to {end}" if end > begin else "")
        found.append((begin, "missed", words))
    return [{"tick": at, "kind": kind, "words": words} for at, kind, words in sorted(found)[:_EVENTS_MOST]]


def values_of(fields: dict[str, Any]) -> dict[str, Any]:
    """The newest of all telemetry: numbers, or lists of three; None for what is not a number."""
    told: dict[str, Any] = {}
    for name in sorted(fields):
        newest = np.asarray(fields[name][-1], np.float64)
        told[name] = [float(v) if np.isfinite(v) else None for v in newest.ravel()]
    return told
