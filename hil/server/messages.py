"""Parts of the messages between a client and the desk."""

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.operate.sample_axes import turn_of
from hil.server.paths import StagePath
from pkxyz_ctrl.loop.row import ROW

Array = NDArray[np.float64]

_OF_SESSION = {"path_row": "path_row", "in_position": "in_position"}
FIELDS = frozenset({*(name for name in ROW.names or () if ROW[name].base.kind in "fi"), *_OF_SESSION})
"""Of telemetry."""
_URGENT_MOST = 300
_PIXELS_MOST = 1_000_000
_STRETCHES, _AT_ONCE = 1500, 100
"""Of a path that is drawn: into how many stretches it is cut, and how many of them are looked at together."""
_PLACES = frozenset({"reference_m", "measurement_m", "estimate_m", "position_m"})
_WAYS = frozenset({"estimate_m_per_s", "innovation_m"})


class AskedWrongError(ValueError):
    """A message that means nothing; the text says what was expected."""


def answer(tag: Any, verb: str, state: str, words: str, command_id: int | None = None) -> dict[str, Any]:
    """What became of something that was asked."""
    return {"answer": {"tag": tag, "id": command_id, "verb": verb, "state": state, "words": words}}


def is_urgent(text: str) -> bool:
    """Whether a message stops the stage, so that it must not wait for those before it."""
    if len(text) > _URGENT_MOST:
        return False
    try:
        message = json.loads(text)
    except ValueError:
        return False
    return isinstance(message, dict) and message.get("do") in ("stop", "release")


def tag_of(value: Any) -> str | int | None:
    """What a client may put on a message to know its answers by."""
    if value is None or (isinstance(value, str) and len(value) <= 64):
        return value
    if isinstance(value, int) and abs(value) < 1 << 53:
        return value
    raise AskedWrongError("a tag is a short text or a whole number")


def shown(path: StagePath) -> dict[str, Any]:
    """A path before it is followed, in the sample's coordinates."""
    points = _drawn(path)
    return {
        "name": path.name, "duration_s": path.duration_s, "start_m": points[0].tolist(),
        "points_m": np.round(points, 12).tolist(), "low_m": points.min(0).tolist(), "high_m": points.max(0).tolist(),
        "lines": path.lines, "backward": path.backward,
    }  # fmt: skip


def _drawn(path: StagePath) -> Array:
    """Positions (n, 3) to draw it by: of each stretch its first row, and those that are farthest along an axis, so that
    every line reaches as far as it does.
    """
    length = -(-path.rows // _STRETCHES)
    drawn = []
    for first in range(0, path.rows, length * _AT_ONCE):
        count = min(length * _AT_ONCE, path.rows - first)
        points = path.trajectory.turn.to_sample(path.sample(first, count)[:, 0:3])
        for begin in range(0, count, length):
            stretch = points[begin : begin + length]
            drawn.append(stretch[np.unique([0, *stretch.argmin(0), *stretch.argmax(0)])])
    return np.concatenate([*drawn, points[-1:]])


def number(message: dict[str, Any], name: str, absent: float | None) -> float:
    """A number of a message. Raises ``AskedWrongError``."""
    value = message.get(name, absent)
    if value is None and absent is not None:
        value = absent
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise AskedWrongError(f"{name} is a number, not {value!r}")
    return float(value)


def pixels_of(message: dict[str, Any]) -> int:
    """Of each line of a path, for triggers. Raises ``AskedWrongError``."""
    return round(min(max(number(message, "pixels", 0.0), 0.0), _PIXELS_MOST))


def trigger_of(message: dict[str, Any]) -> dict[str, Any]:
    """Fields of a command that says at which positions the outputs pulse. Raises ``AskedWrongError``."""
    if message.get("axis", "x") not in ("x", "y", "z"):
        raise AskedWrongError("a trigger needs axis x, y or z")
    numbers = {name: number(message, of, 0.0) for name, of in (("first_m", "start_m"), ("pitch_m", "pitch_m"))}
    whole = {name: int(number(message, name, 0.0)) for name in ("count", "direction")}
    return {"axis": "xyz".index(message.get("axis", "x")), **numbers, **whole}


def of_sample(ticks: NDArray[np.void]) -> dict[str, NDArray[Any]]:
    """Fields of records (n,) of ``TICK`` by name, positions and velocities in the coordinates of the sample as they
    were in each tick. Forces, voltages and what belongs to combs stay the stage's.
    """
    rows, matrices = ticks["row"], ticks["session"]["matrix"]
    turns = [(0, len(ticks), turn_of(matrices[0]))]
    if (matrices != matrices[0]).any():
        turns = [(n, n + 1, turn_of(matrix)) for n, matrix in enumerate(matrices)]
    fields: dict[str, NDArray[Any]] = {name: rows[name] for name in FIELDS - _OF_SESSION.keys()}
    fields |= {name: ticks["session"][of] for name, of in _OF_SESSION.items()}
    if all(turn.is_plain for *_, turn in turns):
        return fields
    for name in _PLACES | _WAYS:
        parts = [
            (turn.to_sample if name in _PLACES else turn.way_to_sample)(rows[name][begin:end])
            for begin, end, turn in turns
        ]
        fields[name] = np.concatenate(parts)
    return fields
