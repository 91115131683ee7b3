"""Many devices through one compiled loop: the fast lane's ticks, of which only the errors of the scans are kept.

A device is run to its end before the next begins, by the kernels of ``fast.run_block`` in their order: what it meets
does not depend on who is run beside it. One that ends in a fault is left there, as nobody clears it in this lane.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.lanes.blocks import Handout
from hil.lanes.fast import exchange
from hil.lanes.in_process import instants_us
from hil.lanes.setup import Setup
from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.core.demand import PREDICTIVE
from pkxyz_ctrl.loop.cycle import cycle, new_memory
from pkxyz_ctrl.safety.modes import Mode
from sim.plant import Plant

Array = NDArray[np.float64]
Records = NDArray[np.void]

SCANNED = np.dtype(
    [
        ("ticks", "i8"),  # within scans
        ("total_m", "f8", (3,)),  # sum of true position less reference
        ("square_m2", "f8", (3,)),  # ... and of its square
        ("faulted", "i8"),
    ],
    align=True,
)
TICKS_MOST: Final = 100_000
"""The whole reference is held at once."""
_TRACKING, _FAULT = int(Mode.TRACKING), int(Mode.FAULT)


def can_run(setup: Setup) -> bool:
    """Whether this loop does what ``setup`` asks for: no law that plans in Python, nothing learnt, added or given out,
    and no more than ``TICKS_MOST`` ticks.
    """
    plain = setup.learning is None and setup.excitation is None and setup.triggers is None
    return plain and setup.ticks <= TICKS_MOST and int(setup.law["tick"]["kind"][0]) != PREDICTIVE


def scan_errors(setup: Setup, laws: Records, plants: Sequence[Plant]) -> Records:
    """(n,) of ``SCANNED`` of plants at rest under ``laws``, (n,) of ``cycle.LAW`` or (1,) for all; the rest of the run,
    which ``can_run`` allows, is that of ``setup``.
    """
    fresh, memory = new_memory(Mode.IDLE), new_memory(Mode.IDLE)
    reference = Handout(setup.trajectory, setup.bus.period_us).rows(memory, setup.ticks)
    windows_us = [s.scan_us for s in setup.trajectory.segments if s.scan_us]
    windows = np.array(windows_us, dtype=np.int64).reshape(-1, 2)
    found = np.zeros(len(plants), SCANNED)
    if len(plants):
        params, states = (np.concatenate(each) for each in zip(*((p.params, p.state) for p in plants), strict=True))
        at_us = instants_us(setup, 0, setup.ticks)
        _run_each(laws, fresh, memory, reference, params, states, at_us, windows, found)
    return found


def rms_m(scanned: Records) -> Array:
    """RMS error (n, 3); NaN without a tick in a scan."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(scanned["square_m2"] / scanned["ticks"][:, None]))


def deviation_m(scanned: Records) -> Array:
    """The same about the error's own mean."""
    ticks = scanned["ticks"][:, None]
    with np.errstate(invalid="ignore"):
        squares = np.maximum(scanned["square_m2"] - scanned["total_m"] ** 2 / ticks, 0.0)
        return np.asarray(np.sqrt(squares / ticks))


@kernel
def _run_each(
    laws: Records,
    fresh: Records,
    memory: Records,
    reference: Records,
    params: Records,
    states: Records,
    at_us: NDArray[np.int64],
    windows_us: NDArray[np.int64],
    found: Records,
) -> None:
    seen, row = memory[0]["input"], memory[0]["row"]
    for n in range(len(params)):
        at = n if len(laws) > 1 else 0
        law, plant, state = laws[at : at + 1], params[n : n + 1], states[n : n + 1]
        memory[0] = fresh[0]
        due = memory[0]["tick"]["count"][law[0]["tick"]["delay_periods"] - 1]
        for i in range(len(at_us)):
            exchange(plant, state, at_us[i], due, row, seen["sense_count"])
            cycle(law, memory, reference)
            if row["mode"] == _FAULT:
                found[n]["faulted"] = 1
                break
            if row["mode"] == _TRACKING:
                _take(row, row["reference_tick"] * law[0]["period_us"], windows_us, found[n])


@kernel
def _take(row: np.void, t_us: int, windows_us: NDArray[np.int64], found: np.void) -> None:
    """The error of a tick, once for each scan that it lies in."""
    for k in range(len(windows_us)):
        if windows_us[k, 0] <= t_us < windows_us[k, 1]:
            found["ticks"] += 1
            for j in range(3):
                error = row["position_m"][j] - row["reference_m"][j]
                found["total_m"][j] += error
                found["square_m2"][j] += error * error
