"""Ticks to compare: a stage that does what the filter expects, and everything that can be wrong about it.

A segment is a law, rows of a path and inputs, a thousand ticks or so; the memory goes on from one to the next. What is
wrong is drawn anew for each: frames that are lost or damaged, channels at a rail, frozen, off by a jump or a drift,
counts at random, commands at random, a node that says all it can, overruns, paths out of reach and paths that are not
numbers, and limits so narrow that everything trips.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pkxyz_ctrl.compiled.direct_call import direct
from pkxyz_ctrl.core import kinematics
from pkxyz_ctrl.export import planned
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.predictive_problem import Problem
from pkxyz_ctrl.loop.reference import reference_rows
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Event, Mode
from pkxyz_ctrl.safety.monitors import NodeEvent, SenseStatus
from pkxyz_ctrl.safety.trips import Trip
from pkxyz_ctrl.trajectory import Trajectory

Records = NDArray[np.void]

TICKS = 1200
PREVIEW = 25
_FAULT, _BOOT, _PRE_OPERATIONAL = int(Mode.FAULT), int(Mode.BOOT), int(Mode.PRE_OPERATIONAL)
_NONE, _CLEAR = int(Event.NONE), int(Event.CLEAR)
_NODE_FOUND, _NODE_READY = int(Event.NODE_FOUND), int(Event.NODE_READY)


class Segment(NamedTuple):
    """``law`` (1,), of ``PLANNED_LAW`` where it plans, ``reference`` (n,) and ``inputs`` (m,) as the cycle takes them;
    ``rows`` (m,) that came of it.
    """

    law: Records
    reference: Records
    inputs: Records
    rows: Records


@njit(cache=True, error_model="numpy")
def show(
    law_array: Records, memory_array: Records, offset: NDArray[np.float64], given: NDArray[np.float64], recovers: int
) -> None:
    """Put the next sample into the memory's input: ``given`` (3,) where that is a number, else what a stage shows that
    stands where the filter predicts it, and ``offset`` (3,) counts beside. With ``recovers`` somebody helps in a mode
    that would last.
    """
    law, memory = law_array[0]["tick"], memory_array[0]
    sense, state, seen = law["sense"], memory["tick"], memory["input"]
    position, stroke = state["scratch"]["position_m"], state["scratch"]["w_n"]  # whose content no tick remembers
    for i in range(3):
        position[i] = law["estimator"]["operating_point_m"][i] + state["estimate"]["predicted"][i]
    kinematics.strokes(law["geometry"], position, stroke)
    for i in range(3):
        capacitance = sense["rest_f"] + stroke[i] / sense["metre_per_farad"][i] + state["sense_zero_f"][i]
        count = (capacitance - sense["offset_f"]) / sense["farad_per_count"] + offset[i]
        count = given[i] if given[i] == given[i] else count
        seen["sense_count"][i] = np.int32(min(max(count, -32768.0), 32767.0)) if count == count else 0
    if recovers != 0 and seen["event"] == _NONE:
        if memory["mode"] == _FAULT:
            seen["event"] = _CLEAR
        elif memory["mode"] == _BOOT:
            seen["event"] = _NODE_FOUND
        elif memory["mode"] == _PRE_OPERATIONAL:
            seen["event"] = _NODE_READY


class Trouble(NamedTuple):
    """What is wrong in a segment: ``law`` and ``reference`` before it begins, ``inputs`` (m,) in advance, and
    ``counts`` (m, 3) in place of what the stage would show, where that is a number.
    """

    law: Records
    reference: Records
    inputs: Records
    counts: NDArray[np.float64]
    offset: NDArray[np.float64]


def segments(
    law: Records, trajectory: Trajectory, period_us: int, count: int, seed: int, memory: Records
) -> Iterator[Segment]:
    """``count`` of them for one law, in ``memory`` (1,), of ``PLANNED_MEMORY`` where it plans; the first without
    trouble.
    """
    random, whole = np.random.default_rng(seed), memory
    memory, problem = planned.begins(whole, cycling.MEMORY), Problem(law).record() if planned.is_planned(law) else None
    for n in range(count):
        first = int(memory["reference_tick"][0])
        path = reference_rows(trajectory.sample(first, TICKS + PREVIEW, period_us), first)
        trouble = Trouble(
            law.copy(), path, np.zeros(TICKS, cycling.INPUT), np.full((TICKS, 3), np.nan), np.zeros((TICKS, 3))
        )
        chosen = [] if n == 0 else random.choice(len(KINDS), size=random.integers(1, 3), replace=False)
        for kind in chosen:
            KINDS[kind](trouble, random)
        recovers = n % 5 != 4  # in some, nobody helps
        taken = trouble.law
        if problem is not None:
            taken = np.zeros(1, planned.PLANNED_LAW)
            taken["own"], taken["problem"] = trouble.law, problem
        yield _run(memory, whole, taken, trouble, random, recovers=recovers)


def _run(
    memory: Records, whole: Records, taken: Records, trouble: Trouble, random: np.random.Generator, *, recovers: bool
) -> Segment:
    law, reference, inputs, counts, offset = trouble
    rows, noise = np.zeros(TICKS, ROW), random.normal(0.0, 8.0, (TICKS, 3)) + offset
    cycle = direct(cycling.cycle if taken is law else planned.cycle, taken, whole, reference)
    shown = direct(show, law, memory, noise[0], counts[0], 1)
    seen, row = memory["input"], memory["row"]
    for k in range(TICKS):
        seen[0] = inputs[k]
        shown(law, memory, noise[k], counts[k], int(recovers))
        inputs[k] = seen[0]
        cycle(taken, whole, reference)
        rows[k] = row[0]
    return Segment(taken, reference, inputs, rows)


def _stretch(random: np.random.Generator, longest: int) -> slice:
    begin = int(random.integers(300, TICKS - 1))
    return slice(begin, begin + int(random.integers(1, longest)))


def _at(random: np.random.Generator, share: float) -> NDArray[np.intp]:
    return np.flatnonzero(random.random(TICKS) < share)


def frames(trouble: Trouble, random: np.random.Generator) -> None:
    at = _at(random, random.choice([0.003, 0.05, 0.5]))
    trouble.inputs["sense_status"][at] = random.integers(0, int(max(SenseStatus)), len(at))


def bursts(trouble: Trouble, random: np.random.Generator) -> None:
    status = [s for s in SenseStatus if s is not SenseStatus.IMPLAUSIBLE]
    trouble.inputs["sense_status"][_stretch(random, 30)] = int(random.choice(status))


def node(trouble: Trouble, random: np.random.Generator) -> None:
    trouble.inputs["node_events"][_stretch(random, 3)] = 1 << int(random.integers(0, len(NodeEvent)))


def overruns(trouble: Trouble, random: np.random.Generator) -> None:
    at = _at(random, random.choice([0.002, 0.1]))
    trouble.inputs["overrun"][at] = random.integers(1, 2**31 - 1 if random.random() < 0.1 else 6, len(at))


def outside(trouble: Trouble, random: np.random.Generator) -> None:
    trouble.inputs["trips"][_stretch(random, 3)] = 1 << int(random.integers(0, int(max(Trip)).bit_length()))


def commands(trouble: Trouble, random: np.random.Generator) -> None:
    at = _at(random, random.choice([0.01, 0.2]))
    trouble.inputs["event"][at] = random.integers(-2, len(Event) + 2, len(at))


def switches(trouble: Trouble, random: np.random.Generator) -> None:
    """What is asked for beside events, whatever the record has for it."""
    where = _stretch(random, TICKS)
    known = {"event", "sense_status", "node_events", "overrun", "sense_count", "trips"}
    for name in sorted(set(cycling.INPUT.names or ()) - known):
        trouble.inputs[name][where] = random.integers(0, 2)


def holds(trouble: Trouble, random: np.random.Generator) -> None:
    at = _at(random, 0.02)
    trouble.inputs["event"][at] = random.choice([Event.HOLD, Event.TRACK, Event.TRACK, Event.DISABLE], len(at))


def any_counts(trouble: Trouble, random: np.random.Generator) -> None:
    where = _stretch(random, TICKS)
    trouble.counts[where] = random.integers(-32768, 32768, trouble.counts[where].shape)


def rail(trouble: Trouble, random: np.random.Generator) -> None:
    trouble.counts[_stretch(random, 40), random.integers(0, 3)] = random.choice([-32768, 32767])


def frozen(trouble: Trouble, random: np.random.Generator) -> None:
    where, comb = _stretch(random, 300), int(random.integers(0, 3))
    trouble.counts[where, comb] = random.integers(-2000, 2000)
    for name in ("residual_max_m", "innovation_max_m", "unexplained_force_max_n", "force_change_max_n"):
        trouble.law["limits"][name] = 1.0  # else these are sooner


def jump(trouble: Trouble, random: np.random.Generator) -> None:
    which = slice(None) if random.random() < 0.5 else int(random.integers(0, 3))
    trouble.offset[_stretch(random, 60), which] = random.normal(0.0, 10.0 ** random.uniform(2, 4))


def jumps(trouble: Trouble, random: np.random.Generator) -> None:
    at = _at(random, 0.05)
    trouble.offset[at, random.integers(0, 3, len(at))] = random.normal(0.0, 4000.0, len(at))


def drift(trouble: Trouble, random: np.random.Generator) -> None:
    where = _stretch(random, 400)
    ramp = np.arange(len(trouble.offset[where])) * random.normal(0.0, 30.0)
    trouble.offset[where, random.integers(0, 3)] += ramp


def far(trouble: Trouble, random: np.random.Generator) -> None:
    trouble.reference["motion"] *= 10.0 ** random.uniform(0, 2)


def steps(trouble: Trouble, random: np.random.Generator) -> None:
    trouble.reference["motion"][_stretch(random, 900), : random.integers(1, 4)] += random.normal(0.0, 3e-6)
    trouble.law["limits"]["saturation_count"] = 3  # a step asks for all that there is, but not for long


def no_numbers(trouble: Trouble, random: np.random.Generator) -> None:
    rows = trouble.reference["motion"][_stretch(random, 100)]
    rows[:, random.integers(0, 9)] = random.choice([np.nan, np.inf, -np.inf, 1e308, 1e-310])
    if random.random() < 0.5:
        trouble.reference["added_m"][_stretch(random, 100)] = random.choice([np.nan, np.inf, -np.inf, 1e-310])


def excited(trouble: Trouble, random: np.random.Generator) -> None:
    trouble.reference["added_m"] = random.normal(
        0.0, 10.0 ** random.uniform(-9, -6), trouble.reference["added_m"].shape
    )


def narrow(trouble: Trouble, random: np.random.Generator) -> None:
    """Limits that nothing keeps."""
    limits = trouble.law["limits"]
    if random.random() < 0.2:
        limits["voltage_step_max_v"] = 0.0
    for name in random.choice([n for n in limits.dtype.names if limits.dtype[n].base.kind == "f"], 2, replace=False):
        limits[name] *= 10.0 ** -random.uniform(0, 5)


def unbelieving(trouble: Trouble, random: np.random.Generator) -> None:
    """Combs that are told apart by noise alone."""
    trouble.law["limits"]["residual_max_m"] = 10.0 ** random.uniform(-10, -8)


KINDS: tuple[Callable[[Trouble, np.random.Generator], None], ...] = (
    frames, bursts, node, overruns, outside, commands, switches, holds, any_counts, rail, frozen, jump, jumps, drift,
    far, steps, no_numbers, excited, narrow, unbelieving,
)  # fmt: skip
