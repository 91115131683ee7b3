"""Many devices at once: ``hil.lanes.many``'s loop, with sixteen devices in the vectors of a core where it has them."""

import ctypes
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.abreast import machine
from hil.abreast.widening.records import one_by_one, side_by_side
from hil.abreast.widening.text import LANES
from hil.lanes import many
from hil.lanes.many import SCANNED, Batch
from hil.lanes.setup import Setup
from sim.plant import Plant

Records = NDArray[np.void]


def scan_errors(setup: Setup, laws: Records, plants: Sequence[Plant]) -> Records:
    """(n,) of ``SCANNED`` of plants at rest under ``laws``, (n,) of ``cycle.LAW`` or (1,) for all; the rest of the run,
    which ``many.can_run`` allows, is that of ``setup``.
    """
    if not plants:
        return np.zeros(0, SCANNED)
    batch = Batch.of(setup, laws, plants)
    run(batch)
    return batch.found


def run(batch: Batch) -> None:
    """All its ticks, side by side if that has been made for this machine (``prepare``), else one after another: the
    same bits.
    """
    if machine.is_there(own_laws=len(batch.laws) > 1):
        run_side_by_side(batch)
    else:
        many.run_one_after_another(batch)


def prepare(*, own_laws: bool, tell: Callable[[str], None] | None = None) -> bool:
    """Make it, unless it is there: a minute and a half, which ``tell`` is told. False where this machine has no vectors
    for it, or nowhere to keep it.
    """
    if machine.can_be_had() and not machine.is_there(own_laws=own_laws):
        if tell is not None:
            tell(f"compiling for {LANES} devices side by side, once: a minute or two")
        machine.code(own_laws=own_laws)
    return machine.is_there(own_laws=own_laws)


def run_side_by_side(batch: Batch) -> None:
    """All its ticks; state, memory and ``found`` are left as the run leaves them. What a group lacks in devices its
    last one fills.
    """
    own_laws, count = len(batch.laws) > 1, len(batch.params)
    which = np.minimum(np.arange(-(-count // LANES) * LANES), count - 1)
    params, states, memories, found = (
        side_by_side(each[which]) for each in (batch.params, batch.states, batch.memories, batch.found)
    )
    laws = side_by_side(batch.laws[which]) if own_laws else batch.laws
    made = machine.code(own_laws=own_laws)
    room = np.zeros(made.frame + 64, np.uint8)
    run_ticks = ctypes.CFUNCTYPE(ctypes.c_int64, *[ctypes.c_void_p] * 13)(made.run)
    run_ticks(
        len(batch.at_us), _at(batch.at_us), len(which) // LANES, _at(params), _at(states), _at(laws), _at(memories),
        _at(found), _at(batch.reference), len(batch.reference), _at(batch.windows_us), len(batch.windows_us),
        _at(room[-room.ctypes.data % 64 :]),
    )  # fmt: skip
    for records, groups in ((batch.states, states), (batch.memories, memories), (batch.found, found)):
        records[:] = one_by_one(groups, records.dtype)[:count]


def _at(array: NDArray[Any]) -> int:
    return int(array.ctypes.data)
