"""What of the compiled kernels gets a name in C, and what each is handed."""

from typing import Any, NamedTuple

import numpy as np

from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.reference import REFERENCE


class Argument(NamedTuple):
    """One array of records: a pointer to the one record, or a pointer and how many there are."""

    name: str
    dtype: np.dtype[np.void]
    is_const: bool = False
    many: bool = False


class Entry(NamedTuple):
    """A kernel that returns nothing, and its name in C; there it returns a status, 0 if all is well."""

    name: str
    kernel: Any
    arguments: tuple[Argument, ...]
    about: str


ENTRIES = (
    Entry(
        "pkxyz_cycle",
        cycling.cycle,
        (
            Argument("law", cycling.LAW, is_const=True),
            Argument("memory", cycling.MEMORY),
            Argument("reference", REFERENCE, is_const=True, many=True),
        ),
        "One period: reads memory->input, leaves counts for the combs, mode and record in memory->row.",
    ),
)
