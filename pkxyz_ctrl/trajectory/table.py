"""A table of the user's: positions at instants, from a CSV file, joined by a cubic spline."""

import csv
import hashlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from pkxyz_ctrl.config.files import ConfigError, FrozenModel, read_bounded
from pkxyz_ctrl.trajectory.motion import Array, TrajectoryError, at_rest
from pkxyz_ctrl.trajectory.pieces import Pieces
from pkxyz_ctrl.trajectory.segments import Limits, Plan, Positive, travel

_COLUMNS = {
    **{f"t_{unit}": ("t", scale) for unit, scale in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6))},
    **{
        f"{axis}_{unit}": (axis, scale)
        for axis in "xyz"
        for unit, scale in (("m", 1.0), ("mm", 1e-3), ("um", 1e-6), ("nm", 1e-9))
    },
}
"""Quantity and factor to SI of every column that a file may have."""
_SLACK = 1 + 1e-9
TABLE_MAX_BYTES = 20_000_000
"""Half a million rows, which are read in some seconds."""


class Table(FrozenModel):
    """The path of a CSV file: one row a line, under a header that names quantities and units.

    Columns: ``t_s`` (or ``_ms``, ``_us``) and any of ``x_m``, ``y_m``, ``z_m`` (or ``_mm``, ``_um``, ``_nm``), relative
    to the rest pose; an axis that the file leaves out stands still. Between rows runs a cubic spline (position,
    velocity and acceleration continuous, not-a-knot at the ends). A jerk-limited lead-in joins the first row from
    where the stage stands, at that row's velocity and acceleration; the lead-out comes to rest on the last row.
    """

    kind: Literal["csv"]
    file: Annotated[str, Field(min_length=1)]
    """a path; in a scenario, from the scenario's folder"""
    velocity_max_m_per_s: Positive
    """limits hold for each axis, on the spline as in lead-in and lead-out"""
    acceleration_max_m_per_s2: Positive
    jerk_max_m_per_s3: Positive

    def plan(self, start_m: Array) -> Plan:
        """The scan is the file. Raises ``TrajectoryError`` with file and line."""
        limits = Limits(self.velocity_max_m_per_s, self.acceleration_max_m_per_s2, self.jerk_max_m_per_s3)
        content = _content(self.file)
        line, t_s, position_m = _rows(self.file, content, start_m)
        spline = _spline(t_s, position_m)
        _check_limits(self.file, spline, line, limits)
        first, last = spline.state[0], spline.end()
        rest = at_rest(position_m[-1])
        try:
            lead_in = () if np.array_equal(first, at_rest(start_m)) else (travel(at_rest(start_m), first, limits),)
            lead_out = () if np.array_equal(last, rest) else (_backwards(travel(rest, _turned(last), limits)),)
        except TrajectoryError as error:
            raise TrajectoryError(f"{self.file}: can't be joined to rest: {error}") from None
        begin = sum(part.total_s for part in lead_in)
        return Plan(
            (*lead_in, spline, *lead_out), position_m[-1], scan_s=(begin, begin + spline.total_s),
            source=self.file, source_sha256=hashlib.sha256(content).hexdigest(),
        )  # fmt: skip


def in_folder(segments: Sequence[Any], folder: Path) -> list[Any]:
    """The segments with the files of tables taken from a folder."""
    return [
        segment.model_copy(update={"file": str(folder / segment.file)}) if isinstance(segment, Table) else segment
        for segment in segments
    ]


def _content(file: str) -> bytes:
    try:
        return read_bounded(file, TABLE_MAX_BYTES)
    except ConfigError as error:
        raise TrajectoryError(str(error)) from None


