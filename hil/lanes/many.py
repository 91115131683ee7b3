"""Many devices through one compiled loop: the fast lane's ticks, of which only the errors of the scans are kept.

They go tick by tick, all of them through one part of the tick before any through the next, which keeps that part's code
at hand; of each the kernels of ``fast.run_block`` in their order, so it does not matter who is run beside it. One that
ends in a fault is left there, as nobody clears it in this lane.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.lanes.blocks import Handout
from hil.lanes.fast import exchange
from hil.lanes.in_process import instants_us
from hil.lanes.setup import Setup
from pkxyz_ctrl.compiled.kernel import kernel
from pkxyz_ctrl.core.demand import PREDICTIVE
from pkxyz_ctrl.loop.cycle import new_memory, observe, respond
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
WINDOW = np.dtype([("begin_us", "i8"), ("end_us", "i8")])
"""A scan: from ... to."""
TICKS_MOST: Final = 100_000
"""The whole reference is held at once."""
_TRACKING, _FAULT = int(Mode.TRACKING), int(Mode.FAULT)


def can_run(setup: Setup) -> bool:
    """Whether this loop does what ``setup`` asks for: no law that plans in Python, nothing learnt, added or given out,
    and no more than ``TICKS_MOST`` ticks.
    """
    plain = setup.learning is None and setup.excitation is None and setup.triggers is None
    return plain and setup.ticks <= TICKS_MOST and int(setup.law["tick"]["kind"][0]) != PREDICTIVE


class Batch(NamedTuple):
    """Devices at rest, and what they are to follow. ``laws``: (n,) of ``cycle.LAW`` or (1,) for all; ``params``,
    ``states`` and ``memories`` (n,), ``reference`` and ``at_us`` a row for each tick, ``windows_us`` of the scans,
    ``found`` (n,) of ``SCANNED``.
    """

    laws: Records
    params: Records
    states: Records
    memories: Records
    reference: Records
    at_us: NDArray[np.int64]
    windows_us: Records
    found: Records

    @classmethod
    def of(cls, setup: Setup, laws: Records, plants: Sequence[Plant]) -> "Batch":
        """Plants, one at least, in the run of ``setup``."""
        memories = np.repeat(new_memory(Mode.IDLE), len(plants))
        params, states = (joined(each) for each in zip(*((p.params, p.state) for p in plants), strict=True))
        return cls(
            laws, params, states, memories, Handout(setup.trajectory, setup.bus.period_us).rows(memories, setup.ticks),
            np.ascontiguousarray(instants_us(setup, 0, setup.ticks), np.int64),
            np.array([s.scan_us for s in setup.trajectory.segments if s.scan_us], WINDOW),
            np.zeros(len(plants), SCANNED),
        )  # fmt: skip


def run_one_after_another(batch: Batch) -> None:
    """All its ticks; state, memory and ``found`` are left as the run leaves them."""
    _run_together(*batch)


def joined(records: Sequence[Records]) -> Records:
    """Records (1,) of one kind as (n,). ``np.concatenate`` asks for every field whether there is a type for both."""
    return np.frombuffer(bytearray(b"".join(each.tobytes() for each in records)), records[0].dtype)


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
def _run_together(
    laws: Records,
    params: Records,
    states: Records,
    memories: Records,
    reference: Records,
    at_us: NDArray[np.int64],
    windows_us: Records,
    found: Records,
) -> None:
    each = 1 if len(laws) > 1 else 0
    count, late = len(params), laws[0]["tick"]["delay_periods"] - 1
    for i in range(len(at_us)):
        for n in range(count):
            if found[n]["faulted"] == 0:
                memory = memories[n]
                due, counts = memory["tick"]["count"][late], memory["input"]["sense_count"]
                exchange(params[n : n + 1], states[n : n + 1], at_us[i], due, memory["row"], counts)
        for n in range(count):
            if found[n]["faulted"] == 0:
                observe(laws[each * n : each * n + 1], memories[n : n + 1], reference)
        for n in range(count):
            if found[n]["faulted"] == 0:
                respond(laws[each * n : each * n + 1], memories[n : n + 1])
                take(memories[n]["row"], laws[0]["period_us"], windows_us, found[n])


@kernel
def take(row: np.void, period_us: int, windows_us: Records, found: np.void) -> None:
    """Whether a tick has ended in a fault, and its error, once for each scan that it lies in."""
    if row["mode"] == _FAULT:
        found["faulted"] = 1
    if row["mode"] != _TRACKING:
        return
    t_us = row["reference_tick"] * period_us
    for k in range(len(windows_us)):
        if windows_us[k]["begin_us"] <= t_us < windows_us[k]["end_us"]:
            found["ticks"] += 1
            for j in range(3):
                error = row["position_m"][j] - row["reference_m"][j]
                found["total_m"][j] += error
                found["square_m2"][j] += error * error
