"""A batch of devices through the widened kernels: ``hil.lanes.many``'s loop, eight devices at once."""

import ctypes
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.abreast.machine import code
from hil.abreast.records import one_by_one, side_by_side
from hil.abreast.text import LANES
from hil.lanes.many import SCANNED

Records = NDArray[np.void]


def run_together(
    law: Records,
    memories: Records,
    reference: Records,
    params: Records,
    states: Records,
    at_us: NDArray[np.int64],
    windows_us: Records,
) -> Records:
    """(n,) of ``SCANNED`` after the ticks ``at_us``, with ``law`` (1,) for all; memory and state are left as the run
    leaves them. What a group lacks in devices its last one fills.
    """
    count = len(params)
    filled = -(-count // LANES) * LANES
    which = np.minimum(np.arange(filled), count - 1)
    own = [side_by_side(each[which]) for each in (params, states, memories, np.zeros(count, SCANNED))]
    made = code()
    room = np.zeros(made.frame + 64, np.uint8)
    frame = room[-room.ctypes.data % 64 :]
    ticks = np.ascontiguousarray(at_us, np.int64)
    run = ctypes.CFUNCTYPE(ctypes.c_int64, *[ctypes.c_void_p] * 13)(made.run)
    run(
        len(ticks), _at(ticks), filled // LANES, *(_at(each) for each in own[:2]), _at(law), _at(own[2]),
        _at(reference), len(reference), _at(windows_us), len(windows_us), _at(own[3]), _at(frame),
    )  # fmt: skip
    for records, groups in zip((states, memories), own[1:3], strict=True):
        records[:] = one_by_one(groups, records.dtype)[:count]
    return one_by_one(own[3], SCANNED)[:count]


def _at(array: NDArray[Any]) -> int:
    return int(array.ctypes.data)