def _rows(file: str, content: bytes, start_m: Array) -> tuple[list[int], Array, Array]:
    """Line numbers, times (n,) in s from 0 and positions (n, 3) in m, checked."""
    try:
        lines = list(csv.reader(content.decode("utf-8-sig").splitlines(), skipinitialspace=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise TrajectoryError(f"{file}: not a CSV file: {error}") from None
    filled = [(n, row) for n, row in enumerate(lines, 1) if any(cell.strip() for cell in row)]
    if len(filled) < 3:
        raise TrajectoryError(f"{file}: needs a header and at least two rows")
    columns = _columns(file, filled[0][1])
    values = np.array([_numbers(f"{file}: line {n}", row, len(columns)) for n, row in filled[1:]])
    numbers = [n for n, _ in filled[1:]]
    t_s, position = np.zeros(len(values)), np.tile(start_m, (len(values), 1))
    for (quantity, scale), column in zip(columns, values.T, strict=True):
        if quantity == "t":
            t_s = (column - column[0]) * scale
        else:
            position[:, "xyz".index(quantity)] = column * scale
    backward = np.flatnonzero(np.diff(t_s) <= 0)
    if len(backward):
        raise TrajectoryError(f"{file}: line {numbers[backward[0] + 1]}: its time is not after that of the row before")
    return numbers, t_s, position


def _columns(file: str, header: list[str]) -> list[tuple[str, float]]:
    """Quantity (t, x, y or z) and factor to SI of each column."""
    columns = []
    for name in (cell.strip() for cell in header):
        if name not in _COLUMNS:
            raise TrajectoryError(
                f"{file}: line 1: unknown column {name!r}; columns are t_s, t_ms or t_us, and x, y, z each with "
                "_m, _mm, _um or _nm"
            )
        columns.append(_COLUMNS[name])
    quantities = [quantity for quantity, _ in columns]
    if quantities.count("t") != 1 or len(set(quantities)) != len(quantities) or len(quantities) < 2:
        raise TrajectoryError(f"{file}: line 1: needs one column of time and one for each axis that moves, none twice")
    return columns


def _numbers(where: str, row: list[str], count: int) -> list[float]:
    if len(row) != count:
        raise TrajectoryError(f"{where}: has {len(row)} cells, the header {count}")
    try:
        values = [float(cell) for cell in row]
    except ValueError as error:
        raise TrajectoryError(f"{where}: {error}") from None
    if not all(math.isfinite(value) for value in values):
        raise TrajectoryError(f"{where}: every number has to be finite")
    return values


def _spline(t_s: Array, position_m: Array) -> Pieces:
    """A cubic spline is a sequence of pieces of constant jerk."""
    from scipy.interpolate import CubicSpline  # slow to import; no other reference has to wait for it

    cubic = CubicSpline(t_s, position_m, axis=0)
    j, a, v, p = cubic.c
    state = np.stack([p, v, 2 * a], axis=1)
    return Pieces(np.diff(t_s), state, 6 * j)


def _check_limits(file: str, spline: Pieces, line: list[int], limits: Limits) -> None:
    """``TrajectoryError`` for the first row after which the spline passes a limit.

    Extremes are at ends of pieces, and of velocity where acceleration crosses zero.
    """
    v, a, j = (np.abs(spline.state[:, 1]), np.abs(spline.state[:, 2]), np.abs(spline.jerk_m_per_s3))
    end = spline.end()
    v, a = (np.maximum(x, np.abs([*x[1:], np.abs(e)])) for x, e in ((v, end[1]), (a, end[2])))
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = np.nan_to_num(-spline.state[:, 2] / spline.jerk_m_per_s3, posinf=0, neginf=0)
    inside = (crossing > 0) & (crossing < spline.duration_s[:, None])
    v = np.where(inside, np.maximum(v, np.abs(spline.state[:, 1] + spline.state[:, 2] * crossing / 2)), v)
    broken = [
        (np.flatnonzero((x > limit * _SLACK).any(axis=1)), x, limit) for x, limit in zip((v, a, j), limits, strict=True)
    ]
    found = [
        (int(rows[0]), f"{name} of {x[rows[0]].max():.4g} {unit}, beyond the limit of {limit:g}")
        for (rows, x, limit), name, unit in zip(
            broken, ("velocity", "acceleration", "jerk"), ("m/s", "m/s2", "m/s3"), strict=True
        )
        if len(rows)
    ]
    if found:
        row, what = min(found)
        t_s = float(spline.duration_s[:row].sum())
        raise TrajectoryError(
            f"{file}: line {line[row]}: from {t_s:.6g} s after its first row on the path needs a {what}; "
            "smooth the file, give it more time, or raise the limit"
        )


def _turned(state: Array) -> Array:
    """The same state while time runs backwards."""
    return state * np.array([[1.0], [-1.0], [1.0]])


def _backwards(pieces: Pieces) -> Pieces:
    """The same path the other way round."""
    ends = [*pieces.state[1:], pieces.end()]
    return Pieces(
        pieces.duration_s[::-1], np.array([_turned(state) for state in reversed(ends)]), -pieces.jerk_m_per_s3[::-1]
    )
