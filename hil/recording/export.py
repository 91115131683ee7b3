"""A recording for other programs: CSV, MDF 4, HDF5, and a scan as a map for Gwyddion."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from hil.recording.recording import COLUMNS, Recording, RecordingError

Array = NDArray[np.float64]

ERRORS: Final = tuple(f"error_{axis}_m" for axis in "xyz")
"""Estimate less set-point: columns that a recording does not have by themselves."""
USUAL: Final = (
    *(f"{name}_{axis}_m" for name in ("reference", "estimate", "error") for axis in "xyz"),
    *(f"voltage_{n}_v" for n in (1, 2, 3)), "mode", "trips", "overrun",
)  # fmt: skip
_UNITS: Final = {"_m_per_s": "m/s", "_m": "m", "_n": "N", "_v": "V", "_f": "F", "_us": "us", "_count": "", "_s": "s"}


def unit_of(column: str) -> str:
    """By its name; empty for a count or a code."""
    return next((unit for suffix, unit in _UNITS.items() if column.endswith(suffix)), "")


def values_of(recording: Recording, column: str) -> NDArray[Any]:
    """(ticks,) of a column, of ``ERRORS`` too. Raises ``RecordingError``."""
    if column in ERRORS:
        axis = column.split("_")[1]
        return np.asarray(recording[f"estimate_{axis}_m"] - recording[f"reference_{axis}_m"])
    if column not in COLUMNS:
        known = ", ".join((*ERRORS, *COLUMNS))
        raise RecordingError(f"a recording has no column {column!r}; it has {known}")
    return recording[column]


def as_csv(recording: Recording, columns: Sequence[str], file: Path) -> None:
    """``t_s`` first, which PlotJuggler and others take for time; each number as short as it reads back the same."""
    values = [_seconds(recording), *(values_of(recording, column) for column in columns)]
    with file.open("w", newline="", encoding="utf-8") as out:
        writer = csv.writer(out)
        writer.writerow(["t_s", *columns])
        writer.writerows(zip(*(v.tolist() for v in values), strict=True))


def as_hdf5(recording: Recording, columns: Sequence[str], file: Path) -> None:
    """A data set for each column, with its unit."""
    import h5py

    with h5py.File(file, "w") as out:
        for column in ("t_s", *columns):
            values = _seconds(recording) if column == "t_s" else values_of(recording, column)
            out.create_dataset(column, data=values, compression="gzip").attrs["unit"] = unit_of(column)


def as_mf4(recording: Recording, columns: Sequence[str], file: Path) -> None:
    """A channel for each column, with its unit, over seconds."""
    from asammdf import MDF, Signal

    t_s = _seconds(recording)
    signals = [Signal(values_of(recording, c), t_s, name=c, unit=unit_of(c)) for c in columns]
    with MDF(version="4.10") as out:
        out.append(signals, comment="pkxyz_ctrl")
        out.save(file, overwrite=True)


def as_gsf(recording: Recording, column: str, file: Path, pixels: int) -> float:
    """A column over the set-points' x and y, ``pixels`` along the longer side; returns the share of pixels that no tick
    fell into, which have the value of their nearest neighbour. Raises ``RecordingError`` where there is no area.
    """
    from gsffile import write_gsf

    x, y = (recording[f"reference_{axis}_m"] for axis in "xy")
    scan = (recording["reference_tick"] >= 0) & np.isfinite(x) & np.isfinite(y)
    image, left_m, top_m, side_m = _mapped(x[scan], y[scan], values_of(recording, column)[scan], pixels)
    empty = np.isnan(image)
    nearest = distance_transform_edt(empty, return_distances=False, return_indices=True)
    rows, cols = image.shape
    about = {
        "XReal": cols * side_m, "YReal": rows * side_m, "XOffset": left_m, "YOffset": top_m, "XYUnits": "m",
        "ZUnits": unit_of(column), "Title": column,
    }  # fmt: skip
    write_gsf(file, image[tuple(nearest)].astype(np.float32), about)
    return float(empty.mean())


def _mapped(x: Array, y: Array, value: Array, pixels: int) -> tuple[Array, float, float, float]:
    """Mean (rows, columns) of what fell into each pixel, NaN for none; the first row has the largest y."""
    width, height = (float(np.ptp(v)) if len(v) else 0.0 for v in (x, y))
    if min(width, height) <= 0.0:
        raise RecordingError("a map needs a scan of an area, and the set-points of this recording go along a line")
    side = max(width, height) / (pixels - 1)
    col = np.rint((x - x.min()) / side).astype(int)
    row = np.rint((y.max() - y) / side).astype(int)
    shape = int(row.max()) + 1, int(col.max()) + 1
    at = row * shape[1] + col
    hits = np.bincount(at, minlength=shape[0] * shape[1])
    with np.errstate(invalid="ignore"):
        mean = np.bincount(at, value, shape[0] * shape[1]) / hits
    return mean.reshape(shape), float(x.min()) - side / 2, float(y.min()) - side / 2, side


def _seconds(recording: Recording) -> Array:
    return np.asarray(recording["t_us"] * 1e-6)
