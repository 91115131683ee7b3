"""The scale of the sense combs, from what an instrument outside saw while the controller held points.

A CSV with a line for each point that was held: ``commanded_x_um, commanded_y_um, commanded_z_um`` as the controller was
asked for, relative to rest, and ``seen_x_um, seen_y_um, seen_z_um`` as the instrument (vibrometer, microscope) saw the
table, along the stage's axes, from an origin of its own. The controller's stroke of chain i is wrong by the chain's
sense gain g_i, so at every point q_i(commanded) = g_i q_i(seen - origin): three gains and the origin, by least squares.
"""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from pkxyz_ctrl.config.files import ConfigError
from pkxyz_ctrl.stage import Stage, StageDomainError

Array = NDArray[np.float64]

COLUMNS = tuple(f"{who}_{axis}_um" for who in ("commanded", "seen") for axis in "xyz")


@dataclass(frozen=True)
class OutsideScale:
    """Sense gains of the chains relative to the stage file; above 1, the controller overrates a stroke."""

    sense_gain: Array
    """(3,)"""
    standard_error: Array
    """(3,) standard errors, from what the points leave"""
    origin_m: Array
    """(3,) where the instrument saw the rest position"""
    residual_m: float
    """rms over strokes and points"""
    points: int


def read_points(path: Path) -> tuple[Array, Array]:
    """Commanded and seen positions (n, 3) in m. Raises ``ConfigError`` with file, line and what to do."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = csv.DictReader(file, skipinitialspace=True)
            missing = [name for name in COLUMNS if name not in (rows.fieldnames or [])]
            if missing:
                raise ConfigError(f"{path}: no column {missing[0]!r}; the first line has to name {', '.join(COLUMNS)}")
            values = [[_number(path, rows.line_num, name, row[name]) for name in COLUMNS] for row in rows]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"--reference: {path}: cannot be read: {error}") from None
    table = np.array(values, dtype=np.float64).reshape(-1, 6) * 1e-6
    return table[:, :3], table[:, 3:]


def _number(path: Path, line: int, name: str, text: str | None) -> float:
    try:
        number = float(text or "")
    except ValueError:
        number = np.nan
    if not np.isfinite(number):
        raise ConfigError(f"{path}: line {line}: {name}: {text!r} is no number; give micrometres")
    return number


def outside_scale(stage: Stage, commanded_m: Array, seen_m: Array) -> OutsideScale:
    """Fit to points (n, 3) in m. Raises ``ConfigError`` where they can't tell gains from origin."""
    if len(commanded_m) < 3:
        raise ConfigError(
            f"--reference: {len(commanded_m)} points can't tell three gains from an origin; give at least 3"
        )
    try:
        believed = stage.inverse_kinematics(commanded_m)

        def misses(unknown: Array) -> Array:
            return np.asarray(
                (unknown[:3] * stage.inverse_kinematics(seen_m - unknown[3:] * 1e-6) - believed) * 1e9
            ).ravel()

        start = np.concatenate([np.ones(3), np.mean(seen_m - commanded_m, axis=0) * 1e6])
        fit = scipy.optimize.least_squares(misses, start, x_scale=[1e-3] * 3 + [1e-2] * 3)
    except StageDomainError as error:
        raise ConfigError(f"--reference: {error}; positions are relative to rest, in um") from None
    scale = np.linalg.norm(fit.jac, axis=0)
    size = np.linalg.svd(fit.jac / np.where(scale > 0.0, scale, 1.0), compute_uv=False)
    if size[-1] < 1e-4:
        raise ConfigError(
            "--reference: the points can't tell gains from origin; spread them, every stroke by micrometres"
        )
    spare = fit.fun.size - 6
    variance = float(fit.fun @ fit.fun) / spare
    covariance = np.linalg.inv(fit.jac.T @ fit.jac) * variance
    return OutsideScale(
        sense_gain=fit.x[:3],
        standard_error=np.sqrt(np.diag(covariance))[:3],
        origin_m=fit.x[3:] * 1e-6,
        residual_m=float(np.sqrt(np.mean(fit.fun**2))) * 1e-9,
        points=len(commanded_m),
    )
