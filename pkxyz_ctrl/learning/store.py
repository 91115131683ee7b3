"""A correction in a file, with what it belongs to: JSON that people can read, and that another scan refuses."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.config.files import ConfigError, read_bounded
from pkxyz_ctrl.config.refused import reason
from pkxyz_ctrl.learning.config import LearningError
from pkxyz_ctrl.learning.timetable import Timetable
from pkxyz_ctrl.trajectory import Trajectory

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

_FORMAT = "pkxyz learning 1"
STORED_MAX_BYTES = 10_000_000
"""Far above 450 harmonics."""
_MARKS = 64
"""Instants of the period at which the file says where the scan is."""
_SAME_M = 1e-12


@dataclass(frozen=True)
class Belongs:
    """What a correction was learnt for: under anything else it would be another one."""

    period_ticks: int
    period_us: int
    marks_m: Array
    """(``_MARKS``, 3): where the scan is, evenly over its period"""
    digests: dict[str, str]
    """of stage, controller and bus"""


@dataclass(frozen=True)
class Stored:
    """A correction and its origin."""

    belongs: Belongs
    harmonics_m: Complex
    """(K, 3)"""
    provenance: dict[str, Any]
    """plain data: scenario, its digest, plant, seed, windows learnt from, errors, versions"""


def belonging(trajectory: Trajectory, table: Timetable, period_us: int, digests: dict[str, str]) -> Belongs:
    """What is learnt for a trajectory with a stage, controller and bus."""
    rows = trajectory.sample(table.begin, table.period, period_us)
    marks = rows[np.arange(_MARKS) * table.period // _MARKS, 0:3]
    return Belongs(table.period, period_us, marks, digests)


def save(stored: Stored, path: Path) -> None:
    """Write it. Raises ``LearningError``."""
    b = stored.belongs
    data = {
        "format": _FORMAT,
        "provenance": stored.provenance,
        "digests": b.digests,
        "period_us": b.period_us,
        "period_ticks": b.period_ticks,
        "marks_m": b.marks_m.tolist(),
        "cosine_m": (2.0 * stored.harmonics_m.real).tolist(),
        "sine_m": (-2.0 * stored.harmonics_m.imag).tolist(),
    }
    try:
        path.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise LearningError(f"{path}: cannot be written: {reason(error)}") from None


def load(path: Path) -> Stored:
    """Read it. Raises ``LearningError`` for what is no such file."""
    try:
        data = json.loads(read_bounded(path, STORED_MAX_BYTES).decode("utf-8"))
    except ConfigError as error:
        raise LearningError(f"{error}; learn first: a run with --learn leaves learnt.json") from None
    except (RecursionError, ValueError) as error:
        raise LearningError(f"{path}: cannot be read as a stored correction: {error}") from None
    if not isinstance(data, dict) or data.get("format") != _FORMAT:
        raise LearningError(f"{path}: is not a stored correction ({_FORMAT!r}); a run with --learn leaves learnt.json")
    try:
        cosine, sine = (np.array(data[key], dtype=np.float64) for key in ("cosine_m", "sine_m"))
        marks = np.array(data["marks_m"], dtype=np.float64)
        belongs = Belongs(int(data["period_ticks"]), int(data["period_us"]), marks, dict(data["digests"]))
        if cosine.shape != sine.shape:
            raise ValueError("cosines and sines are not as many")
        provenance = dict(data["provenance"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise LearningError(f"{path}: is damaged: {type(error).__name__}: {error}; learn anew") from None
    shapes = marks.shape == (_MARKS, 3) and cosine.ndim == 2 and cosine.shape[1] == 3
    if not shapes or not (np.isfinite(cosine).all() and np.isfinite(sine).all()):
        raise LearningError(f"{path}: is damaged: its numbers do not have the shape of a correction; learn anew")
    return Stored(belongs, np.asarray(0.5 * (cosine - 1j * sine), np.complex128), provenance)


def require_same(stored: Stored, here: Belongs, path: str) -> None:
    """Raise ``LearningError`` if a correction was learnt for something else, naming what."""
    there = stored.belongs
    how = "learn anew (--learn), or run what it was learnt for"
    if (there.period_ticks, there.period_us) != (here.period_ticks, here.period_us):
        raise LearningError(
            f"{path}: belongs to another trajectory: its period is {there.period_ticks} ticks of {there.period_us} us, "
            f"here it is {here.period_ticks} of {here.period_us}; {how}"
        )
    apart = float(np.abs(there.marks_m - here.marks_m).max())
    if apart > _SAME_M:
        raise LearningError(
            f"{path}: belongs to another trajectory: that one is up to {apart * 1e6:.4g} um away from this one; {how}"
        )
    other = [name for name, digest in here.digests.items() if there.digests.get(name) != digest]
    if other:
        raise LearningError(f"{path}: was learnt with another {' and '.join(other)}; {how}")
