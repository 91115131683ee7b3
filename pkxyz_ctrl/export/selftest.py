"""What a target has to compute from recorded inputs, to the last bit: digests of rows and memory, made here."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pkxyz_ctrl.export.words import FNV_OFFSET, canonical, digest
from pkxyz_ctrl.loop import cycle as cycling
from pkxyz_ctrl.loop.period import period_of
from pkxyz_ctrl.loop.row import ROW
from pkxyz_ctrl.safety.modes import Mode

Records = NDArray[np.void]

EVERY = 100
"""Ticks between two digests, so that a difference has a place."""
BEGINS_IN = Mode.IDLE
"""As every run: the node is operational, and nothing is known."""


class SelfTest(NamedTuple):
    """``inputs`` (n,) of ``cycle.INPUT``; ``digests`` of all rows up to every ``EVERY``-th, and last of the memory."""

    inputs: Records
    digests: tuple[int, ...]


def self_test(law: Records, reference: Records, inputs: Records) -> SelfTest:
    """Run the inputs (n,), n a multiple of ``EVERY``, through the cycle of this machine."""
    if len(inputs) == 0 or len(inputs) % EVERY:
        raise ValueError(f"a self-test has a multiple of {EVERY} ticks, not {len(inputs)}")
    rows, memory = play(law, reference, inputs)
    state, digests = FNV_OFFSET, []
    for begin in range(0, len(rows), EVERY):
        state = digest(state, canonical(rows[begin : begin + EVERY]))
        digests.append(state)
    return SelfTest(inputs, (*digests, digest(state, canonical(memory))))


def play(law: Records, reference: Records, inputs: Records) -> tuple[Records, Records]:
    """Rows (n,) that inputs (n,) lead to from switching on, and the memory (1,) after them."""
    memory = cycling.new_memory(BEGINS_IN)
    rows = np.zeros(len(inputs), ROW)
    cycle, seen, row = period_of(law, reference), memory["input"], memory["row"]
    for n in range(len(inputs)):
        seen[0] = inputs[n]
        cycle(law, memory, reference)
        rows[n] = row[0]
    return rows, memory
