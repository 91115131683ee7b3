"""Where a capture begins: a column that passes a level."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

Trigger = tuple[str, Literal["rises above", "falls below"], float]
"""A column, such as "position_x_m", what it does, and the level that it passes."""


def column_of(name: str) -> tuple[str, int | None]:
    """A field of three and which of it, from the name of a column as in a recording, or a field of one."""
    for suffix in ("_m_per_s", "_count", "_m", "_n", "_v", "_f"):
        stem = name.removesuffix(suffix)
        if name.endswith(suffix) and len(stem) > 2 and stem[-2] == "_" and stem[-1] in "xyz123":
            return stem[:-2] + suffix, "xyz".find(stem[-1]) if stem[-1] in "xyz" else int(stem[-1]) - 1
    return name, None


def beginning(
    rows: dict[str, NDArray[np.floating]], trigger: Trigger, column: tuple[str, int | None], before: int
) -> int | None:
    """Where the capture begins, once its trigger has come with enough rows before it."""
    field, n = column
    values = rows[field] if n is None else rows[field][:, n]
    level = trigger[2]
    if trigger[1] == "rises above":
        passes = (values[1:] > level) & (values[:-1] <= level)
    else:
        passes = (values[1:] < level) & (values[:-1] >= level)
    at = np.flatnonzero(passes) + 1
    at = at[at >= before]
    return int(at[0]) - before if len(at) else None
