"""Rows of the reference as the loop is handed them: where the stage shall be, tick by tick, and what is added to it."""

import numpy as np
from numpy.typing import NDArray

REFERENCE = np.dtype(
    [
        ("tick", "i8"),  # of the trajectory; the rows of a block follow one another without a gap
        ("motion", "f8", (9,)),  # position m, velocity m/s, acceleration m/s2 of x, y, z, a learnt shift included
        ("added_m", "f8", (3,)),  # excitation: added to what is measured while tracking
        ("asked_m", "f8", (3,)),  # the position without the learnt shift
        ("output", "i8"),  # bits of the node's digital outputs there, of ``triggers``
    ],
    align=True,
)


def reference_rows(
    motion: NDArray[np.float64],
    first_tick: int = 0,
    *,
    added_m: NDArray[np.float64] | None = None,
    asked_m: NDArray[np.float64] | None = None,
) -> NDArray[np.void]:
    """Rows (n,) of ``REFERENCE`` from ``motion`` (n, 9) as ``Trajectory.sample`` gives it, from ``first_tick`` on.

    ``added_m`` (n, 3): nothing by default. ``asked_m`` (n, 3): the position of ``motion`` by default.
    """
    rows = np.zeros(len(motion), REFERENCE)
    write_rows(rows, motion, first_tick)
    if added_m is not None:
        rows["added_m"] = added_m
    if asked_m is not None:
        rows["asked_m"] = asked_m
    return rows


def write_rows(rows: NDArray[np.void], motion: NDArray[np.float64], first_tick: int) -> None:
    """Write ``motion`` (n, 9) into rows (n,) that are there, nothing added and nothing shifted."""
    rows["tick"] = np.arange(first_tick, first_tick + len(rows))
    rows["motion"] = motion
    rows["added_m"] = 0.0
    rows["asked_m"] = motion[:, 0:3]
    rows["output"] = 0


def standing_still() -> NDArray[np.void]:
    """One row: at rest, which is as good as any where nothing is tracked yet."""
    return np.zeros(1, REFERENCE)
